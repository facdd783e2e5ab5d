"""Tables and figures of runs side by side: learning curves (mean and standard deviation over seeds) and the last evaluation.

`python -m rtc_mjx.report RUN... --out DIR` writes table.md, curves.png, overview.png, and results in one JSON file a method:
evaluation.json with the settings.
"""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.markdown import Markdown

from rtc_mjx import cli
from rtc_mjx import config as settings
from rtc_mjx.errors import UsageError
from rtc_mjx.runs import Run

LOSSES = ("reconstruction", "cloning", "adversarial", "type_kl", "accuracy_expert", "accuracy_policy")


def evaluation(run: Run) -> dict[str, Any]:
    """The run's evaluation.json.

    Raises:
        UsageError: it has not been evaluated.
    """
    file = run.folder / "evaluation.json"
    if not file.is_file():
        raise UsageError(f"{run.folder} has no evaluation.json; make it with: python -m rtc_mjx.evaluate --run {run.folder}")
    try:
        held = json.loads(file.read_text())
    except ValueError as error:
        raise UsageError(f"{file} is damaged: {error}") from error
    if not isinstance(held, dict) or not {"metrics", "types", "reference", "update", "seeds", "episodes", "asked", "commit"} <= set(held):
        raise UsageError(f"{file} is of another version; make it again with: python -m rtc_mjx.evaluate --run {run.folder}")
    return held


def table(runs: Mapping[str, Run]) -> str:
    """A Markdown table of runs by name: a row under prior types; paired and shuffled where there are such; the expert below."""
    results = [evaluation(run) for run in runs.values()]
    names = list(results[0]["metrics"])
    rows = [["method", "types", *names], ["---", "---", *["---:"] * len(names)]]
    for label, result in zip(runs, results, strict=True):
        for source, summary in result["types"].items():
            rows.append([label, source, *(_cell(summary[name]) for name in names)])
    for who, values in results[0]["reference"].items():
        rows.append([who.replace("_", " "), "", *(f"{values[name]:.4g}" for name in names)])
    first = results[0]
    caption = (
        f"Scene {first['scene']}; {_range(r['seeds'] for r in results)} seeds, {_range(r['update'] for r in results)} updates, "
        f"{_range(r['episodes'] for r in results)} test episodes. "
        "Mean ± standard deviation over seeds [95 % bootstrap interval over episodes]."
    )
    return "\n".join("| " + " | ".join(row) + " |" for row in rows) + f"\n\n{caption}\n"


def _cell(summary: dict[str, Any]) -> str:
    low, high = summary["interval"]
    return f"{summary['mean']:.4g} ± {summary['std']:.2g} [{low:.4g}, {high:.4g}]"


def _range(values: Any) -> str:
    ordered = sorted(set(values))
    return str(ordered[0]) if len(ordered) == 1 else f"{ordered[0]} to {ordered[-1]}"


