"""Pictures of rollouts from above, for notebooks and reports: who went where in one episode, and what a population did in it."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.axes import Axes

from rtc_mjx.render import colour
from rtc_mjx.scenes import Scene
from rtc_mjx.trajectory import Episode, Trajectory

SHADES = {"paired": "0.25", "shuffled": "0.55", "prior": "0.8"}
LINES = ("-", "--", "-.", ":")  # actors differ by them too: in print, colours may not
MARGIN = 0.15  # of what is shown, on every side


def episode_of(held: Any, index: int) -> Any:
    """One row of a tree with a leading axis of episodes, as numpy arrays."""
    return jax.tree.map(lambda x: np.asarray(x[index]), held)


def paths(axes: Axes, scene: Scene, episode: Episode, tracks: Trajectory, colours: Sequence[Any] | None = None, title: str = "") -> None:
    """Draws the ways of several actors through one episode.

    Args:
        axes: to draw on; coordinates are metres.
        scene: of the episode.
        episode: its surroundings are sketched below.
        tracks: with a leading axis of actors.
        colours: of the actors (default: those of videos, one a type).
        title: above.
    """
    ways = np.asarray(tracks.states.qpos)[..., :2]
    scene.sketch(axes, episode)
    for actor, way in enumerate(ways):
        own = colours[actor] if colours is not None else colour(actor + 1)
        line = LINES[actor % len(LINES)] if colours is None else "-"
        axes.plot(*way.T, line, color=own, linewidth=1.4, alpha=0.85, zorder=10)
        axes.plot(*way[-1], "o", color=own, markersize=3.5, zorder=11)
    low, high = ways.min(axis=(0, 1)), ways.max(axis=(0, 1))
    middle, half = (low + high) / 2, max(float(np.max(high - low)) / 2 * (1 + 2 * MARGIN), scene.least_view)
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half), aspect="equal", title=title)
    axes.tick_params(labelsize=7)


def results(folder: Path, methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """What `report` or `study` wrote of these methods, as far as it is there."""
    files = {name: folder / f"{name}.json" for name in methods}
    return {name: json.loads(file.read_text()) for name, file in files.items() if file.is_file()}


def shifts(folder: Path, methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """What `type_shift` said of the runs of these methods, as far as the results of a study hold it."""
    return {name: held["type_shift"] for name, held in results(folder, methods).items() if held.get("type_shift")}


def by_source(axes: Axes, held: Mapping[str, Mapping[str, Any]], metric: str) -> None:
    """Bars of a metric by source of types, a group a method; dots are seeds, the dashed line is the expert.

    Args:
        axes: to draw on.
        held: results by method, as in results/<scene>/<method>.json; where there are none, that is said.
        metric: its name.
    """
    axes.set_title(metric.replace("_", " "), fontsize=10)
    if not held:
        axes.text(0.5, 0.5, "no results yet", ha="center", va="center", transform=axes.transAxes)
        axes.set_axis_off()
        return
    for place, result in enumerate(held.values()):
        sources = [source for source in SHADES if source in result["types"]]
        for index, source in enumerate(sources):
            x, seeds = place + 0.26 * (index - (len(sources) - 1) / 2), result["types"][source][metric]["per_seed"]
            axes.bar(x, np.mean(seeds), width=0.24, color=SHADES[source], label=source)
            axes.plot([x] * len(seeds), seeds, "k.", markersize=3)
    expert = next(iter(held.values()))["reference"]["expert"][metric]
    axes.axhline(expert, color="k", linestyle="--", linewidth=0.8, label="expert")
    axes.set_xticks(range(len(held)), [name.replace("_", "\n") for name in held], fontsize=8)
    labelled = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
    axes.legend(labelled.values(), labelled.keys(), fontsize=7, framealpha=0.8, edgecolor="none")
