"""What recorded driving scenes are there: checked, converted, drawn.

Examples:
  python -m rtc_mjx.data recordings/                        what is in a folder
  python -m rtc_mjx.data 'womd/*.tfrecord-*' --convert      convert and keep all scenes
  python -m rtc_mjx.data scene.json --render pictures/      draw them from above
  python -m rtc_mjx.data recordings/ --replay               how well the simulated car can follow each agent

Formats, told by content: TFRecords of Waymo Open Motion Dataset Scenario protos or tf.Examples, GPUDrive / Nocturne JSON, ScenarioNet
pickles (as data only: nothing in them is run).
"""

import argparse
import re
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import get_args

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from rtc_mjx import cli
from rtc_mjx.errors import RunError, UsageError
from rtc_mjx.logs import picture, read, store
from rtc_mjx.logs.convert import MOVES, Control, Conversion, Options
from rtc_mjx.logs.recording import Recording
from rtc_mjx.scenes.pool import driven, fitted, follows

KINDS = ("of no kind", "vehicles", "pedestrians", "cyclists", "others")
CONTROL_STEPS = 30  # of the 9 s of a scene
EVERY = 200  # recordings between two plain lines of progress


class Summary:
    """What one file holds, or all of them."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.connectivity: set[str] = set()
        self.notes: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.refused: list[str] = []

    def add(self, recording: Recording, became: Conversion | UsageError) -> None:
        """Counts one recording."""
        held, road = recording.tracks, recording.map
        self.counts += Counter({
            "recordings": 1, "agents": len(held.ids), **{kind: int((held.kinds == i).sum()) for i, kind in enumerate(KINDS)},
            "lanes": len(road.lanes), "road edges": len(road.road_edges), "crosswalks": len(road.crosswalks),
            "stop signs": len(road.stop_signs), "signal states": len(recording.signals.time),
        })  # fmt: skip
        if isinstance(became, Conversion):
            self.counts["scenes"] += len(became.scenes)
            self.connectivity |= {scene.connectivity for scene in became.scenes}
            self.notes.update(became.notes)
            self.dropped.update(became.dropped)
        else:
            self.refused.append(str(became))

    def join(self, other: "Summary") -> None:
        """Adds those of another file."""
        self.counts += other.counts

    def lines(self, kind: str) -> list[str]:
        """For people to read."""
        count = self.counts
        who = ", ".join(f"{count[name]:,} {name}" for name in (*KINDS[1:], KINDS[0]) if count[name])
        where = " and ".join(sorted(self.connectivity))
        lanes = f"{count['lanes']:,} lanes" + (f" (connectivity {where})" if where else "")
        roads = ", ".join(f"{count[name]:,} {name}" for name in ("road edges", "crosswalks", "stop signs", "signal states"))
        out = [
            f"  {kind}: {_several(count['recordings'], 'recording')}, {_several(count['scenes'], 'scene')} to drive",
            f"  {count['agents']:,} agents: {who}",
            f"  {lanes}, {roads}",
        ]
        out += [f"    {number:,} {what}" for what, number in self.notes.items()]
        if self.dropped:
            out += [f"  summed over {_several(count['scenes'], 'scene')}:", *(f"    {n:,} {what}" for what, n in self.dropped.items())]
        return out + [f"  no scene: {why}" for why in self.refused]


def _several(count: int, name: str) -> str:
    return f"{count:,} {name}{'' if count == 1 else 's'}"


class Reporter:
    """A bar on a terminal, plain lines elsewhere; results go to standard output, what goes wrong to standard error."""

    def __init__(self, total: int) -> None:
        self.console = Console(stderr=True)
        self.bar = Progress(
            TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total} files"),
            TimeElapsedColumn(), TimeRemainingColumn(), TextColumn("{task.fields[shown]}"),
            console=self.console, disable=not self.console.is_terminal, transient=True,
        )  # fmt: skip
        self.task = self.bar.add_task("reading", total=total, shown="")

    def recording(self, file: Path, summary: Summary) -> None:
        """One more recording of a file is done."""
        count = summary.counts["recordings"]
        self.bar.update(self.task, shown=f"{file.name}: {_several(count, 'recording')}, {_several(summary.counts['scenes'], 'scene')}")
        if not self.console.is_terminal and count % EVERY == 0:
            sys.stderr.write(f"{file}: {_several(count, 'recording')} so far\n")

    def file(self, lines: Sequence[str]) -> None:
        """A file is done."""
        self.bar.advance(self.task)
        print("\n".join(lines), flush=True)

    def bad(self, error: UsageError) -> None:
        """A file among others cannot be read."""
        self.bar.advance(self.task)
        self.console.print(str(error), markup=False, highlight=False, soft_wrap=True)


class Painter:
    """Pictures of the scenes of recordings, one a recording."""

    def __init__(self, folder: Path | None) -> None:
        self.folder, self.drawn = folder, Counter[str]()
        if folder:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise UsageError(f"--render {folder}: the folder cannot be made: {error.strerror}") from error

    def __call__(self, recording: Recording, became: Conversion | UsageError) -> None:
        """Draws the first scene: that of the car that drove itself, if it is among them."""
        if self.folder is None or not isinstance(became, Conversion) or not became.scenes:
            return
        controlled = [scene.users[int(scene.scene.controlled)] for scene in became.scenes]
        own = recording.tracks.ids[recording.sdc] if recording.sdc >= 0 else None
        name = re.sub(r"[^\w.-]+", "_", recording.scenario)[:100].strip(".") or "scene"
        self.drawn[name] += 1
        suffix = f"-{self.drawn[name]}" if self.drawn[name] > 1 else ""
        picture.draw(became.scenes[controlled.index(own) if own in controlled else 0], controlled, self.folder / f"{name}{suffix}.png")


class Replays:
    """How well the simulated car can follow the controlled agents of all scenes."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.poses: list[np.ndarray] = []  # of the agents only: of thousands of scenes that is little
        self.velocities: list[np.ndarray] = []
        self.throughout: list[bool] = []

    def __call__(self, recording: Recording, became: Conversion | UsageError) -> None:
        """Notes the agents of one recording."""
        for held in became.scenes if isinstance(became, Conversion) else ():
            poses, velocity = driven(held.scene, CONTROL_STEPS)
            self.names.append(held.name)
            self.poses.append(np.asarray(poses))
            self.velocities.append(np.asarray(velocity))
            self.throughout.append(bool(np.all(held.scene.valid[held.scene.controlled])))

    def tables(self) -> list[Table]:
        """A row a scene; rows over all agents that are there throughout; and over all positions of those of them that move."""
        there, poses = np.array(self.throughout), np.stack(self.poses)
        fit = fitted(poses, np.stack(self.velocities))
        errors = {"position, m": np.asarray(fit.position_error), "heading, rad": np.asarray(fit.heading_error)}
        names = [f"{name} {what}" for name in errors for what in ("mean", "95 %")]
        columns = [column for error in errors.values() for column in (np.mean(error, axis=1), np.quantile(error, 0.95, axis=1))]
        each, every = Table("scene", *names, "", title="replay by recovered controls"), Table("scenes", "of", *names, title="all agents")
        for index, (name, good) in enumerate(zip(self.names, follows(fit), strict=True)):
            note = "the log ends early" if not there[index] else "" if good else "no car can follow"
            each.add_row(name, *(f"{column[index]:.3f}" for column in columns), note)
        for what, share in (("median agent", 0.5), ("95th percentile agent", 0.95)):
            told = [f"{np.quantile(column[there], share):.3f}" if np.any(there) else "-" for column in columns]
            every.add_row(f"{np.sum(there):,}", what, *told)
        away = np.max(np.linalg.norm(poses[..., :2] - poses[:, :1, :2], axis=-1), axis=1)
        return [each, every, _pooled(errors, there & (away > MOVES))]


