"""Methods and seeds on a scene, and variations of RTC, as evidence: `python -m rtc_mjx.study --scene double_goal --results results`.

    entries (methods, variations) -> a run each (new, resumed or finished) -> evaluation, analysis of types -> results/<name>/<entry>.json
    -> tables and figures of all that is in results/<name> (`rtc_mjx.report`)

All seeds of an entry are one program. What is finished is not done again, so a study that was stopped at any moment goes on where it
was, and ends with the numbers of one that was never stopped; with more `--seeds` than before it trains those that are missing. Results of
other commands in the same folder stay beside them.
"""

import argparse
import contextlib
import fcntl
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markdown import Markdown

from rtc_mjx import cache, cli, config, report, results, train
from rtc_mjx.cluster import joined
from rtc_mjx.entry import COMMAND, Entry, check_there, complete, evaluated, resolved
from rtc_mjx.errors import DivergedError, RunError, UsageError
from rtc_mjx.methods import METHODS, method_name
from rtc_mjx.runs import Run
from rtc_mjx.scenes import scene_type
from rtc_mjx.team import Team
from rtc_mjx.trained import trained

VARIATIONS: Mapping[str, tuple[str, tuple[Any, ...]]] = {  # option -> method, values beside the committed one
    "encoder-share": ("rtc_c", (0.125, 0.25, 0.5, 0.75)),
    "losses.adversarial": ("rtc_c", (1.0, 3.0, 20.0)),
    "losses.type-kl": ("rtc_c", (0.00003, 0.003, 0.03)),
    "model.type-size": ("rtc_c", (1, 2, 4, 16)),
    "model.type-count": ("rtc_d", (2, 4, 16, 32)),
    "losses.kl-direction": ("rtc_c", ("prior_posterior",)),
    "losses.fakes": ("rtc_c", ("all", "test")),
    "optimiser.gradient": ("rtc_c", ("dynamics_only", "none")),
}


def entries(scene: str, methods: Sequence[str], ablate: bool, options: Sequence[str]) -> list[Entry]:
    """What a study trains: the methods, then, if wanted, the variations of RTC's parts."""
    held = [Entry(name, name, tuple(options)) for name in methods]
    for option, (method, values) in VARIATIONS.items() if ablate else ():
        committed = config.flat(config.to_dict(resolved(Entry(method, method, tuple(options)), scene)))[option.replace("-", "_")]
        held += [Entry(f"{method},{option}={v}", method, (*options, f"--{option}", str(v))) for v in values if v != committed]
    return held


def on_scene(scene: str, options: Sequence[str]) -> list[str]:
    """The methods that can run on a scene with these options."""
    held = config.from_command_line(["--scene", scene, "--method", "bc", *options], COMMAND).scene
    return [name for name, method in METHODS.items() if method.kind != "label" or held.labelled.labels]


def whole_or_small(scene: str, methods: Sequence[str], folder: Path, small: Sequence[str]) -> dict[str, Run]:
    """The finished runs in a folder by method; where one is missing or is of other code, small ones of all, trained here in a new folder.

    Args:
        scene: of the runs.
        methods: their names.
        folder: where a study keeps its runs of the scene.
        small: options of the small trainings.
    """
    if all((folder / name / "evaluation.json").is_file() for name in methods):
        runs = {name: Run.open(folder / name) for name in methods}
        try:
            for run in runs.values():
                trained(run)
        except UsageError as error:  # such as one whose networks had other inputs
            Console(stderr=True).print(f"small trainings instead: {error}", markup=False)
        else:
            return runs
    folder = Path(tempfile.mkdtemp())
    return {name: train.train(resolved(Entry(name, name, tuple(small)), scene, "--run", str(folder / name))) for name in methods}


def write(runs: Mapping[str, Run], folder: Path, out: Path, pending: bool = False) -> str:
    """Writes results of runs beside those that are there, then all tables and figures of the folder; returns the tables."""
    with alone(folder):
        for name, run in runs.items():
            results.write(out, name, results.of_run(run, out.name))
        return rewritten(out, pending)


def write_failure(name: str, scene: str, error: RunError, folder: Path, out: Path, pending: bool) -> str:
    """Writes that an entry failed, then all tables and figures of the folder; returns the tables."""
    with alone(folder):
        results.write_failure(out, name, scene, error)
        return rewritten(out, pending)


