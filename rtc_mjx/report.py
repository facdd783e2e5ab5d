"""Tables and figures of results: `python -m rtc_mjx.report results/double_goal` makes all of them again, from the JSON files alone.

`python -m rtc_mjx.report RUN... --out DIR` first takes the results of runs: a JSON file a method, then the same tables and figures:
table.md, comparisons.md, claims.md, type_shift.md, conditional_realism.md, sim_agents.md, ablations.md, curves.png, overview.png,
type_shift.png, conditional_realism.png, ablations.png, as far as there is something to show. Beside results of several studies, claims.md
of all of them.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from rich.markdown import Markdown

from rtc_mjx import charts, claims, cli, results, tables
from rtc_mjx.errors import UsageError
from rtc_mjx.files import write_whole
from rtc_mjx.results import Record
from rtc_mjx.runs import Run, by_method

CLAIMS = "claims.md"
TABLES: Mapping[str, Callable[[Mapping[str, Record], str], str]] = {
    "table": tables.performance,
    "comparisons": tables.comparisons,
    "claims": lambda held, study: with_source(held, study, claims.table(next(iter(held.values()))["scene"], held)),
    "type_shift": tables.type_shift,
    "conditional_realism": tables.conditional_realism,
    "sim_agents": tables.sim_agents,
    "ablations": tables.ablations,
}


def with_source(held: Mapping[str, Record], study: str, text: str) -> str:
    """A table with the commands that make its rows below."""
    return f"{text}\n{tables.made_by(results.finished(held), study)}" if text and results.finished(held) else ""


def rebuild(folder: Path, pending: bool = False) -> str:
    """Writes all tables and figures of the results in a folder; returns the tables.

    Args:
        folder: results/<name>.
        pending: more results are to come; a table that has nothing to say now is left as it is.

    Raises:
        UsageError: there are no results, or a file is damaged.
    """
    held = results.read(folder)
    if not held:
        raise UsageError(f"{folder} holds no results; they are JSON files that `python -m rtc_mjx.study` or `report RUN... --out` write")
    study = folder.resolve().name
    parts = {name: table(held, study) for name, table in TABLES.items()}
    for name, part in parts.items():
        if part:
            write_whole(folder / f"{name}.md", part)
        elif not pending:
            (folder / f"{name}.md").unlink(missing_ok=True)  # what it told is not in the results
    if whole := results.finished(held):
        draw(whole, folder)
    return "\n".join(part for part in parts.values() if part)


def draw(whole: Mapping[str, Record], folder: Path) -> None:
    """Writes the figures."""
    methods = results.methods(whole)
    if methods:
        charts.curves(methods, folder / "curves.png")
        charts.overview(methods, folder / "overview.png")
        charts.type_shift(methods, folder / "type_shift.png")
    charts.realism(methods, folder / "conditional_realism.png")
    charts.ablations(whole, folder / "ablations.png")


def rebuild_claims(folder: Path) -> None:
    """Writes claims.md of all results in folders beside each other."""
    if text := claims.everywhere(folder):
        write_whole(folder / CLAIMS, text + f"\nMade by `python -m rtc_mjx.report {folder.resolve().name}` from results/*/*.json.\n")


def made(folder: Path) -> None:
    """Makes a folder for results, where it is not there.

    Raises:
        UsageError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}; a folder for results is needed") from error


def studies(folder: Path) -> list[Path]:
    """The folders of results in a folder."""
    return [place for place in sorted(folder.iterdir()) if place.is_dir() and results.read(place)]


def of_runs(runs: Sequence[Run], out: Path) -> str:
    """Takes results of runs and reports on them.

    Raises:
        UsageError: they are of several scenes, or two of one method, or one has not been evaluated.
    """
    records = {method: results.of_run(run) for method, run in by_method(runs).items()}
    made(out)
    if holds := studies(out):
        names = ", ".join(place.name for place in holds)
        raise UsageError(f"--out {out} holds studies ({names}); name a folder of its own, such as {out / 'mine'}")
    for method, record in records.items():
        results.write(out, method, record)
    return rebuild(out)


def of_results(folder: Path) -> str:
    """Makes tables and figures again of results/<name>, or of all that is in results."""
    if held := results.read(folder):
        text = rebuild(folder)
        if any("study" in record for record in held.values()):  # what `report` made of runs may stand anywhere
            rebuild_claims(folder.resolve().parent)
        return text
    places = studies(folder)
    if not places:
        raise UsageError(f"{folder} is not a run directory, and holds no results")
    text = "\n".join(f"# {place.name}\n\n{rebuild(place)}" for place in places)
    rebuild_claims(folder)
    return text


def main(argv: Sequence[str] | None = None) -> None:
    """Reports on results, or on runs."""
    parser = cli.Parser(prog="python -m rtc_mjx.report", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "places", nargs="+", type=Path, metavar="DIR", help="run directories of one scene, evaluated; or one folder of results, or of such"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="of runs: where results, tables and figures go; made if absent")
    options = parser.parse_args(argv)
    if options.out is not None:
        text = of_runs([Run.open(folder) for folder in options.places], options.out)
    elif len(options.places) == 1 and options.places[0].is_dir() and not (options.places[0] / "config.json").is_file():
        text = of_results(options.places[0])
    else:
        absent = [str(place) for place in options.places if not place.is_dir()]
        told = f"{', '.join(absent)}: no such folder; " if absent else ""
        raise UsageError(f"{told}one folder of results is needed, or runs and --out DIR")
    cli.console().print(Markdown(text))


if __name__ == "__main__":
    cli.run(main)
