"""What type_shift.json says, for the eye: tables of one run, and one figure of one run or several.

A result holds what there was to say of its run: each table and each panel is drawn where its part is there.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import FigureBase
from rich.table import Table

Result = Mapping[str, Any]
SOURCES = ("paired", "same_xi", "shuffled", "prior")  # in the order in which less and less of the episode is in a type
STYLES = (("o", "black"), ("^", "0.5"), ("s", "tab:blue"), ("D", "tab:orange"), ("v", "tab:green"), ("P", "tab:red"), ("X", "tab:purple"))


@dataclass(frozen=True)
class Values:
    """One figure of a run.

    Attributes:
        seeds: of each seed.
        level: what it is to be seen beside: a null, a floor; None without one.
    """

    seeds: Sequence[float]
    level: float | None = None


@dataclass(frozen=True)
class Panel:
    """A part of the figure.

    Attributes:
        part: of the result that it shows.
        title: above; `{metric}` stands for the scene's main metric.
        rows: what it shows of a result, by name.
    """

    part: str
    title: str
    rows: Callable[[Result], dict[str, Values]]

    def of(self, result: Result) -> dict[str, Values]:
        """What it shows of a result; nothing where its part is not there."""
        return self.rows(result) if result.get(self.part) else {}


def _by_source(result: Result) -> dict[str, Values]:
    return {source: Values(result["types"][source][result["metric"]]) for source in SOURCES if source in result["types"]}


def _by_luck(result: Result) -> dict[str, Values]:
    held = {name: of[result["metric"]] for name, of in result["by_luck"].items()}
    there = {name.replace(", ", "\n"): Values(values) for name, values in held.items() if values}
    return there if len(there) > 1 else {}  # one pair alone is what the first panel shows


def _reaction(result: Result) -> dict[str, Values]:
    expert = result["reaction"]["expert"]
    return {
        f"{who}\n{name}": Values(result["reaction"][who][name], expert[name][0])
        for who in SOURCES
        if who in result["reaction"]
        for name in ("as_it_was", "flipped")
    }


PANELS = (
    Panel("types", "{metric}, by source of types", _by_source),
    Panel("by_luck", "{metric}, shuffled types: did luck let the expert?", _by_luck),
    Panel(
        "information",
        "types tell of, bits (dashed: null, 95 %)",
        lambda result: {name: Values(of["bits"], of["null_95"]) for name, of in result["information"].items()},
    ),
    Panel("reencoding", "trajectory shows its type, bits", lambda result: {k: Values(bits) for k, bits in result["reencoding"].items()}),
    Panel("reaction", "share that goes, luck turned round (dashed: experts)", _reaction),
    Panel(
        "realism",
        "conditional realism: JSD, bits (dashed: floor)",
        lambda result: {name: Values(of["agent"], of["floor"]) for name, of in result["realism"]["features"].items()},
    ),
)


def draw(canvas: FigureBase, results: Mapping[str, Result]) -> None:
    """Draws what runs of one scene say, side by side: a marker for each run, large for the mean, small for seeds.

    Args:
        canvas: to draw on.
        results: by what each run is to be called; panels that none of them has are left out.
    """
    shown = [panel for panel in PANELS if any(panel.of(result) for result in results.values())]
    if not shown:
        return
    columns = min(3, len(shown))
    axes = list(canvas.subplots(-(-len(shown) // columns), columns, squeeze=False).flat)
    for axis, panel in zip(axes, shown, strict=False):
        _panel(axis, panel, results)
    for axis in axes[len(shown) :]:
        axis.axis("off")
    handles = {text: mark for axis in axes for mark, text in zip(*axis.get_legend_handles_labels(), strict=True)}
    axes[0].legend([handles[name] for name in results if name in handles], [n for n in results if n in handles], fontsize=7, framealpha=0.8)


def _panel(axis: Axes, panel: Panel, results: Mapping[str, Result]) -> None:
    rows = {run: panel.of(result) for run, result in results.items()}
    names = list(dict.fromkeys(name for of in rows.values() for name in of))
    step = 0.7 / len(rows)
    for index, (run, of) in enumerate(rows.items()):
        marker, colour = STYLES[index % len(STYLES)]
        for name, values in of.items():
            x = names.index(name) + step * (index - (len(rows) - 1) / 2)
            axis.plot([x] * len(values.seeds), values.seeds, marker, color=colour, markersize=3, markerfacecolor="none", linestyle="none")
            axis.plot([x], [np.mean(values.seeds)], marker, color=colour, markersize=7, linestyle="none", label=run)
            if values.level is not None:
                axis.plot([x - step / 2, x + step / 2], [values.level] * 2, "--", color=colour, linewidth=1)
    axis.set_xticks(range(len(names)), [name.replace("_", " ") for name in names], fontsize=7)
    metric = next(iter(results.values()))["metric"].replace("_", " ")
    axis.set_title(panel.title.format(metric=metric), fontsize=9)
    axis.set_xlim(-0.6, len(names) - 0.4)
    axis.grid(alpha=0.25, axis="y")


def tables(result: Result) -> list[Table]:
    """The result for the terminal."""
    makers = {
        "types": _types,
        "by_luck": _luck_table,
        "reaction": _reaction_table,
        "information": _information,
        "reencoding": _reencoding,
        "realism": _realism,
    }
    return [make(result) for part, make in makers.items() if result.get(part)]


def _types(result: Result) -> Table:
    out = Table("types", *next(iter(result["types"].values())), title="rollouts by source of types")
    for source, values in result["types"].items():
        out.add_row(source, *(spread(x) for x in values.values()))
    return out


def _luck_table(result: Result) -> Table:
    metric = result["metric"]
    out = Table("did luck let the expert?", "agents", metric, title="shuffled types: of the type, and of the episode")
    for name, of in result["by_luck"].items():
        out.add_row(name, str(of["agents"]), spread(of[metric]) if of[metric] else "-")
    return out


def _reaction_table(result: Result) -> Table:
    heads = ("as_it_was", "flipped", "like_expert")
    out = Table("types", *(head.replace("_", " ") for head in heads), title="luck turned round at the same type: share that goes")
    for who, shares in result["reaction"].items():
        out.add_row(who, *(spread(shares[head]) for head in heads))
    return out


def _information(result: Result) -> Table:
    control, episodes = result["probe"]["control"], result["probe"]["episodes"]
    out = Table("types tell of", "bits", "null, mean", "null, 95 %", title=f"mutual information, held out ({episodes} episodes)")
    for name, of in result["information"].items():
        out.add_row(name, spread(of["bits"]), f"{of['null_mean']:.3f}", f"{of['null_95']:.3f}")
    out.caption = f"Control: of a noisy copy of xi that tells at most {control['at_most']:.2f} bits the probe finds {control['bits']:.2f}."
    return out


def _reencoding(result: Result) -> Table:
    out = Table("trajectory", "bits", title="how well a trajectory shows its type (median)")
    for name, bits in result["reencoding"].items():
        out.add_row(name.replace("_", " "), spread(bits))
    return out


def _realism(result: Result) -> Table:
    out = Table("feature", "agent", "95 %", "floor", "95 %", title="conditional realism: JSD of p(tau|xi) from the experts', bits")
    for name, of in result["realism"]["features"].items():
        ends = ("[{:.4f}, {:.4f}]".format(*of[key]) for key in ("interval", "floor_interval"))
        out.add_row(name, spread(of["agent"]), next(ends), f"{of['floor']:.4f}", next(ends))
    return out


def spread(values: Sequence[float]) -> str:
    """Mean and standard deviation over seeds; of one seed its value."""
    return f"{np.mean(values):.4g} ± {np.std(values, ddof=1):.2g}" if len(values) > 1 else f"{values[0]:.4g}"
