"""What a user sees of a training while it runs: a progress bar or plain lines, metrics.jsonl, TensorBoard."""

import sys
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from rtc_mjx.config import Config
from rtc_mjx.runs import Run


class Reporter:
    """Writes each line of metrics to where it is looked for.

    With a terminal there is a bar with updates a second, time left and the scene's main metrics; without one, a plain line per
    line of metrics.jsonl.
    """

    def __init__(self, run: Run, config: Config, update: int) -> None:
        from tensorboardX import SummaryWriter  # protobuf takes a while to import

        self.run, self.config, self.last = run, config, (update, 0.0)
        self.console = Console(stderr=True)
        self.events = SummaryWriter(str(run.folder), purge_step=update + 1 if update else None)
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
        self.run.log(line)
        for name, value in line.items():
            for seed, x in enumerate(value if isinstance(value, list) else ()):
                self.events.add_scalar(f"{name}/seed_{self.config.first_seed + seed}", x, line["update"])
        names = [n for n in self.config.scene.main_metrics if n in line]
        if names:
            self.main = "  ".join(f"{n} {np.mean(line[n]):.4g}" for n in names)
        update, wall = self.last
        rate = (line["update"] - update) / max(1e-9, line["wall_s"] - wall) if wall else float("nan")
        self.last = (line["update"], line["wall_s"])
        shown = f"{rate:.1f} updates/s  {self.main}" if rate == rate else self.main
        dropped = sum(line.get("trajectories_dropped", []))
        shown += f"  {dropped:.3g} trajectories dropped" if dropped else ""
        self.bar.update(self.task, completed=line["update"], shown=shown)
        if not self.console.is_terminal:
            sys.stderr.write(f"update {line['update']}/{self.config.updates}  {shown.strip()}\n")
