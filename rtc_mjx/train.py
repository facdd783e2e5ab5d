"""Trains a method on a scene: `python -m rtc_mjx.train --scene double_goal --method rtc`.

    settings -> demonstrations -> state (resumed or new) -> chunks of updates, all seeds in one program -> metrics, checkpoints

All randomness is a function of seed and update, and what happens at an update does not depend on where the run was resumed: a
run that was killed and resumed writes the same metrics.jsonl (but for wall_s) as one that was not. Nor does it depend, but for
rounding, on the number of devices and processes (`--distributed`); of several processes the first alone writes and shows.
"""

import contextlib
import functools
import math
import signal
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from rtc_mjx import cache, cli, dataset, evaluate, provenance, reference, sharding
from rtc_mjx import config as settings
from rtc_mjx.cluster import joined
from rtc_mjx.config import Config
from rtc_mjx.errors import DivergedError, UsageError
from rtc_mjx.keys import stream
from rtc_mjx.learner import Learner
from rtc_mjx.methods import METHODS
from rtc_mjx.progress import Reporter
from rtc_mjx.runs import Follower, Run
from rtc_mjx.sharding import Grid
from rtc_mjx.team import ALONE, Team
from rtc_mjx.updates import TrainState, compiled_chunk, start_all, start_shapes


def train(config: Config, team: Team = ALONE) -> Run:
    """Trains, or goes on training; returns the run.

    Args:
        config: the settings.
        team: the processes that train together, all of which call this.

    Raises:
        UsageError: the run directory cannot be used, or the recordings.
        DivergedError: what is learned is not finite any more.
        RunError: a checkpoint could not be written.
        KeyboardInterrupt: interrupted; a checkpoint was saved first.
    """
    config = settings.check(config)
    config.scene.ready()
    compare_recordings(config, team)
    grid = devices(config, team)
    run = opened(config) if team.leads else Follower(config.folder, config)
    with run.lock():
        learn(run, config, grid, team)
    return run


def compare_recordings(config: Config, team: Team) -> None:
    """That all processes have the same recordings, each from its own machine's files.

    Raises:
        UsageError: they do not.
    """
    told = team.exchange(provenance.of_recordings(config.scene.recordings()))
    for process, theirs in enumerate(told):
        if theirs != told[0]:
            raise UsageError(f"{team.name(process)} has other recordings ({theirs}) than {team.name(0)} ({told[0]})")


def opened(config: Config) -> Run:
    """The run directory: an existing one to go on in, or a new one."""
    if not config.resume:
        return Run.create(config)
    run = Run.open(config.folder)
    run.check_recordings()
    return run


def learn(run: Run, config: Config, grid: Grid, team: Team) -> None:
    """The training loop.

    Args:
        run: its directory, made or opened.
        config: the settings.
        grid: the devices.
        team: the processes that train together.

    Raises:
        DivergedError: what is learned is not finite any more.
        RunError: a checkpoint could not be written.
        KeyboardInterrupt: interrupted; a checkpoint was saved first.
    """
    announce(run, team, "demonstrations")
    watch = evaluate.progress("demonstrations") if team.leads else iter
    expert = dataset.demonstrations(config.scene, config.experts.train, dataset.TRAIN, watch)
    learner = config.learner(dataset.statistics(config.scene, expert))
    state, update, before = begin_together(run, learner, config, team)
    if update < config.updates:
        run.note_trained_by(provenance.code())
        announce(run, team, "compiling")
    grid.connect()
    state, data = grid.by_seed(state), grid.everywhere(dataset.without_truth(expert))
    test, chunks = Tests(config, learner, grid), functools.cache(lambda length: compiled_chunk(learner, length, grid))
    started = time.perf_counter() - before
    with reporting(run, config, update, team) as report, Interruption() as interrupted:
        while update < config.updates:
            length = min(config.every.log, config.updates - update)
            state, seen = chunks(length)(state, data)
            update += length
            line: dict[str, Any] = {"update": update, "wall_s": time.perf_counter() - started, "env_steps": env_steps(learner, update)}
            line |= as_lists(grid.gathered(seen))
            check_finite(line, run)
            if update % config.every.test == 0 or update == config.updates:
                line |= test(state)
            run.log(line)  # before the checkpoint: what a crash leaves without one is written again
            stop = any(team.exchange(bool(interrupted)))
            if update % config.every.save == 0 or update == config.updates or stop:
                run.save(update, grid.gathered(state), line["wall_s"])
            report(line)
            if stop:
                team.exchange(None)  # the checkpoint is there
                raise KeyboardInterrupt


def announce(run: Run, team: Team, what: str) -> None:
    """Says what is done before there is anything to show of a training."""
    if team.leads:
        sys.stderr.write(f"{run.folder}: {what} (minutes, unless kept from before)\n")


def devices(config: Config, team: Team) -> Grid:
    """Where the training runs: on all devices of all processes, or on those of this machine that the work divides among.

    Raises:
        UsageError: the work does not divide among as many devices as there must be, or processes have unequal numbers of them.
    """
    local = team.exchange(jax.local_device_count())
    for process, count in enumerate(local):
        if count != local[0]:
            raise UsageError(f"{team.name(process)} has {count} devices, {team.name(0)} {local[0]}: all processes need as many")
    there = jax.devices()
    wanted = len(there) if config.hardware.distributed else config.hardware.devices
    rows = [branch.rows(config.batch, config.encoder_share) for branch in METHODS[config.method].branches]
    found = sharding.grid(there, config.seeds, [held.stop - held.start for held in rows], wanted)
    used = found.mesh.size if found.mesh else 1
    if used < (wanted or len(there)):
        sys.stderr.write(f"{used} of {len(there)} devices are used: seeds and minibatch do not divide among more\n")
    return found


