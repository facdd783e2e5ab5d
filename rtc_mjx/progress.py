"""What a user sees of a training while it runs: a progress bar or plain lines, metrics.jsonl, TensorBoard."""

import logging
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from rtc_mjx.config import Config
from rtc_mjx.runs import Run


class Reporter:
    """Shows each line of metrics where it is looked for; metrics.jsonl itself is `Run.log`'s.

    With a terminal there is a bar with updates a second, time left and the scene's main metrics; without one, a plain line per
    line of metrics.jsonl.
    """

    def __init__(self, run: Run, config: Config, update: int) -> None:
        self.run, self.config, self.last = run, config, (update, 0.0)
        self.console = Console(stderr=True)
        self.events = Events(run.folder, update + 1)
        self.bar = Progress(
            TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"),
            TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.fields[shown]}"),
            console=self.console, disable=not self.console.is_terminal,
        )  # fmt: skip
        self.task: TaskID = self.bar.add_task(f"{config.method} on {config.scene.name}", total=config.updates, completed=update, shown="")
        self.main = ""

    def __enter__(self) -> "Reporter":
        self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.stop()
        self.events.close()

    def __call__(self, line: dict[str, Any]) -> None:
        """Reports one line of metrics."""
        lists = {name: value for name, value in line.items() if isinstance(value, list)}
        first = self.config.first_seed
        scalars = {f"{name}/seed_{first + i}": x for name, value in lists.items() for i, x in enumerate(value)}
        self.events.write(line["update"], scalars)
        names = [n for n in self.config.scene.main_metrics if n in line]
        if names:
            self.main = "  ".join(f"{n} {np.mean(line[n]):.4g}" for n in names)
        update, wall = self.last
        rate = (line["update"] - update) / max(1e-9, line["wall_s"] - wall) if wall else float("nan")
        self.last = (line["update"], line["wall_s"])
        shown = f"{rate:.1f} updates/s  {self.main}" if rate == rate else self.main
        dropped = sum(line.get("trajectories_dropped", []))
        shown += f"  {dropped:.3g} trajectories dropped an update" if dropped else ""
        self.bar.update(self.task, completed=line["update"], shown=shown)
        if not self.console.is_terminal:
            sys.stderr.write(f"update {line['update']}/{self.config.updates}  {shown.strip()}\n")


class Events:
    """A TensorBoard event file, written at once and in this thread; if that fails (a full disk), training goes on without it."""

    def __init__(self, folder: Path, first: int) -> None:
        from tensorboardX.event_file_writer import EventsWriter  # protobuf takes a while to import
        from tensorboardX.proto import event_pb2, summary_pb2

        self.event, self.summary = event_pb2, summary_pb2
        self.file: Any = EventsWriter(str(folder / "events"))
        start = event_pb2.SessionLog(status=event_pb2.SessionLog.START)  # what an earlier session wrote from here on is void
        self._put(event_pb2.Event(wall_time=time.time(), step=first, session_log=start))

    def write(self, update: int, scalars: dict[str, float]) -> None:
        """Writes scalars by name."""
        values = [self.summary.Summary.Value(tag=name, simple_value=x) for name, x in scalars.items()]
        self._put(self.event.Event(wall_time=time.time(), step=update, summary=self.summary.Summary(value=values)))

    def _put(self, event: Any) -> None:
        if self.file is None:
            return
        try:
            self.file.write_event(event)
            self.file.flush()
        except OSError as error:
            logging.getLogger("rtc_mjx").warning("TensorBoard's file cannot be written, going on without it: %s", error.strerror)
            self.file = None

    def close(self) -> None:
        """Closes the file."""
        if self.file is not None:
            self.file.close()
