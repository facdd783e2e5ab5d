"""A run directory: config.json, metrics.jsonl, TensorBoard files, checkpoints/, media/, evaluation.json. It describes itself.

A checkpoint is written beside and renamed when complete (orbax), with a digest of its numbers; the last few are kept. What a
crash cuts short is a checkpoint without its name or a last line of metrics.jsonl: both are taken away on resuming.
"""

import hashlib
import json
import logging
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rtc_mjx import config as settings
from rtc_mjx.config import Config
from rtc_mjx.errors import RunError, UsageError

KEPT = 3  # checkpoints


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
        """Makes the directory.

        Raises:
            UsageError: it exists and is not empty; nothing is ever overwritten.
        """
        folder = config.folder
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise UsageError(f"--run {folder} exists: go on with --resume, or name another")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            settings.write(config, folder)
            for part in ("checkpoints", "media"):
                (folder / part).mkdir()
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

    @property
    def metrics_file(self) -> Path:
        """One JSON object a line."""
        return self.folder / "metrics.jsonl"

    def metrics(self) -> list[dict[str, Any]]:
        """All complete lines of metrics.jsonl."""
        if not self.metrics_file.is_file():
            return []
        lines = self.metrics_file.read_text().split("\n")[:-1]  # after the last newline: nothing, or a line cut short
        try:
            return [json.loads(line) for line in lines]
        except ValueError as error:
            raise UsageError(f"{self.metrics_file} is damaged: {error}") from error

    def rewind(self, update: int) -> None:
        """Takes away the lines after an update, and one that was cut short."""
        kept = [json.dumps(line) for line in self.metrics() if line["update"] <= update]
        part = self.metrics_file.with_suffix(".part")
        part.write_text("".join(line + "\n" for line in kept))
        os.replace(part, self.metrics_file)

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
        try:
            with _manager(self.folder / "checkpoints") as manager:
                manager.save(update, args=named, force=True)
        except Exception as error:  # orbax raises many kinds; whichever it is, the run must say that nothing was lost
            raise RunError(f"checkpoint {update} could not be written to {self.folder / 'checkpoints'}: {_first_line(error)}") from error

    def restore(self, like: Any) -> tuple[int, Any, float]:
        """The last whole checkpoint: its update, its state in the structure and types of `like`, and the wall time until then.

        A damaged one is passed over, with a warning, for the one before.

        Raises:
            UsageError: there is no whole one.
        """
        for update in self.checkpoints():
            try:
                state, notes = self._read(update, like)
            except Exception as error:  # orbax and tensorstore raise bare Exceptions for damaged files
                logging.getLogger("rtc_mjx").warning("checkpoint %d cannot be read, using the one before: %s", update, _first_line(error))
                continue
            return update, state, float(notes["wall_s"])
        raise UsageError(f"{self.folder} has no whole checkpoint; start the run again in a new directory")

    def checkpoints(self) -> Iterator[int]:
        """Updates at which checkpoints stand, newest first."""
        folder = self.folder / "checkpoints"
        steps = [int(p.name) for p in folder.iterdir() if p.name.isdigit()] if folder.is_dir() else []
        return iter(sorted(steps, reverse=True))

    def _read(self, update: int, like: Any) -> tuple[Any, dict[str, Any]]:
        ocp = _orbax()
        wanted = ocp.args.Composite(state=ocp.args.StandardRestore(jax.eval_shape(lambda: _named(like))), notes=ocp.args.JsonRestore())
        with _manager(self.folder / "checkpoints") as manager:
            found = manager.restore(update, args=wanted)
        state = jax.tree.unflatten(jax.tree.structure(like), [found.state[name] for name in sorted(found.state)])
        if _digest(state) != found.notes["digest"]:
            raise ValueError("its numbers are not those that were written")
        return state, found.notes

    def discard_after(self, update: int) -> None:
        """Takes away checkpoints later than an update (damaged ones), so that new ones can stand there."""
        with _manager(self.folder / "checkpoints") as manager:
            for later in [u for u in self.checkpoints() if u > update]:
                manager.delete(later)


def _orbax() -> Any:
    import orbax.checkpoint  # takes seconds to import: not for those who do not save

    logging.getLogger("absl").setLevel(logging.ERROR)
    return orbax.checkpoint


def _manager(folder: Path) -> Any:
    ocp = _orbax()
    options = ocp.CheckpointManagerOptions(max_to_keep=KEPT, enable_async_checkpointing=False)
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
