"""A run directory, which describes itself.

It holds config.json, trained_by.json, metrics.jsonl, TensorBoard files, checkpoints/, media/ and evaluation.json.

A run that was joined from others (`rtc_mjx.blocks`) has these in blocks/, with their TensorBoard files.

A checkpoint is written beside and renamed when complete (orbax), with a digest of its numbers; the last few are kept. What a
crash cuts short is a checkpoint without its name or a last line of metrics.jsonl: both are taken away on resuming.
"""

import contextlib
import fcntl
import hashlib
import json
import logging
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rtc_mjx import config as settings
from rtc_mjx.config import Config
from rtc_mjx.errors import RunError, UsageError, quiet_destructors
from rtc_mjx.files import write_whole

KEPT = 3  # checkpoints
RECORDINGS = "recordings.json"  # which the run learns from and is tested on, where its scene has any
TRAINED_BY = "trained_by.json"  # code and packages that trained it, in order
PARTS = ("checkpoints", "media")


class Run:
    """An open run directory.

    Attributes:
        folder: where.
        config: its settings.
    """

    def __init__(self, folder: Path, config: Config) -> None:
        self.folder, self.config = folder, config

    @classmethod
    def create(cls, config: Config) -> "Run":
        """Makes the directory; its settings are written last, so that a directory with settings is whole.

        Raises:
            UsageError: it exists, and holds more than what was left of making it, or is a file; nothing is ever overwritten.
        """
        folder = config.folder
        if folder.is_file():
            raise UsageError(f"--run {folder} is a file; a directory is needed")
        if folder.exists() and not unbegun(folder):
            raise UsageError(f"--run {folder} exists: go on with --resume, or name another")
        try:
            for part in PARTS:
                (folder / part).mkdir(parents=True, exist_ok=True)
            (folder / RECORDINGS).unlink(missing_ok=True)  # of a making that was stopped
            if recordings := config.scene.recordings():
                write_whole(folder / RECORDINGS, json.dumps(recordings, indent=1) + "\n")
            settings.write(config, folder)
        except OSError as error:
            raise UsageError(f"--run {folder}: {error.strerror}") from error
        return cls(folder, config)

    @classmethod
    def open(cls, folder: Path) -> "Run":
        """Opens an existing one.

        Raises:
            UsageError: it is not a run directory, or a damaged one.
        """
        return cls(folder, settings.read(folder))

    def check_recordings(self) -> None:
        """That the recordings are still those the run began with: its inputs are scaled by them, and its parts are of them.

        Raises:
            UsageError: they are not; or it is not known which they were.
        """
        there, file = self.config.scene.recordings(), self.folder / RECORDINGS
        if not there:
            return
        try:
            before = [str(line) for line in json.loads(file.read_text())]
        except (OSError, ValueError, TypeError) as error:
            raise UsageError(f"{file} cannot be read: it is not known which recordings the run began with ({error})") from error
        if before != there:
            changed = sorted(set(before) ^ set(there))
            told = f"{len(changed)} went or came, first '{changed[0]}'" if changed else "they come in another order"
            raise UsageError(f"{self.folder}: its recordings are not the {len(before)} it began with ({RECORDINGS}); {told}")

    def trained_by(self) -> list[dict[str, Any]]:
        """Code and packages that trained it, as in `provenance.code`, first to last; empty of a run of a version that did not write them.

        Raises:
            UsageError: the file is damaged.
        """
        file = self.folder / TRAINED_BY
        if not file.is_file():
            return []
        try:
            return [dict(made) for made in json.loads(file.read_text())]
        except (ValueError, TypeError) as error:
            raise UsageError(f"{file} is damaged: {error}") from error

    def note_trained_by(self, *made: Mapping[str, Any]) -> None:
        """Adds code and packages to those that trained it, but for those that are there."""
        held = self.trained_by()
        held += [dict(one) for i, one in enumerate(made) if one not in held and one not in made[:i]]
        write_whole(self.folder / TRAINED_BY, json.dumps(held, indent=1) + "\n")

    @property
    def metrics_file(self) -> Path:
        """One JSON object a line."""
        return self.folder / "metrics.jsonl"

    def metrics(self) -> list[dict[str, Any]]:
        """All complete lines of metrics.jsonl."""
        if not self.metrics_file.is_file():
            return []
        lines = self.metrics_file.read_bytes().split(b"\n")[:-1]  # after the last newline: nothing, or a line cut short
        held = []
        for number, line in enumerate(lines, 1):
            try:
                held.append(json.loads(line))
                held[-1]["update"] + 0
            except (ValueError, KeyError, TypeError) as error:
                raise UsageError(f"{self.metrics_file}, line {number} is damaged: {error}") from error
        return held

    def rewind(self, update: int) -> None:
        """Takes away the lines after an update, and one that was cut short."""
        kept = [json.dumps(line) for line in self.metrics() if line["update"] <= update]
        write_whole(self.metrics_file, "".join(line + "\n" for line in kept))

    def log(self, line: dict[str, Any]) -> None:
        """Appends a line."""
        with self.metrics_file.open("a") as file:
            file.write(json.dumps(line) + "\n")

    def save(self, update: int, state: Any, wall_s: float) -> None:
        """Writes a checkpoint; earlier ones stay until it is complete.

        Raises:
            RunError: it could not be written (a full disk); those before are untouched.
        """
        ocp = _orbax()
        named = ocp.args.Composite(
            state=ocp.args.StandardSave(_named(state)), notes=ocp.args.JsonSave({"digest": _digest(state), "wall_s": wall_s})
        )
        failed = None
        with quiet_destructors():
            try:
                with _manager(self.folder / "checkpoints") as manager:
                    manager.save(update, args=named, force=True)
            except Exception as error:  # orbax raises many kinds; whichever it is, the run must say that nothing was lost
                failed = _first_line(error)
        if failed:
            raise RunError(f"checkpoint {update} could not be written to {self.folder / 'checkpoints'}: {failed}")

    def restore(self, like: Any) -> tuple[int, Any, float]:
        """The last whole checkpoint: its update, its state in the structure and types of `like`, and the wall time until then.

        A damaged one is passed over, with a warning, for the one before.

        Raises:
            UsageError: there is no whole one, or its networks have other shapes than those that the settings make.
        """
        self.check_checkpoint()
        failed = []
        for update in self.checkpoints():
            with quiet_destructors():
                try:
                    state, notes = self._read(update, like)
                except MemoryError:
                    raise
                except _OtherShapesError as error:
                    raise UsageError(
                        f"{self.folder} was trained by other code or settings than these: {error}; use the code that {TRAINED_BY} names, "
                        "or train anew (another --run, in a study another --name)"
                    ) from error
                except Exception as error:  # orbax and tensorstore raise bare Exceptions for damaged files
                    failed.append(f"checkpoint {update} cannot be read ({_first_line(error)})")
                    continue
            for reason in failed:
                logging.getLogger("rtc_mjx").warning("%s, using that of update %d", reason, update)
            return update, state, float(notes["wall_s"])
        raise UsageError(f"{self.folder} has no whole checkpoint: {'; '.join(failed)}")

    def check_checkpoint(self) -> None:
        """That there is a checkpoint at all, whole or not.

        Raises:
            UsageError: there is none.
        """
        if next(self.checkpoints(), None) is None:
            raise UsageError(f"{self.folder} has no whole checkpoint yet; --resume goes on with the training")

    def checkpoints(self) -> Iterator[int]:
        """Updates at which checkpoints stand, newest first."""
        folder = self.folder / "checkpoints"
        steps = [int(p.name) for p in folder.iterdir() if p.name.isdigit()] if folder.is_dir() else []
        return iter(sorted(steps, reverse=True))

    def _read(self, update: int, like: Any) -> tuple[Any, dict[str, Any]]:
        ocp = _orbax()
        wanted = ocp.args.Composite(state=ocp.args.StandardRestore(jax.eval_shape(lambda: _named(like))), notes=ocp.args.JsonRestore())
        held, asked = self._shapes(update), [leaf.shape for leaf in jax.tree.leaves(like)]
        if held != asked:
            first = next(
                (f"an array of {a} where config.json asks for {b}" for a, b in zip(held, asked, strict=False) if a != b),
                f"{len(held)} for {len(asked)} arrays",
            )
            raise _OtherShapesError(f"checkpoint {update} has {first}")
        with _manager(self.folder / "checkpoints") as manager:
            found = manager.restore(update, args=wanted)
        state = jax.tree.unflatten(jax.tree.structure(like), [found.state[name] for name in sorted(found.state)])
        if _digest(state) != found.notes["digest"]:
            raise ValueError("its numbers are not those that were written")
        return state, found.notes

    def _shapes(self, update: int) -> list[tuple[int, ...]]:
        """Of the arrays of a checkpoint's state."""
        known = _orbax().StandardCheckpointHandler().metadata((self.folder / "checkpoints" / str(update) / "state").absolute())
        leaves = known.tree
        return [tuple(leaves[name].shape) for name in sorted(leaves)]

    def set_aside_after(self, update: int) -> None:
        """Renames checkpoints later than an update (they could not be read), so that new ones can stand there."""
        for later in [u for u in self.checkpoints() if u > update]:
            place = self.folder / "checkpoints" / str(later)
            place.rename(place.with_name(f"{later}.unreadable.{time.time_ns()}"))

    def clear_unfinished(self) -> None:
        """Takes away checkpoints that a crash left without a name."""
        for part in (self.folder / "checkpoints").glob("*.orbax-checkpoint-tmp*"):
            shutil.rmtree(part, ignore_errors=True)

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Held while a process trains in the directory.

        Raises:
            UsageError: another process does.
        """
        with (self.folder / ".lock").open("w") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise UsageError(f"--run {self.folder}: another process is training there") from None
            yield


def by_method(runs: Sequence[Run]) -> dict[str, Run]:
    """Runs of one scene by their methods.

    Raises:
        UsageError: they are of several scenes, or two are of one method.
    """
    scenes = {run.config.scene.name for run in runs}
    if len(scenes) > 1:
        raise UsageError(f"runs of one scene are needed, these are of {', '.join(sorted(scenes))}")
    methods = [run.config.method for run in runs]
    if twice := [method for method in methods if methods.count(method) > 1]:
        raise UsageError(f"one run a method is needed; there are {methods.count(twice[0])} of {twice[0]}")
    return dict(zip(methods, runs, strict=True))


def unbegun(folder: Path) -> bool:
    """Whether a directory is empty, or holds only what is left where making a run was stopped before its settings were written."""
    if not folder.is_dir():
        return False
    made = {RECORDINGS, *PARTS, *(f".{name}.part" for name in (RECORDINGS, "config.json"))}
    return all(part.name in made and not (part.is_dir() and any(part.iterdir())) for part in folder.iterdir())


class Follower(Run):
    """A run as processes other than the first see it: they train along and leave the writing to the first."""

    def log(self, line: dict[str, Any]) -> None:
        """Nothing."""

    def save(self, update: int, state: Any, wall_s: float) -> None:
        """Nothing."""

    def note_trained_by(self, *made: Mapping[str, Any]) -> None:
        """Nothing."""

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Nothing: the first process holds it."""
        yield