def _pooled(errors: dict[str, np.ndarray], moving: np.ndarray) -> Table:
    """Over all positions after the first, whosever they are, of agents that get more than MOVES m away."""
    out = Table("scenes", "of", "median", "95 %", title="all positions of moving agents")
    for name, error in errors.items():
        held = error[moving, 1:]
        out.add_row(f"{np.sum(moving):,}", name, *(f"{np.quantile(held, share):.3f}" if held.size else "-" for share in (0.5, 0.95)))
    return out


def look(file: Path, options: Options, keep: bool, watchers: Sequence[store.Told], reporter: Reporter) -> Summary:
    """Reads one file to its end; `watchers` see each recording.

    Raises:
        UsageError: it cannot be read to its end.
    """
    summary = Summary()

    def told(recording: Recording, became: Conversion | UsageError) -> None:
        for watcher in (summary.add, *watchers):
            watcher(recording, became)
        reporter.recording(file, summary)

    if keep:
        store.build(file, options, told)
    else:
        for recording, became in store.converted(file, options):
            told(recording, became)
    return summary


def main(argv: Sequence[str] | None = None) -> None:
    """Looks at all files.

    Raises:
        UsageError: wrong options, no such file, or none can be read.
        RunError: some cannot be read.
    """
    asked = _parser().parse_args(argv)
    options = Options(**{name: getattr(asked, name) for name in Options.__dataclass_fields__})
    found, replays = read.files(asked.paths), Replays()
    watchers: list[store.Told] = [Painter(asked.render), *([replays] if asked.replay else [])]
    total, kinds, bad = Summary(), Counter[str](), list[UsageError]()
    reporter = Reporter(len(found))
    with reporter.bar:
        for file, named in found:
            try:
                kind = read.kind_of(file)
                if isinstance(kind, read.Foreign) and kind.certain and not named:
                    reporter.file([f"{file}", f"  left out: {kind.what}, no recording"])
                    continue
                summary = look(file, options, asked.convert, watchers, reporter)
            except UsageError as error:
                bad.append(error)
                if len(found) > 1:
                    reporter.bad(error)
                continue
            kinds[str(kind)] += 1
            total.join(summary)
            reporter.file([f"{file}", *summary.lines(str(kind))])
    if kinds:
        cli.console().print(_table(kinds, total))
    for table in replays.tables() if replays.names else ():
        cli.console().print(table)
    _finish(bad, kinds, len(found), total.counts["scenes"] if asked.convert else 1)


