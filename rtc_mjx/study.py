"""Methods and seeds on a scene, and variations of RTC, as evidence: `python -m rtc_mjx.study --scene double_goal --results results`.

    entries (methods, variations) -> a run each (new, resumed or finished) -> evaluation -> table, curves, comparisons, claims

All seeds of an entry are one program. What is finished is not done again, so a study that was stopped at any moment goes on where it
was, and ends with the numbers of one that was never stopped.
"""

import argparse
import json
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markdown import Markdown

from rtc_mjx import cache, claims, cli, config, evaluate, report, train
from rtc_mjx.cluster import joined
from rtc_mjx.errors import DivergedError, RunError, UsageError
from rtc_mjx.files import write_whole
from rtc_mjx.methods import METHODS, method_name
from rtc_mjx.runs import Run
from rtc_mjx.scenes import scene_type
from rtc_mjx.team import ALONE, Team

COMMAND = "python -m rtc_mjx.study"
VARIED = "rtc_c"  # the method whose parts are varied
VARIATIONS: Mapping[str, tuple[Any, ...]] = {  # option -> values beside the committed one
    "encoder-share": (0.125, 0.25, 0.5, 0.75),
    "losses.adversarial": (1.0, 3.0, 20.0),
    "losses.type-kl": (0.00003, 0.003, 0.03),
    "model.type-size": (1, 2, 4, 16),
    "losses.kl-direction": ("prior_posterior",),
    "optimiser.gradient": ("dynamics_only", "none"),
}


TABLES = ("table", "comparisons", "claims", "ablations")


@dataclass(frozen=True)
class Entry:
    """One training of the study.

    Attributes:
        name: of its run and its results.
        method: which method.
        options: what differs from the committed settings, as on the command line.
    """

    name: str
    method: str
    options: tuple[str, ...] = ()


def entries(scene: str, methods: Sequence[str], ablate: bool, options: Sequence[str]) -> list[Entry]:
    """What a study trains: the methods, then, if wanted, the variations of RTC's parts."""
    held = [Entry(name, name, tuple(options)) for name in methods]
    if ablate:
        committed = config.flat(config.to_dict(config.from_command_line(["--scene", scene, "--method", VARIED, *options], COMMAND)))
        for option, values in VARIATIONS.items():
            others = [v for v in values if v != committed[option.replace("-", "_")]]
            held += [Entry(f"{VARIED},{option}={v}", VARIED, (*options, f"--{option}", str(v))) for v in others]
    return held


def on_scene(scene: str, options: Sequence[str]) -> list[str]:
    """The methods that can run on a scene with these options."""
    held = config.from_command_line(["--scene", scene, "--method", "bc", *options], COMMAND).scene
    return [name for name, method in METHODS.items() if method.kind != "label" or held.labelled.labels]


def complete(entry: Entry, scene: str, folder: Path, team: Team = ALONE) -> Run:
    """The entry's run, trained to its last update and evaluated there; only what is missing is done.

    Of several processes the first says what is missing, and evaluates.
    """
    if team.leads:
        make_way(folder)
    again = ["--resume"] if team.of_first(folder.is_dir()) else []
    argv = ["--scene", scene, "--method", entry.method, "--run", str(folder), *entry.options, *again]
    settings = config.from_command_line(argv, COMMAND)
    run = Run.open(folder) if again else None
    if team.of_first(run is None or settings.updates not in run.checkpoints()) or run is None:
        run = train.train(settings, team)
    if team.leads and not _evaluated(run):
        evaluate.main(["--run", str(folder)])
    return run


def make_way(folder: Path) -> None:
    """Takes away what was stopped before it was begun.

    Raises:
        UsageError: something else stands there.
    """
    if folder.is_dir() and not (folder / "config.json").is_file():
        if any(not part.name.startswith(".") for part in folder.iterdir()):
            raise UsageError(f"{folder} is in the way: it is not a run directory")
        shutil.rmtree(folder)


def whole_or_small(scene: str, methods: Sequence[str], folder: Path, small: Sequence[str]) -> dict[str, Run]:
    """The finished runs in a folder by method; where one is missing, small ones of all, trained here in a new folder.

    Args:
        scene: of the runs.
        methods: their names.
        folder: where a study keeps its runs of the scene.
        small: options of the small trainings.
    """
    if not all((folder / name / "evaluation.json").is_file() for name in methods):
        folder = Path(tempfile.mkdtemp())
        return {name: complete(Entry(name, name, tuple(small)), scene, folder / name) for name in methods}
    return {name: Run.open(folder / name) for name in methods}


