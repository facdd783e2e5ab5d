"""Trains a method on a scene: `python -m rtc_mjx.train --scene double_goal --method rtc`.

    settings -> demonstrations -> state (resumed or new) -> chunks of updates, all seeds in one program -> metrics, checkpoints

All randomness is a function of seed and update, and what happens at an update does not depend on where the run was resumed: a
run that was killed and resumed writes the same metrics.jsonl (but for wall_s) as one that was not.
"""

import functools
import math
import signal
import sys
import time
from collections.abc import Sequence
from typing import Any

import jax

from rtc_mjx import cache, cli, dataset, evaluate
from rtc_mjx import config as settings
from rtc_mjx.config import Config
from rtc_mjx.errors import RunError
from rtc_mjx.keys import stream
from rtc_mjx.learner import Learner, TrainState, compiled_chunk, start_all, start_shapes
from rtc_mjx.progress import Reporter
from rtc_mjx.runs import Run


def train(config: Config) -> Run:
    """Trains, or goes on training; returns the run.

    Raises:
        UsageError: the run directory cannot be used.
        RunError: a checkpoint could not be written.
        KeyboardInterrupt: interrupted; a checkpoint was saved first.
    """
    config = settings.check(config)
    config.scene.ready()
    run = Run.open(config.folder) if config.resume else Run.create(config)
    with run.lock():
        learn(run, config)
    return run


def learn(run: Run, config: Config) -> None:
    """The training loop."""
    expert = dataset.demonstrations(config.scene, config.experts.train, dataset.TRAIN)
    learner = config.learner(dataset.statistics(config.scene, expert))
    state, update, before = begin(run, learner, config)
    test = Tests(config, learner)
    chunks, data = functools.cache(functools.partial(compiled_chunk, learner)), dataset.without_truth(expert)
    started = time.perf_counter() - before
    with Reporter(run, config, update) as report, Interruption() as interrupted:
        while update < config.updates:
            length = min(config.every.log, config.updates - update)
            state, seen = chunks(length)(state, data)
            update += length
            line: dict[str, Any] = {"update": update, "wall_s": time.perf_counter() - started, "env_steps": env_steps(learner, update)}
            line |= as_lists(seen)
            check_finite(line, run)
            if update % config.every.test == 0 or update == config.updates:
                line |= test(state)
            run.log(line)  # before the checkpoint: what a crash leaves without one is written again
            if update % config.every.save == 0 or update == config.updates or interrupted:
                run.save(update, state, line["wall_s"])
            report(line)
            if interrupted:
                raise KeyboardInterrupt


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


class Tests:
    """The scene's metrics on test episodes, under every source of types."""

    def __init__(self, config: Config, learner: Learner) -> None:
        self.config, self.roll = config, evaluate.roller(learner, config.scene.samples)
        demonstrations = dataset.demonstrations(config.scene, config.experts.test, dataset.TEST)
        self.expert = evaluate.expert_features(config.scene, demonstrations)
        self.episodes = dataset.without_truth(demonstrations)
        self.donors = evaluate.donors(learner.method, self.episodes)

    def __call__(self, state: TrainState) -> dict[str, list[float]]:
        """Metrics by name; those under other types than the prior's are prefixed."""
        features = self.roll(state.networks, self.episodes, self.donors, stream("evaluation", 0))
        scores = evaluate.score(self.config, features, self.expert)
        named = {source: f"{source}/" if source != "prior" else "" for source in scores}
        return {named[source] + name: values for source, table in scores.items() for name, values in table.items()}


def env_steps(learner: Learner, update: int) -> int:
    """Control steps simulated by one seed in so many updates."""
    rows = [learner.rows(b) for b in learner.method.branches if b.closed_loop]
    return update * learner.scene.steps * sum(r.stop - r.start for r in rows)


def as_lists(seen: dict[str, jax.Array]) -> dict[str, list[float]]:
    """Numbers per seed, in the order of their names."""
    return {name: [float(x) for x in values] for name, values in sorted(jax.device_get(seen).items())}


def check_finite(line: dict[str, Any], run: Run) -> None:
    """Raises RunError where a seed has diverged: going on would only write NaN."""
    bad = [(name, seed) for name, x in line.items() if isinstance(x, list) for seed, v in enumerate(x) if not math.isfinite(v)]
    if bad:
        name, seed = bad[0]
        whole = next(run.checkpoints(), None)
        kept = f"the last checkpoint is of update {whole}" if whole is not None else "there is no checkpoint yet"
        raise RunError(
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
    run = train(config)
    evaluate.main(["--run", str(run.folder)])


if __name__ == "__main__":
    cli.run(main)