def rewritten(out: Path, pending: bool) -> str:
    """All tables and figures of a folder of results, and the claims of all such folders."""
    text = report.rebuild(out, pending)
    report.rebuild_claims(out.parent)
    return text


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """While open, no other process of the study writes results: it waits."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def collected(wanted: Sequence[Entry], scene: str, folder: Path) -> dict[str, Run]:
    """Runs of the study that have all their seeds and are evaluated at their last update, of this command and of others before it.

    Raises:
        UsageError: a run of an entry has other settings than the entry, or seeds beside those of the entry.
    """
    settings = {entry.name: resolved(entry, scene, "--run", str(folder / entry.name)) for entry in wanted}
    ours = next(iter(settings.values())).scene
    for held in settings.values():
        check_there(held)
    found = {}
    for place in sorted(folder.iterdir()) if folder.is_dir() else []:
        if not (place / "config.json").is_file():
            continue
        try:
            run = Run.open(place)
            if place.name not in settings and (run.config.scene != ours or run.config.method != place.name.partition(",")[0]):
                continue  # not of this study
            if place.name in settings and run.config.all_seeds != settings[place.name].all_seeds:
                continue  # others are to come: a result that is there may be of all
            if evaluated(run, now=False):
                found[place.name] = run
        except UsageError as error:
            if place.name in settings:
                raise
            Console(stderr=True).print(f"left out: {error}", markup=False)
    return found


def main(argv: Sequence[str] | None = None) -> None:
    """Runs or goes on with a study."""
    more = "Every other option is one of `python -m rtc_mjx.train` (--first-seed, --updates, --losses. ...) and goes to each entry."
    parser = cli.Parser(prog=COMMAND, description=__doc__, epilog=more, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", required=True, metavar="NAME", help="the scene")
    parser.add_argument("--methods", metavar="A,B", help="methods, separated by commas (default: all that run on the scene)")
    parser.add_argument("--seeds", type=int, default=20, metavar="N", help="seeds of each entry; those there are kept (default: 20)")
    parser.add_argument("--ablations", action="store_true", help=f"also vary the parts of RTC: {', '.join(VARIATIONS)}")
    parser.add_argument("--results", type=Path, required=True, metavar="DIR", help="tables and figures go to DIR/<name>; made if absent")
    parser.add_argument("--name", metavar="NAME", help="of the study, where a scene has several (default: the scene's)")
    parser.add_argument("--runs", type=Path, metavar="DIR", help="where the runs are kept (default: runs/study)")
    options, rest = parser.parse_known_args(argv)
    cli.refuse(
        rest, COMMAND, method="name methods with --methods A,B", run="--runs DIR is where runs are kept", resume="a study goes on by itself"
    )
    scene_type(options.scene)
    chosen = [method_name(name.strip()) for name in options.methods.split(",")] if options.methods else on_scene(options.scene, rest)
    if options.ablations:  # what variations are compared with
        chosen += [method for method in dict.fromkeys(method for method, _ in VARIATIONS.values()) if method not in chosen]
    cache.keep_compiled()
    name = options.name or options.scene
    if Path(name).name != name or name == "..":
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
    failed: dict[str, RunError] = {}
    text = ""
    if team.leads:
        report.made(out)
        if there := collected(wanted, scene, folder):  # before hours of training: what is known now is shown now
            text = write(there, folder, out, pending=True)
    for number, entry in enumerate(wanted, 1):
        pending = number < len(wanted)
        if team.leads:
            Console(stderr=True).print(f"[{number}/{len(wanted)}] {entry.name}", markup=False)
        try:
            run = complete(entry, scene, folder / entry.name, team)
        except RunError as error:  # such as a seed that diverged: the other entries do not depend on it
            if team.links and not isinstance(error, DivergedError):
                raise  # that is not known in all processes
            failed[entry.name] = error
            Console(stderr=True).print(f"{entry.name}: {error}", markup=False)
            if team.leads:
                text = write_failure(entry.name, scene, error, folder, out, pending)
            continue
        if team.leads:
            text = write({entry.name: run}, folder, out, pending)  # after each: a study that is stopped leaves what it has
    return text, failed


if __name__ == "__main__":
    cli.run(main)
