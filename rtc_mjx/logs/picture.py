"""A logged scene from above, as it is after conversion: what the simulation will see, and nothing else."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from rtc_mjx.logs.convert import Converted
from rtc_mjx.logs.scene import AMBER, CYCLIST, GREEN, NO_SIGNAL, PEDESTRIAN, RED, VEHICLE, RoadGraph, lane_exists

GROUND, LANE, EDGE, STRIPES = "#f4f3ef", "#b9bcc0", "#3c4046", "#d9d3bd"
COLOURS = {VEHICLE: "#7d93ad", PEDESTRIAN: "#b2477a", CYCLIST: "#4f9a72"}
CONTROLLED, MARKED = "#d1491d", "#e6a23c"
LIGHTS = {RED: "#d8392b", AMBER: "#f0b429", GREEN: "#2fa35a"}
MARGIN, LEAST = 35.0, 60.0  # m about the controlled agent's path; half a side, at least
PIXELS, INCHES = 120, 9.0


def draw(converted: Converted, marked: Collection[str], file: Path) -> None:
    """Writes a PNG: road, signals at t = 0, boxes at t = 0 and paths over all times.

    Args:
        converted: the scene; its controlled agent is red.
        marked: ids of tracks that are controlled in other scenes of the same recording; they are orange.
        file: where to.
    """
    from matplotlib.figure import Figure  # takes a while to import

    figure = Figure(figsize=(INCHES, INCHES), dpi=PIXELS, layout="constrained", facecolor=GROUND)
    axes = figure.add_subplot(facecolor=GROUND)
    scene = converted.scene
    draw_road(axes, scene.road)
    _signals(axes, scene)
    for user in reversed(range(len(scene.kind))):
        if scene.kind[user]:
            _user(axes, scene, user, converted.users[user] in marked)
    _frame(axes, scene)
    there = int(np.sum((np.asarray(scene.kind) > 0) & np.any(scene.valid, axis=1)))
    axes.set_title(f"{converted.name}    {there} road users, connectivity {converted.connectivity}", fontsize=10, color=EDGE, loc="left")
    figure.savefig(file)


def draw_road(axes: Any, road: RoadGraph) -> None:
    """Crosswalks, centre lines of lanes with the way one drives, and edges, on axes in m."""
    from matplotlib.collections import LineCollection, PolyCollection

    there = np.any(road.crosswalks != road.crosswalks[:, :1], axis=(1, 2))
    axes.add_collection(PolyCollection(list(road.crosswalks[there]), facecolor=STRIPES, edgecolor="none", hatch="||", zorder=1))
    lanes = np.asarray(road.lanes)[np.asarray(lane_exists(road))]
    axes.add_collection(LineCollection(list(lanes), colors=LANE, linewidths=1.0, zorder=2))
    for lane in lanes:
        _arrow(axes, lane)
    axes.add_collection(LineCollection(list(road.edges[road.edge_valid]), colors=EDGE, linewidths=1.2, zorder=3))


def _arrow(axes: Any, lane: np.ndarray) -> None:
    """Half way along, the way one drives."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(lane, axis=0), axis=1))])
    if along[-1] < 4.0:
        return
    tail, head = (np.array([np.interp(s, along, lane[:, k]) for k in (0, 1)]) for s in (along[-1] / 2 - 0.5, along[-1] / 2 + 0.5))
    axes.annotate(
        "", head, tail, arrowprops={"arrowstyle": "-|>", "color": LANE, "lw": 0.8, "mutation_scale": 7}, zorder=2, annotation_clip=True
    )


def _signals(axes: Any, scene: Any) -> None:
    """A dot where one stops: before the lane that the light is for."""
    first = np.asarray(scene.signals)[0]
    for lane in np.flatnonzero(first != NO_SIGNAL):
        x, y = scene.road.lanes[lane, 0]
        axes.plot(x, y, "o", color=LIGHTS[int(first[lane])], markeredgecolor=EDGE, markeredgewidth=0.5, markersize=6, zorder=6)


def _user(axes: Any, scene: Any, user: int, marked: bool) -> None:
    controlled = user == int(scene.controlled)
    colour = CONTROLLED if controlled else MARKED if marked else COLOURS[int(scene.kind[user])]
    there = np.flatnonzero(scene.valid[user])
    if not len(there):
        return
    path = np.where(scene.valid[user][:, None], scene.pose[user, :, :2], np.nan)
    axes.plot(*path.T, color=colour, linewidth=2.0 if controlled else 1.0, alpha=0.9 if controlled else 0.55, zorder=5 if controlled else 4)
    x, y, heading = scene.pose[user, there[0]]
    long, wide = scene.size[user] / 2
    ways = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    box = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * (long, wide) @ ways + (x, y)
    late = there[0] > 0  # appears later: only an outline
    axes.fill(*box.T, facecolor="none" if late else colour, edgecolor=colour if late else "white", linewidth=0.8, zorder=7)
    nose = np.array([[0.95, 0.0], [0.55, 0.7], [0.55, -0.7]]) * (long, wide) @ ways + (x, y)
    axes.fill(*nose.T, facecolor=colour if late else "white", linewidth=0, zorder=8)


def _frame(axes: Any, scene: Any) -> None:
    agent = int(scene.controlled)
    path = scene.pose[agent][scene.valid[agent], :2]
    low, high = path.min(axis=0), path.max(axis=0)
    half = max(LEAST, float(np.max(high - low)) / 2 + MARGIN)
    x, y = (low + high) / 2
    axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half), aspect="equal")
    axes.set_xlabel("m", color=EDGE, fontsize=8)
    axes.tick_params(colors=EDGE, labelsize=8, length=2)
    for side in axes.spines.values():
        side.set_visible(False)