def _evaluated(run: Run) -> bool:
    """Whether the evaluation is that of the last update, on all test episodes of the settings."""
    if not (run.folder / "evaluation.json").is_file():
        return False
    held = report.evaluation(run)
    return bool(held["update"] == run.config.updates and held["asked"] == run.config.experts.test)


def write(scene: str, runs: Mapping[str, Run], out: Path) -> str:
    """Writes results, tables and figures; returns the tables."""
    methods = {name: run for name, run in runs.items() if name == run.config.method}
    varied = {name: run for name, run in runs.items() if name not in methods}
    out.mkdir(parents=True, exist_ok=True)
    parts = dict.fromkeys(TABLES, "")
    if methods:
        report.curves(list(methods.values()), out / "curves.png")
        report.overview(methods, out / "overview.png")
        parts |= {"table": report.table(methods), "comparisons": claims.comparisons(methods), "claims": claims.claims(scene, methods)}
    if varied:
        parts["ablations"] = report.table({name: run for name, run in runs.items() if name == VARIED or name in varied})
    for name, part in parts.items():
        if part:
            write_whole(out / f"{name}.md", part)
        else:
            (out / f"{name}.md").unlink(missing_ok=True)  # of other runs
    for name, run in runs.items():
        write_whole(out / f"{name}.json", json.dumps(report.record(run), indent=1) + "\n")
    return "\n".join(part for part in parts.values() if part)


def main(argv: Sequence[str] | None = None) -> None:
    """Runs or goes on with a study."""
    parser = cli.Parser(prog=COMMAND, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False)
    parser.add_argument("--scene", required=True, metavar="NAME", help="the scene")
    parser.add_argument("--methods", metavar="A,B", help="methods, separated by commas (default: all that run on the scene)")
    parser.add_argument("--seeds", type=int, default=20, metavar="N", help="seeds of each entry, trained in one program (default: 20)")
    parser.add_argument("--ablations", action="store_true", help=f"also vary the parts of {VARIED}: {', '.join(VARIATIONS)}")
    parser.add_argument("--results", type=Path, required=True, metavar="DIR", help="tables and figures go to DIR/<name>; made if absent")
    parser.add_argument("--name", metavar="NAME", help="of the study, where a scene has several (default: the scene's)")
    parser.add_argument("--runs", type=Path, metavar="DIR", help="where the runs are kept (default: runs/study)")
    options, rest = parser.parse_known_args(argv)
    scene_type(options.scene)
    chosen = [method_name(name) for name in options.methods.split(",")] if options.methods else on_scene(options.scene, rest)
    if options.ablations and VARIED not in chosen:
        chosen.append(VARIED)  # what variations are compared with
    cache.keep_compiled()
    name = options.name or options.scene
    if Path(name).name != name:
        raise UsageError(f"--name {name}: a name is needed, not a path")
    folder, out = (options.runs or Path("runs/study")) / name, options.results / name
    wanted = entries(options.scene, chosen, options.ablations, ["--seeds", str(options.seeds), *rest])
    first = config.from_command_line(["--scene", options.scene, "--method", chosen[0], *wanted[0].options], COMMAND)
    told = {**train.agreed(first), "--methods": ",".join(chosen), "--ablations": options.ablations, "--runs": str(folder)}
    with joined(first.hardware, told) as team:
        text, failed = conduct(options.scene, wanted, folder, out, team)
        if team.leads:
            cli.console().print(Markdown(text))
    if failed:
        raise RunError("; ".join(f"{name} failed: {error}" for name, error in failed.items()))


def conduct(scene: str, wanted: Sequence[Entry], folder: Path, out: Path, team: Team) -> tuple[str, dict[str, RunError]]:
    """Completes all entries; returns the tables, in the first process, and which entries failed."""
    runs: dict[str, Run] = {}
    failed: dict[str, RunError] = {}
    text = ""
    for number, entry in enumerate(wanted, 1):
        if team.leads:
            Console(stderr=True).print(f"[{number}/{len(wanted)}] {entry.name}", markup=False)
        try:
            runs[entry.name] = complete(entry, scene, folder / entry.name, team)
        except RunError as error:  # such as a seed that diverged: the other entries do not depend on it
            if team.links and not isinstance(error, DivergedError):
                raise  # that is not known in all processes
            failed[entry.name] = error
            Console(stderr=True).print(f"{entry.name}: {error}", markup=False)
            continue
        if team.leads:
            text = write(scene, runs, out)  # after each: a study that is stopped leaves what it has
    return text, failed


if __name__ == "__main__":
    cli.run(main)
