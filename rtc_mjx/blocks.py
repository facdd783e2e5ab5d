"""Blocks of seeds: trainings of adjacent seeds, with otherwise equal settings, are one training of all of these seeds.

    the run of some seeds, blocks that wait beside it -> seeds that are missing, as blocks to train -> joined -> put in the run's place

What a seed learns is a function of its number, and seeds never meet. Blocks of the run <name> wait in blocks/<name> beside it. A joined
run is an ordinary one, with the last checkpoint of its blocks; it keeps the blocks themselves, with their TensorBoard files, videos and
earlier checkpoints, in a folder blocks of its own. A step that was stopped is done anew; all others are renames.
"""

import dataclasses
import itertools
import shutil
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rtc_mjx import config as settings
from rtc_mjx.config import Config
from rtc_mjx.errors import UsageError
from rtc_mjx.runs import Run
from rtc_mjx.trained import restored
from rtc_mjx.updates import TrainState

BLOCKS = "blocks"
UNDER_WAY = "joined"  # what is being made of the blocks, beside them

Line = Mapping[str, Any]


def waiting(folder: Path) -> Path:
    """Where blocks wait that are to become part of the run in a folder."""
    return folder.parent / BLOCKS / folder.name


def place(folder: Path, seeds: range) -> Path:
    """Where a block of these seeds waits."""
    return waiting(folder) / f"seeds_{seeds[0]}_{seeds[-1]}"


def there(folder: Path) -> list[Run]:
    """The run in a folder, if there is one, then the blocks that wait for it.

    Raises:
        UsageError: one of them is damaged.
    """
    return [Run.open(at) for at in (folder, *sorted(waiting(folder).glob("seeds_*"))) if (at / "config.json").is_file()]


def inside(part: range, whole: range) -> bool:
    """Whether all seeds of one range are in another."""
    return whole.start <= part.start and part.stop <= whole.stop


def apart(one: range, other: range) -> bool:
    """Whether two ranges have no seed in common."""
    return one.stop <= other.start or other.stop <= one.start


def gaps(wanted: range, held: Sequence[range]) -> Iterator[range]:
    """The ranges of wanted seeds that are in none of those held."""
    ends = [range(wanted.start, wanted.start), *sorted(held, key=lambda seeds: seeds.start), range(wanted.stop, wanted.stop)]
    for before, after in itertools.pairwise(ends):
        if before.stop < after.start:
            yield range(before.stop, after.start)


def to_join(wanted: Config) -> list[Config]:
    """The blocks of which the run wanted can be made, by their seeds: those that are there, and those to train.

    Empty where nothing has to be joined: the run is there, or none of its seeds is.
    """
    held: dict[range, Path] = {}
    for run in there(wanted.folder):
        seeds = run.config.all_seeds
        if seeds == wanted.all_seeds and run.folder == wanted.folder:
            return []
        if inside(seeds, wanted.all_seeds) and all(apart(seeds, other) for other in held):
            held[seeds] = run.folder
    if not held:
        return []
    held |= {seeds: place(wanted.folder, seeds) for seeds in gaps(wanted.all_seeds, list(held))}
    return [part(wanted, seeds, held[seeds]) for seeds in sorted(held, key=lambda seeds: seeds.start)]


def part(wanted: Config, seeds: range, folder: Path) -> Config:
    """The settings of some of the seeds."""
    return dataclasses.replace(wanted, run=folder, first_seed=seeds.start, seeds=len(seeds))


def join(runs: Sequence[Run], folder: Path) -> Run:
    """Makes one run of finished ones.

    In metrics.jsonl `wall_s` is the sum of theirs: the time of training one after another.

    Args:
        runs: in the order of their seeds; they are only read.
        folder: where the new one goes.

    Raises:
        UsageError: they are not trainings of adjacent seeds with equal settings, one has other lines of metrics or another last checkpoint
            than the first, or something is there already.
    """
    check(runs)
    first = runs[0]
    lines = joined_lines([run.metrics() for run in runs], [str(run.metrics_file) for run in runs])
    states, wall_s = read(runs)
    seeds = range(first.config.first_seed, runs[-1].config.all_seeds.stop)
    whole = Run.create(part(first.config, seeds, folder))
    whole.note_trained_by(*trainers(runs))
    for line in lines:
        whole.log(line)
    whole.save(whole.config.updates, joined_state(states), wall_s)
    return whole