def curves(runs: Sequence[Run], file: Path) -> None:
    """Main metrics and losses against updates, one line a method."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    main = runs[0].config.scene.main_metrics
    panels = [*main, *(n for n in LOSSES if any(n in line for run in runs for line in run.metrics()[:1]))]
    columns = min(4, len(panels))
    canvas, axes = pyplot.subplots(
        -(-len(panels) // columns), columns, figsize=(3.4 * columns, 2.6 * -(-len(panels) // columns)), squeeze=False
    )
    for axis, name in zip(axes.flat, panels, strict=False):
        for index, run in enumerate(runs):
            lines = [line for line in run.metrics() if name in line]
            if not lines:
                continue
            updates, values = [line["update"] for line in lines], np.array([line[name] for line in lines])
            mean, spread = values.mean(axis=1), values.std(axis=1, ddof=1) if values.shape[1] > 1 else np.zeros(len(values))
            axis.plot(updates, mean, color=f"C{index}", label=run.config.method, lw=1.4)
            axis.fill_between(updates, mean - spread, mean + spread, color=f"C{index}", alpha=0.15, lw=0)
        if name.startswith("jsd"):
            axis.set_yscale("log")
        axis.set_title(name.replace("_", " "), fontsize=10)
        axis.grid(alpha=0.25)
    for axis in axes.flat[len(panels) :]:
        axis.axis("off")
    for axis in axes[-1]:
        axis.set_xlabel("updates")
    handles, labels = axes[0][0].get_legend_handles_labels()
    canvas.tight_layout(rect=(0, 0.06, 1, 1))
    if handles:
        canvas.legend(handles, labels, loc="lower center", ncol=len(labels), frameon=False, fontsize=9)
    canvas.savefig(file, dpi=150)
    pyplot.close(canvas)


def overview(runs: Mapping[str, Run], file: Path) -> None:
    """Each method as an arrow, from its encoder's types of the same episode to those it draws at test time; methods without, as a point.

    Upwards and downwards: the scene's first main metric. To the right: how badly the agents cover what experts do. Dots are seeds.
    """
    from matplotlib.figure import Figure

    scene = next(iter(runs.values())).config.scene
    across, up = scene.coverage, scene.main_metrics[0]
    canvas = Figure(figsize=(6.4, 4.2), layout="constrained")
    axes = canvas.subplots()
    results = {name: evaluation(run) for name, run in runs.items()}
    for index, (name, result) in enumerate(results.items()):
        x, y = (np.array(result["metrics"][metric]["per_seed"]) for metric in (across, up))
        axes.plot(x, y, ".", color=f"C{index}", markersize=4, alpha=0.5)
        axes.plot(x.mean(), y.mean(), "o", color=f"C{index}", markersize=7, label=name)
        if paired := result["types"].get("paired"):
            tail = (paired[across]["mean"], paired[up]["mean"])
            axes.annotate("", (x.mean(), y.mean()), tail, arrowprops={"arrowstyle": "->", "color": f"C{index}", "shrinkA": 3, "shrinkB": 4})
            axes.plot(*tail, "o", color=f"C{index}", markersize=6, markerfacecolor="white")
    expert = next(iter(results.values()))["reference"]["expert"]
    axes.plot(expert[across], expert[up], "*", color="k", markersize=11, label="expert")
    axes.plot([], [], "o", color="0.4", markerfacecolor="white", markersize=6, label="types of the same episode")
    axes.set(xlabel=across.replace("_", " "), ylabel=up.replace("_", " "))
    if across.startswith("jsd"):
        axes.set_xscale("symlog", linthresh=1e-3)
        axes.set_xlim(left=-2e-4)
    axes.grid(alpha=0.25)
    axes.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    canvas.savefig(file, dpi=150)


def record(run: Run) -> dict[str, Any]:
    """The evaluation with all that is needed to make it again."""
    return {**evaluation(run), "config": settings.to_dict(run.config)}


def main(argv: Sequence[str] | None = None) -> None:
    """Reports on runs."""
    parser = cli.Parser(prog="python -m rtc_mjx.report", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN", help="run directories of one scene, evaluated")
    parser.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="where the table, the figure and the results go; made if absent"
    )
    options = parser.parse_args(argv)
    runs = [Run.open(folder) for folder in options.runs]
    scenes = {run.config.scene.name for run in runs}
    if len(scenes) > 1:
        raise UsageError(f"runs of one scene are needed, these are of {', '.join(sorted(scenes))}")
    methods = [run.config.method for run in runs]
    twice = [m for m in methods if methods.count(m) > 1]
    if twice:
        raise UsageError(f"one run a method is needed; there are {methods.count(twice[0])} of {twice[0]}")
    records = [record(run) for run in runs]
    options.out.mkdir(parents=True, exist_ok=True)
    text = table(dict(zip(methods, runs, strict=True)))
    (options.out / "table.md").write_text(text)
    curves(runs, options.out / "curves.png")
    overview(dict(zip(methods, runs, strict=True)), options.out / "overview.png")
    for held in records:
        (options.out / f"{held['method']}.json").write_text(json.dumps(held, indent=1) + "\n")
    cli.console().print(Markdown(text))


if __name__ == "__main__":
    cli.run(main)
