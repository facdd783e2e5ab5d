"""One training of a study: trained to its end, evaluated, its types analysed; what is done and still holds is not done again."""

import dataclasses
import shutil
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from rtc_mjx import config, evaluate, provenance, results, train, type_shift
from rtc_mjx.config import Config
from rtc_mjx.errors import DivergedError, RunError, UsageError
from rtc_mjx.runs import Run, unbegun
from rtc_mjx.team import ALONE, Team

COMMAND = "python -m rtc_mjx.study"
EXPERTS = 32  # of an episode, in conditional realism


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


def resolved(entry: Entry, scene: str, *placed: str) -> Config:
    """The settings of an entry, as the command line and the committed files say; not those of a run that is there."""
    return config.from_command_line(["--scene", scene, "--method", entry.method, *entry.options, *placed], COMMAND)


def complete(entry: Entry, scene: str, folder: Path, team: Team = ALONE, analysed: bool = True) -> Run:
    """The entry's run, trained to its last update, evaluated and analysed there; only what is missing is done.

    Of several processes the first says what is missing, and measures.

    Raises:
        UsageError: the run that is there has other settings.
        DivergedError: what was learned, or a test rollout, is not finite.
        RunError: the last checkpoint cannot be read, also after it was made once more.
    """
    if team.leads:
        make_way(folder)
    settings = resolved(entry, scene, "--run", str(folder))
    run = Run.open(folder) if team.of_first((folder / "config.json").is_file()) else None
    if run is not None:
        check_same(settings, run)
    for _ in range(2):
        if team.of_first(run is None or settings.updates not in run.checkpoints()) or run is None:
            run = train.train(dataclasses.replace(settings, resume=run is not None), team)
        update = measured_together(run, team, analysed)
        if update == settings.updates:
            return run
        if team.leads:
            Console(stderr=True).print(f"{folder}: the last checkpoint cannot be read; training goes on from update {update}", markup=False)
            run.set_aside_after(update)
    raise RunError(f"{folder}: the checkpoint of update {settings.updates} cannot be read, though it was made twice")


def check_same(wanted: Config, run: Run) -> None:
    """That a run has the settings wanted, all that its method reads.

    Raises:
        UsageError: it has not; the first that differs, with both values.
    """
    ours, theirs = (config.flat(config.to_dict(held)) for held in (wanted, run.config))
    for name in [name for name in ours if ours[name] != theirs.get(name) and name not in config.unread(run.config.method)]:
        option = f"--{name.replace('_', '-')}"
        raise UsageError(
            f"{option} {ours[name]} is wanted: the run in {run.folder} has {theirs.get(name)}; give {option} {theirs.get(name)}, "
            "or another --name for another study"
        )


def make_way(folder: Path) -> None:
    """Takes away what was stopped before it was begun.

    Raises:
        UsageError: something else stands there.
    """
    if folder.is_dir() and not (folder / "config.json").is_file():
        if not unbegun(folder):
            raise UsageError(f"{folder} is in the way: it is not a run directory")
        shutil.rmtree(folder)


def measured_together(run: Run, team: Team, analysed: bool) -> int:
    """The update at which the first process has measured a run, in all processes.

    Raises:
        DivergedError: a test rollout is not finite, in all processes.
    """
    told: tuple[int, str] = (0, "")
    if team.leads:
        try:
            told = (measured(run, analysed), "")
        except DivergedError as error:
            told = (0, str(error))
    update, error_text = team.of_first(told)
    if error_text:
        raise DivergedError(error_text)
    return int(update)


def measured(run: Run, analysed: bool) -> int:
    """Evaluates a run and analyses its types, where that is not done; returns the update at which it was, the earlier if they differ."""
    if not evaluated(run):
        evaluate.main(["--run", str(run.folder)])
    found = results.evaluation(run)
    if not analysed or found["update"] != run.config.updates:
        return int(found["update"])
    if not shift_found(run, found["episodes"]):
        try:
            type_shift.main(["--run", str(run.folder), "--experts", str(EXPERTS)])
        except UsageError as error:  # such as too few test episodes: the evaluation stands without it
            Console(stderr=True).print(f"no analysis of types: {error}", markup=False)
            return int(found["update"])
    return int(min(found["update"], results.analysis(run)["update"]))


def evaluated(run: Run, now: bool = True) -> bool:
    """Whether the evaluation is that of the last update, on all test episodes of the settings; `now`: by the code there is now, too."""
    if not (run.folder / "evaluation.json").is_file():
        return False
    held = results.evaluation(run)
    whole = (held["update"], held["asked"]) == (run.config.updates, run.config.experts.test)
    return whole and (not now or held.get("measured_by") == provenance.measured_by())


def shift_found(run: Run, episodes: int) -> bool:
    """The same of the analysis of types, on as many episodes as were evaluated, and on as many experts as it should be."""
    held = results.analysis(run)
    if (held.get("update"), held.get("episodes"), held.get("measured_by")) != (run.config.updates, episodes, provenance.measured_by()):
        return False
    return "realism" not in held or held["realism"]["experts"] == EXPERTS