def check(runs: Sequence[Run]) -> None:
    """That runs are of adjacent seeds, with equal settings, and of the recordings that are there.

    Raises:
        UsageError: they are not.
    """
    for before, run in itertools.pairwise(runs):
        if run.config.first_seed != before.config.all_seeds.stop:
            raise UsageError(f"{run.folder} begins with seed {run.config.first_seed}: {before.config.all_seeds.stop} is needed")
        for name, theirs, ours in settings.differing(before.config, run.config):
            raise UsageError(f"{run.folder} has {name} {ours}, {before.folder} has {theirs}: they are no blocks of one training")
    for run in runs:
        run.check_recordings()


def trainers(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Code and packages that trained some runs; where they are not of one, that is said."""
    made = [one for run in runs for one in run.trained_by() or [{"commit": None}]]
    commits = list(dict.fromkeys(str(one["commit"]) for one in made))
    if len(commits) > 1:
        where = ", ".join(str(run.folder) for run in runs)
        sys.stderr.write(f"seeds of different code are joined: {where} were trained at {', '.join(commits)} (None: not known)\n")
    return made


def joined_lines(files: Sequence[Sequence[Line]], names: Sequence[str]) -> list[dict[str, Any]]:
    """Lines of metrics of all seeds, from those of each block.

    What not all blocks have (another version may have logged it) is left out, and said.

    Args:
        files: the lines of each.
        names: of the files.

    Raises:
        UsageError: they are not of the same updates, or differ in what is equal for all seeds.
    """
    updates = [[line["update"] for line in lines] for lines in files]
    for name, theirs in zip(names, updates, strict=True):
        if theirs != updates[0]:
            raise UsageError(f"{name} has lines of updates {theirs}, {names[0]} of {updates[0]}: they cannot be joined")
    keys = [{key for line in lines for key in line} for lines in files]
    shared = set.intersection(*keys)
    if left := sorted(set.union(*keys) - shared):
        sys.stderr.write(f"not in all of {', '.join(names)}, left out of what is joined: {', '.join(left)}\n")
    return [{key: _joined(key, rows, names) for key in rows[0] if key in shared} for rows in zip(*files, strict=True)]


def _joined(key: str, rows: Sequence[Line], names: Sequence[str]) -> Any:
    """One value of a line: lists over seeds one after another; seconds summed; what all seeds have in common as it is."""
    values: list[Any] = [row.get(key) for row in rows]
    if all(isinstance(value, list) for value in values):
        return list(itertools.chain.from_iterable(values))
    if key == "wall_s":
        return sum(values)
    for name, value in zip(names, values, strict=True):
        if value != values[0]:
            raise UsageError(f"{name}, update {rows[0]['update']}: {key} is {value}, in {names[0]} {values[0]}: they cannot be joined")
    return values[0]


def read(runs: Sequence[Run]) -> tuple[list[TrainState], float]:
    """The states of finished runs, and the seconds they took in all.

    Raises:
        UsageError: the checkpoint of the last update of one cannot be read.
    """
    states, seconds = [], 0.0
    for run in runs:
        _, update, state, wall_s = restored(run)
        if update != run.config.updates:
            raise UsageError(f"{run.folder} has no whole checkpoint of update {run.config.updates}, the last")
        states.append(state)
        seconds += wall_s
    return states, seconds


def joined_state(states: Sequence[TrainState]) -> TrainState:
    """One state of all seeds: every number has a leading axis of seeds."""
    leaves = zip(*(jax.tree.leaves(state) for state in states), strict=True)
    return jax.tree.unflatten(jax.tree.structure(states[0]), [np.concatenate(held) for held in leaves])


def put(runs: Sequence[Run], folder: Path) -> None:
    """Joins blocks and puts the whole in the run's place; a run of some of its seeds that stands there becomes a block that waits.

    Between the two renames the run is missing: all its seeds are in blocks then.
    """
    under_way = waiting(folder) / UNDER_WAY
    if under_way.exists():  # of a joining that was stopped
        shutil.rmtree(under_way)
    join(runs, under_way)
    for run in runs:
        if run.folder == folder:
            folder.rename(_free(place(folder, run.config.all_seeds)))
    under_way.rename(folder)


def keep(run: Run) -> None:
    """Moves blocks whose seeds a run has into its folder; for when it has shown that it can be read."""
    for block in there(run.folder)[1:]:
        if inside(block.config.all_seeds, run.config.all_seeds):
            (run.folder / BLOCKS).mkdir(exist_ok=True)
            block.folder.rename(_free(run.folder / BLOCKS / block.folder.name))


def _free(folder: Path) -> Path:
    """The folder, by another name if something stands there."""
    return folder if not folder.exists() else folder.with_name(f"{folder.name}.{time.time_ns()}")