def begin_together(run: Run, learner: Learner, config: Config, team: Team) -> tuple[TrainState, int, float]:
    """What `begin` finds in the first process, in all of them."""
    if team.leads:
        state, update, before = begin(run, learner, config)
    else:
        shapes = start_shapes(learner, config.all_seeds)
        state, update, before = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes), 0, 0.0
    update, before = team.of_first((update, before))
    return sharding.of_first(state), update, before


def begin(run: Run, learner: Learner, config: Config) -> tuple[TrainState, int, float]:
    """The state to go on from, its update, and the seconds spent before."""
    run.clear_unfinished()
    if not (config.resume and any(True for _ in run.checkpoints())):
        run.rewind(0)
        return start_all(learner, config.all_seeds), 0, 0.0
    update, state, wall = run.restore(start_shapes(learner, config.all_seeds))
    run.rewind(update)
    run.set_aside_after(update)
    return state, update, wall


def reporting(run: Run, config: Config, update: int, team: Team) -> contextlib.AbstractContextManager[Callable[[dict[str, Any]], None]]:
    """What shows each line of metrics: a `Reporter`, and in other processes than the first nothing."""
    return Reporter(run, config, update) if team.leads else contextlib.nullcontext(lambda line: None)


class Tests:
    """The scene's metrics on test episodes, under every source of types."""

    def __init__(self, config: Config, learner: Learner, grid: Grid) -> None:
        self.config, self.grid, self.roll = config, grid, evaluate.roller(learner, config.scene.samples, grid=grid)
        demonstrations = dataset.demonstrations(config.scene, config.experts.test, dataset.TEST)
        self.expert = reference.experts(config.scene, config.experts.test)
        self.episodes = dataset.without_truth(demonstrations)
        self.donors = evaluate.donors(config.scene, learner.method, self.episodes)

    def __call__(self, state: TrainState) -> dict[str, list[float]]:
        """Metrics by name; those under other types than the prior's are prefixed."""
        features = self.roll(self.grid.gathered(state.networks), self.episodes, self.donors, stream("evaluation", 0))
        scores = evaluate.score(self.config, features, self.expert)
        named = {source: f"{source}/" if source != "prior" else "" for source in scores}
        return {named[source] + name: values for source, table in scores.items() for name, values in table.items()}


def env_steps(learner: Learner, update: int) -> int:
    """Control steps simulated by one seed in so many updates."""
    return update * learner.scene.steps * sum(learner.size(b) for b in learner.closed_loop)


def as_lists(seen: dict[str, jax.Array]) -> dict[str, list[float]]:
    """Numbers per seed, in the order of their names."""
    return {name: [float(x) for x in values] for name, values in sorted(jax.device_get(seen).items())}


def check_finite(line: dict[str, Any], run: Run) -> None:
    """Raises DivergedError where a seed has diverged: going on would only write NaN."""
    bad = [(name, seed) for name, x in line.items() if isinstance(x, list) for seed, v in enumerate(x) if not math.isfinite(v)]
    if bad:
        name, seed = bad[0][0], run.config.first_seed + bad[0][1]
        whole = next(run.checkpoints(), None)
        kept = f"the last checkpoint is of update {whole}" if whole is not None else "there is no checkpoint yet"
        raise DivergedError(
            f"update {line['update']}: {name} of seed {seed} is not finite; {kept}; a new run with a lower learning rate may do better"
        )


class Interruption:
    """While open, Ctrl-C and a request to terminate are noted, so that the chunk under way can end and be saved."""

    def __init__(self) -> None:
        self.noted = False

    def __bool__(self) -> bool:
        return self.noted

    def __enter__(self) -> "Interruption":
        def note(number: int, frame: Any) -> None:
            if self.noted:
                raise KeyboardInterrupt  # a second one does not wait
            self.noted = True
            sys.stderr.write("stopping: a checkpoint is saved first (once more to stop at once)\n")

        self.before = {s: signal.signal(s, note) for s in (signal.SIGINT, signal.SIGTERM)}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self.before.items():
            signal.signal(number, handler)


def main(argv: Sequence[str] | None = None) -> None:
    """Trains as the command line says, then evaluates."""
    argv = sys.argv[1:] if argv is None else argv
    config = settings.from_command_line(argv, "python -m rtc_mjx.train")
    cache.keep_compiled()
    with joined(config.hardware, agreed(config)) as team:
        run = train(config, team)
        if team.leads:
            evaluate.main(["--run", str(run.folder)])


def agreed(config: Config) -> dict[str, Any]:
    """What must be the same in all processes that train together: settings, package versions, and this package's code."""
    options = {f"--{name.replace('_', '-')}": value for name, value in settings.flat(settings.to_dict(config)).items()}
    where = {"--run": str(config.folder), "--resume": config.resume, "--timeout": config.hardware.timeout}
    where |= {"JAX_ENABLE_X64": jax.config.read("jax_enable_x64")}
    return {**options, **where, **provenance.versions()}


if __name__ == "__main__":
    cli.run(main)