def _finish(bad: Sequence[UsageError], kinds: Counter[str], count: int, scenes: int) -> None:
    """The exit status.

    Raises:
        UsageError: nothing was read.
        RunError: not everything was, or no scene came of it.
    """
    if len(bad) == 1 and count == 1:
        raise bad[0]
    if not kinds:
        raise UsageError(f"none of {_several(count, 'file')} holds a recording that can be read")
    if bad:
        raise RunError(f"{len(bad)} of {count} files could not be read")
    if not scenes:
        raise RunError("no scene could be made; what is said above about each file says why")


def _table(kinds: Counter[str], total: Summary) -> Table:
    out = Table(title="all files", title_justify="left", show_header=False)
    out.add_column(justify="right")
    out.add_column()
    for kind, count in kinds.items():
        out.add_row(f"{count:,}", f"files: {kind}")
    for name in ("recordings", "scenes", *KINDS[1:], "lanes", "signal states"):
        out.add_row(f"{total.counts[name]:,}", name)
    return out


def _parser() -> cli.Parser:
    known = Options()
    parser = cli.Parser(prog="python -m rtc_mjx.data", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("paths", nargs="+", metavar="PATH", help="files, folders or globs")
    parser.add_argument("--convert", action="store_true", help="keep the converted scenes in the cache")
    parser.add_argument("--render", type=Path, metavar="DIR", help="draw one scene of each recording from above, as PNG")
    parser.add_argument("--replay", action="store_true", help="recover the controls of each agent; say how far the car is off its log")
    scenes = parser.add_argument_group("which scenes")
    who = "of the self-driving car (sdc), of tracks_to_predict (predict), of every vehicle there throughout that moves (moving, default)"
    scenes.add_argument("--control", choices=get_args(Control), default=known.control, help=who)
    scenes.add_argument(
        "--start", type=float, default=known.start, metavar="S", help="seconds into the recording (default 0); a scene lasts 9 s"
    )
    sizes = parser.add_argument_group("sizes of a scene", "what lies beyond is dropped farthest first, and counted")
    told = {
        "road_users": "road users, the controlled one included", "lanes": "lanes", "points": "points of a lane",
        "successors": "ways on from a lane", "edges": "segments of road edges", "crosswalks": "crosswalks",
    }  # fmt: skip
    for name, what in told.items():
        default = getattr(known, name)
        sizes.add_argument(f"--{name.replace('_', '-')}", type=int, default=default, metavar="N", help=f"{what} (default {default})")
    return parser


if __name__ == "__main__":
    cli.run(main)
