"""Figures of results that can be read in print: methods differ by colour, line and marker, and lines are named where they end."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rtc_mjx import results
from rtc_mjx.results import Record
from rtc_mjx.scenes import scene_type

Held = Mapping[str, Record]
FAMILIES = ("bc", "gail", "mgail", "info_mgail", "symphony", "naive_hierarchy", "rtc")
MARKERS = dict(zip(FAMILIES, "sPv^DXo", strict=True))
COLOURS = dict(zip(FAMILIES, ("0.45", "#8c6d31", "#d95f02", "#e7298a", "#66a61e", "#7570b3", "#1b6fb0"), strict=True))
SOURCES: Mapping[
    str, tuple[str, dict[str, Any]]
] = {  # of types: whose, and how they are drawn; each has less of the episode than those above
    "paired": ("the episode's own expert", {"marker": "o", "color": "k", "markerfacecolor": "k"}),
    "same_xi": ("another expert in the same episode", {"marker": "^", "color": "k", "markerfacecolor": "white"}),
    "shuffled": ("an expert in another episode", {"marker": "s", "color": "#d95f02", "markerfacecolor": "#d95f02"}),
    "prior": ("the prior", {"marker": "D", "color": "#1b6fb0", "markerfacecolor": "white"}),
}
SMALLEST = 1e-5  # on logarithmic axes; what is less is drawn there
UNITS = {
    "return": "steps at a goal",
    "min_ade": "m",
    "offroad_time": "share of time",
    "adversarial": "nat",
    "type_kl": "nat",
    "cloning": "nat",
}


def style(name: str) -> dict[str, Any]:
    """How a method is drawn: colour and marker by family, dashed and hollow with discrete types."""
    family = name.removesuffix("_c").removesuffix("_d")
    colour = COLOURS.get(family, "k")
    discrete = name.endswith("_d")
    return {
        "color": colour,
        "marker": MARKERS.get(family, "*"),
        "linestyle": "--" if discrete else "-",
        "markerfacecolor": "white" if discrete else colour,
    }


def titled(metric: str) -> str:
    """A metric's name with its unit."""
    unit = UNITS.get(metric) or ("bit" if "jsd" in metric else "share" if metric.endswith("_rate") or metric.startswith("accuracy") else "")
    return metric.replace("_", " ") + (f" ({unit})" if unit else "")


def save(canvas: Figure, file: Path) -> None:
    """Writes a figure whole or not at all."""
    part = file.with_name(f".{file.name}.part")
    canvas.savefig(part, dpi=150, format="png")
    os.replace(part, file)


def logarithmic(metric: str) -> bool:
    """Whether a metric spans orders of magnitude."""
    return metric.startswith("jsd")


def curves(held: Held, file: Path) -> None:
    """Main metrics and losses against updates: mean and standard deviation over seeds; median and 10 to 90 % on logarithmic axes."""
    drawn = {name: record for name, record in held.items() if record.get("curves")}
    if not drawn:
        return
    first = next(iter(drawn.values()))
    main = scene_type(first["scene"]).main_metrics
    panels = [n for n in (*main, *results.LOSSES) if any(n in record["curves"] for record in drawn.values())]
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    canvas = Figure(figsize=(4.2 * columns, 2.9 * rows), layout="constrained")
    axes = canvas.subplots(rows, columns, squeeze=False)
    for axis, metric in zip(axes.flat, panels, strict=False):
        ends = {
            name: _curve(axis, style(name), record["curves"][metric], metric)
            for name, record in drawn.items()
            if metric in record["curves"]
        }
        expert = first["reference"]["expert"].get(metric)
        if expert is not None and not logarithmic(metric):
            axis.axhline(expert, color="k", linestyle=":", linewidth=1)
            ends["expert"] = expert
        _named_ends(axis, ends)
        axis.set_title(titled(metric), fontsize=9)
        axis.set_xlabel("updates", fontsize=8)
        axis.tick_params(labelsize=7)
        axis.grid(alpha=0.25)
    for axis in axes.flat[len(panels) :]:
        axis.axis("off")
    save(canvas, file)