def _orbax() -> Any:
    import orbax.checkpoint  # takes seconds to import: not for those who do not save

    logging.getLogger("absl").setLevel(logging.ERROR)
    return orbax.checkpoint


class _OtherShapesError(Exception):
    """The arrays of a checkpoint have other shapes than those of the networks that the settings make."""


def _manager(folder: Path) -> Any:
    ocp = _orbax()
    named: dict[str, Any] = {}
    if jax.process_count() > 1:  # the first alone writes and reads; orbax would wait for the others
        alone = ocp.options.MultiprocessingOptions(primary_host=0, active_processes={0}, barrier_sync_key_prefix="first")
        named = {"multiprocessing_options": alone, "create": False}
    options = ocp.CheckpointManagerOptions(max_to_keep=KEPT, enable_async_checkpointing=False, **named)
    return ocp.CheckpointManager(folder.absolute(), options=options)


def _named(state: Any) -> dict[str, Any]:
    """The leaves by number: the structure is the code's, not the file's."""
    return {f"{i:05d}": leaf for i, leaf in enumerate(jax.tree.leaves(state))}


def _digest(state: Any) -> str:
    """Hash of all numbers."""
    total = hashlib.sha256()
    for leaf in jax.tree.leaves(jax.device_get(state)):
        total.update(np.ascontiguousarray(leaf).tobytes())
    return total.hexdigest()


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0][:200]
