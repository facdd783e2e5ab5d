"""One training of a study: trained to its end, evaluated, its types analysed; what is done and still holds is not done again."""

import dataclasses
import functools
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from rtc_mjx import blocks, config, evaluate, provenance, results, train, type_shift
from rtc_mjx.config import Config
from rtc_mjx.errors import DivergedError, RunError, UsageError
from rtc_mjx.runs import Follower, Run, unbegun
from rtc_mjx.team import ALONE, Team
from rtc_mjx.trained import trained

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
    """The entry's run, trained to its last update, evaluated and analysed there; only what is missing is done, and only seeds that are.

    Of several processes the first says what is missing, and measures.

    Raises:
        UsageError: the run that is there has other settings, or seeds beside those wanted.
        DivergedError: what was learned, or a test rollout, is not finite.
        RunError: the last checkpoint cannot be read, also after it was made once more.
    """
    settings = resolved(entry, scene, "--run", str(folder))
    if team.leads:
        make_way(folder)
        check_there(settings)
    if team.of_first(team.leads and bool(blocks.to_join(settings))):
        extend(settings, team)
    run = finished(settings, team, functools.partial(measured, analysed=analysed))
    if team.leads:
        blocks.keep(run)
    return run


def extend(settings: Config, team: Team) -> None:
    """Trains the seeds that a run lacks, and puts a run of all of them in its place.

    Raises:
        UsageError: another process is doing that.
        DivergedError: what was learned is not finite.
        RunError: the last checkpoint of a block cannot be read, also after it was made once more.
    """
    home = blocks.waiting(settings.folder)
    if team.leads:
        home.mkdir(parents=True, exist_ok=True)
    with (Run if team.leads else Follower)(home, settings).lock():
        parts = [(str(of.folder), of.first_seed, of.seeds) for of in blocks.to_join(settings)] if team.leads else []
        held = []
        for place, first, count in team.of_first(parts):
            wanted = blocks.part(settings, range(first, first + count), Path(place))
            if team.leads:
                make_way(wanted.folder)
                _say(f"{settings.folder.name}: seeds {first} to {first + count - 1} in {place}")
            held.append(finished(wanted, team, lambda run: trained(run).update))
        if held and team.leads:
            blocks.put(held, settings.folder)


def finished(settings: Config, team: Team, measure: Callable[[Run], int]) -> Run:
    """The run of these settings, trained to its last update.

    Args:
        settings: and its folder.
        team: the processes that train it, all of which call this.
        measure: reads the last checkpoint, in the first process; returns its update.

    Raises:
        DivergedError: what was learned, or a test rollout, is not finite.
        RunError: the last checkpoint cannot be read, also after it was made once more.
    """
    for _ in range(2):
        run = trained_through(settings, team)
        update = measured_together(run, team, measure)
        if update == settings.updates:
            return run
        if team.leads:
            _say(f"{run.folder}: the last checkpoint cannot be read; training goes on from update {update}")
            run.set_aside_after(update)
    raise RunError(f"{settings.folder}: the checkpoint of update {settings.updates} cannot be read, though it was made twice")


def trained_through(settings: Config, team: Team) -> Run:
    """The run of these settings, new, resumed or as it is; other processes than the first need not see it."""
    begun, done = team.of_first(_progress(settings.folder) if team.leads else None)
    if not done:
        train.train(dataclasses.replace(settings, resume=begun), team)
    return Run.open(settings.folder) if team.leads else Follower(settings.folder, settings)


def _progress(folder: Path) -> tuple[bool, bool]:
    """Whether a run was begun in a folder, and whether it has its last checkpoint."""
    if not (folder / "config.json").is_file():
        return False, False
    run = Run.open(folder)
    return True, run.config.updates in run.checkpoints()


def check_there(wanted: Config) -> None:
    """That the run in the folder, and the blocks of its seeds that wait, can be gone on with.

    Raises:
        UsageError: one of them has other settings, or seeds beside those wanted.
    """
    for run in blocks.there(wanted.folder):
        if run.folder == wanted.folder or not blocks.apart(run.config.all_seeds, wanted.all_seeds):
            check_same(wanted, run)


def check_same(wanted: Config, run: Run) -> None:
    """That a run has the settings wanted, all that its method reads, and all or some of the seeds.

    Raises:
        UsageError: it has not; the first that differs, with both values.
    """
    for name, ours, theirs in config.differing(wanted, run.config):
        option = f"--{name.replace('_', '-')}"
        raise UsageError(
            f"{option} {ours} is wanted: the run in {run.folder} has {theirs}; give {option} {theirs}, or another --name for another study"
        )
    ours, theirs = wanted.all_seeds, run.config.all_seeds
    if not blocks.inside(theirs, ours):
        both = range(min(ours.start, theirs.start), max(ours.stop, theirs.stop))
        raise UsageError(
            f"--first-seed {ours.start} --seeds {len(ours)} is wanted: the run in {run.folder} has seeds {theirs[0]} to {theirs[-1]}, "
            f"not all of them wanted; give --first-seed {both.start} --seeds {len(both)} for all, or another --name for another study"
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


def measured_together(run: Run, team: Team, measure: Callable[[Run], int]) -> int:
    """The update at which the first process has measured a run, in all processes.

    Raises:
        DivergedError: a test rollout is not finite, in all processes.
    """
    told: tuple[int, str] = (0, "")
    if team.leads:
        try:
            told = (measure(run), "")
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
            _say(f"no analysis of types: {error}")
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
    """Whether the analysis of types is that of the last update, by this code, on as many episodes and experts as it should be."""
    held = results.analysis(run)
    if (held.get("update"), held.get("episodes"), held.get("measured_by")) != (run.config.updates, episodes, provenance.measured_by()):
        return False
    return "realism" not in held or held["realism"]["experts"] == EXPERTS


def _say(line: str) -> None:
    Console(stderr=True).print(line, markup=False)