def _curve(axis: Axes, how: dict[str, Any], curve: Mapping[str, Any], metric: str) -> float:
    """Draws a method's curve; returns where it ends."""
    updates, values = curve["updates"], np.asarray(curve["per_seed"], float)
    if logarithmic(metric):
        axis.set_yscale("log")
        low, middle, high = np.maximum(np.quantile(values, [0.1, 0.5, 0.9], axis=1), SMALLEST)
    else:
        middle, spread = values.mean(axis=1), values.std(axis=1, ddof=1) if values.shape[1] > 1 else np.zeros(len(values))
        low, high = middle - spread, middle + spread
    axis.plot(updates, middle, linewidth=1.2, markersize=3.5, markevery=max(1, len(updates) // 6), **how)
    axis.fill_between(updates, low, high, color=how["color"], alpha=0.13, linewidth=0)
    return float(middle[-1])


def _named_ends(axis: Axes, ends: Mapping[str, float]) -> None:
    """Names lines right of where they end, moved apart where they end together."""
    if not ends:
        return
    axis.autoscale_view()
    names = sorted(ends, key=lambda name: ends[name])
    to_axes = axis.transScale + axis.transLimits  # data to shares of the axes
    heights = [float(to_axes.transform((axis.get_xlim()[1], ends[name]))[1]) for name in names]
    for name, height, place in zip(names, heights, apart(heights, 0.075), strict=True):
        line = {"color": style(name)["color"], "linewidth": 0.5} if name != "expert" else {"color": "k", "linewidth": 0.5}
        axis.annotate(
            name, (1, height), (1.05, place), xycoords="axes fraction", textcoords="axes fraction", fontsize=6.5, va="center",
            color=line["color"], arrowprops={"arrowstyle": "-", "shrinkA": 0, "shrinkB": 0, **line},
        )  # fmt: skip


def apart(heights: Sequence[float], gap: float) -> list[float]:
    """Ascending heights in [0, 1], moved as little as need be so that neighbours are a gap apart, about the same middle, and inside."""
    groups: list[list[float]] = []  # of heights that must be moved together: the heights
    for height in heights:
        groups.append([height])
        while len(groups) > 1 and _top(groups[-2], gap) + gap > _bottom(groups[-1], gap):
            last = groups.pop()
            groups[-1] += last
    return [_bottom(group, gap) + gap * index for group in groups for index in range(len(group))]


def _bottom(group: Sequence[float], gap: float) -> float:
    size = gap * (len(group) - 1)
    return float(np.clip(np.mean(group) - size / 2, 0, max(1 - size, 0)))


def _top(group: Sequence[float], gap: float) -> float:
    return _bottom(group, gap) + gap * (len(group) - 1)


def overview(held: Held, file: Path) -> None:
    """Each method as an arrow, from its encoder's types of the same episode to those it draws at test time; methods without, as a point.

    Upwards: the scene's first main metric. To the right: how badly the agents cover what experts do. Small points are seeds.
    """
    first = next(iter(held.values()))
    scene = scene_type(first["scene"])
    across, up = scene.coverage, scene.main_metrics[0]
    canvas = Figure(figsize=(7.0, 4.4), layout="constrained")
    axes = canvas.subplots()
    expert, other = first["reference"]["expert"], first["reference"].get("expert_vs_expert", {})
    axes.axhline(expert[up], color="k", linestyle=":", linewidth=1, label="expert", zorder=1)
    if other.get(across):
        axes.axvline(other[across], color="k", linestyle="-.", linewidth=0.8, label="expert against expert", zorder=1)
    for name, record in held.items():
        how = style(name)
        points = {**how, "linestyle": ""}
        x, y = (np.array(record["metrics"][metric]["per_seed"]) for metric in (across, up))
        axes.plot(x, y, **points, markersize=3.5, alpha=0.45, zorder=3)
        axes.plot(x.mean(), y.mean(), **points, markersize=8, label=name, zorder=5)
        if paired := record["types"].get("paired"):
            tail = (paired[across]["mean"], paired[up]["mean"])
            arrow = {"arrowstyle": "->", "color": how["color"], "linestyle": how["linestyle"], "shrinkA": 3, "shrinkB": 5}
            axes.annotate("", (x.mean(), y.mean()), tail, arrowprops=arrow, zorder=4)
            axes.plot(*tail, marker="|", color=how["color"], markersize=13, markeredgewidth=2, zorder=6)
    axes.plot([], [], marker="|", linestyle="", color="0.3", markersize=11, markeredgewidth=2, label="types of the same episode")
    axes.set(xlabel=titled(across), ylabel=titled(up))
    if logarithmic(across):
        axes.set_xscale("symlog", linthresh=1e-3)
        axes.set_xlim(left=-2e-4)
    axes.grid(alpha=0.25)
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    save(canvas, file)


def type_shift(held: Held, file: Path) -> None:
    """Main metrics of each method that reads types off trajectories, by where its types come from: means, and seeds as small points."""
    found = {name: record["type_shift"]["types"] for name, record in held.items() if record.get("type_shift", {}).get("types")}
    if not found:
        return
    first = held[next(iter(found))]
    main = [n for n in scene_type(first["scene"]).main_metrics if all(n in values for of in found.values() for values in of.values())]
    columns = min(2, len(main))
    rows = -(-len(main) // columns)
    canvas = Figure(figsize=(3.4 * columns + 1.2, (0.62 * len(found) + 0.5) * rows + 0.9), layout="constrained")
    panels = canvas.subplots(rows, columns, squeeze=False, sharey=True)
    for axis, metric in zip(panels.flat, main, strict=False):
        if logarithmic(metric):
            axis.set_xscale("symlog", linthresh=1e-3)
        for place, of in enumerate(found.values()):
            _by_source(axis, place, {source: of[source][metric] for source in SOURCES if source in of})
        axis.axvline(first["reference"]["expert"][metric], color="k", linestyle=":", linewidth=1, label="what experts do")
        if logarithmic(metric):
            axis.set_xlim(left=-2e-4)  # nothing is below 0, where points are seen whole
        axis.set_title(titled(metric), fontsize=9)
        _rows(axis, list(found))
        for below in range(1, len(found)):
            axis.axhline(below - 0.5, color="0.85", linewidth=0.6, zorder=1)
    for axis in panels.flat[len(main) :]:
        axis.axis("off")
    marks = dict(zip(*reversed(panels[0, 0].get_legend_handles_labels()), strict=True))
    canvas.legend(marks.values(), marks, ncols=2, loc="outside upper center", fontsize=8, frameon=False)
    save(canvas, file)


def _by_source(axis: Axes, place: int, values: Mapping[str, Sequence[float]]) -> None:
    """One method's row: a line for each source of types, their means joined."""
    heights = [place + 0.19 * (list(SOURCES).index(source) - (len(SOURCES) - 1) / 2) for source in values]
    means = [float(np.mean(seeds)) for seeds in values.values()]
    axis.plot(means, heights, color="0.6", linewidth=0.8, zorder=2)
    for (source, seeds), height, mean in zip(values.items(), heights, means, strict=True):
        label, how = SOURCES[source]
        axis.plot(seeds, [height] * len(seeds), ".", color=how["color"], markersize=3.5, alpha=0.6, zorder=3)
        axis.plot(mean, height, **how, linestyle="", markersize=6, label=f"types of {label}", zorder=4)


def ablations(held: Held, file: Path) -> None:
    """A panel for each option and metric: seeds as dots, means joined; the committed value stands in every panel, filled.

    The naive hierarchy is RTC whose whole minibatch takes types from the encoder: it stands at an encoder share of 1.
    """
    options = dict.fromkeys((name.partition(",")[0], name.partition(",")[2].partition("=")[0]) for name in held if "," in name)
    if not options:
        return
    scene = scene_type(next(iter(held.values()))["scene"])
    metrics = list(dict.fromkeys((scene.main_metrics[0], scene.coverage)))
    canvas = Figure(figsize=(2.6 * len(options) + 0.4, 2.6 * len(metrics)), layout="constrained")
    axes = canvas.subplots(len(metrics), len(options), squeeze=False, sharey="row")
    for column, (base, option) in enumerate(options):
        values = _values(held, base, option)
        for axis, metric in zip(axes[:, column], metrics, strict=True):
            _variations(axis, values, metric, base)
            axis.set_title(f"{base}: {option.rpartition('.')[2].replace('-', ' ')}", fontsize=8)
    for axis, metric in zip(axes[:, 0], metrics, strict=True):
        axis.set_ylabel(titled(metric), fontsize=8)
    save(canvas, file)


def _values(held: Held, base: str, option: str) -> dict[str, tuple[str, Record]]:
    """Results by the value of an option, in its order: variations, the base at the committed value, the naive hierarchy at share 1."""
    found = {}
    if base in held:
        at: Any = held[base]["config"]
        for part in option.replace("-", "_").split("."):
            at = at[part]
        found[str(at)] = (base, held[base])
    found |= {name.partition("=")[2]: (name, record) for name, record in held.items() if name.startswith(f"{base},{option}=")}
    naive = "naive_hierarchy" + base[-2:]
    if option == "encoder-share" and naive in held:
        found["1.0"] = (naive, held[naive])
    try:
        return dict(sorted(found.items(), key=lambda item: float(item[0])))
    except ValueError:  # words
        return found


def _variations(axis: Axes, values: Mapping[str, tuple[str, Record]], metric: str, base: str) -> None:
    means = []
    for place, (name, record) in enumerate(values.values()):
        seeds = np.maximum(record["metrics"][metric]["per_seed"], SMALLEST if logarithmic(metric) else -np.inf)
        axis.plot([place] * len(seeds), seeds, ".", color="0.6", markersize=4, zorder=2)
        means.append(float(np.mean(seeds)))
        axis.plot(
            place,
            means[-1],
            marker=style(name.partition(",")[0])["marker"],
            color="k",
            markerfacecolor="k" if name == base else "white",
            zorder=4,
        )
    axis.plot(range(len(means)), means, color="k", linewidth=0.8, zorder=3)
    if logarithmic(metric):
        axis.set_yscale("log")
    labels = [f"{value}\n(naive)" if name.startswith("naive") else value.replace("_", "\n") for value, (name, _) in values.items()]
    axis.set_xticks(range(len(labels)), labels, fontsize=7)
    axis.tick_params(axis="y", which="both", labelsize=7)
    axis.grid(alpha=0.25, axis="y")


def realism(held: Held, file: Path) -> None:
    """Conditional realism of each method, feature by feature: bars and seeds as dots, the floor of each as a dashed line."""
    found = {
        name: record["type_shift"]["realism"]["features"] for name, record in held.items() if "realism" in record.get("type_shift", {})
    }
    if not found:
        return
    features = list(next(iter(found.values())))
    canvas = Figure(figsize=(2.6 * len(features) + 1.2, 0.36 * len(found) + 1.2), layout="constrained")
    for axis, feature in zip(canvas.subplots(1, len(features), squeeze=False, sharey=True)[0], features, strict=True):
        for place, of in enumerate(found.values()):
            if feature not in of:
                continue
            seeds = of[feature]["agent"]
            axis.barh(place, np.mean(seeds), color="0.8", height=0.66)
            axis.plot(seeds, [place] * len(seeds), "k.", markersize=4)
            axis.plot([of[feature]["floor"]] * 2, [place - 0.4, place + 0.4], "k--", linewidth=1)
        axis.set_title(feature.replace("_", " "), fontsize=9)
        axis.set_xlabel("JSD (bit); dashed: floor", fontsize=8)
        _rows(axis, list(found))
    save(canvas, file)


def _rows(axis: Axes, names: Sequence[str]) -> None:
    """A row for each name, the first at the top."""
    axis.set_yticks(range(len(names)), names, fontsize=8)
    axis.tick_params(axis="x", labelsize=7)
    if axis.get_xscale() == "linear":
        axis.locator_params(axis="x", nbins=5)  # long numbers would run into each other
    axis.grid(alpha=0.25, axis="x")
    axis.set_ylim(len(names) - 0.4, -0.6)
