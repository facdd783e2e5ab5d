"""Damaged and malicious recordings: each gives scenes or one `UsageError` that names the file, in bounded time and memory.

python -m tests.fuzz_logs --count 1000                      # of each format, of the recordings of ../shared/data where they are there
python -m tests.fuzz_logs --kind scenarionet --first 417 --count 1   # one of them again
"""

import argparse
import contextlib
import faulthandler
import functools
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rtc_mjx.errors import UsageError
from rtc_mjx.logs import read
from rtc_mjx.logs.convert import Options, convert
from tests.damage import mutated
from tests.recorded import SHARED, written

FORMATS = read.KINDS
LONGEST = 10.0  # s of processor time, so that a busy machine fails nobody, that a file of a few megabytes may take, conversion included
LARGEST = 400  # MB, that it may take beside what the process has
MOST = 2500  # MB of addresses, with which it is stopped: libraries reserve some that they never use
STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")


class TooLongError(BaseException):
    """A file takes longer than it may; no `Exception`, so that no reader takes it for damage."""


@dataclass
class Told:
    """What became of many files.

    Attributes:
        outcomes: "scenes", "error", "unforeseen" where only the last resort of `read` gave the line, or what was raised.
        slowest: s of processor time, of one file.
        largest: MB, that one file took beside what the process had.
        kept: where the files are that gave neither scenes nor a reader's own line.
    """

    outcomes: Counter[str] = field(default_factory=Counter)
    slowest: float = 0.0
    largest: float = 0.0
    kept: list[Path] = field(default_factory=list)

    @property
    def clean(self) -> bool:
        """Whether every file gave scenes or a reader's own line."""
        return set(self.outcomes) <= {"scenes", "error"}


def outcome(file: Path) -> str:
    """What reading and converting comes to: scenes, or one line that names the file.

    Raises:
        AssertionError: the error has several lines, is too long or does not name the file.
    """
    try:
        for recording in read.recordings(file):
            convert(recording, Options(lanes=64, points=16))
    except UsageError as error:
        said = str(error)
        short = len(said) < len(str(file)) + 400 and said.isprintable()
        assert file.name in said and short, f"{said[:1000]!r} should be one line that names {file.name}"
        return "unforeseen" if read.UNFORESEEN in said else "error"
    return "scenes"


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """Bounds the time and the memory of what is done within."""

    def late(*_: Any) -> None:
        raise TooLongError(f"more than {LONGEST:g} s")

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, LONGEST)
    resource.setrlimit(resource.RLIMIT_AS, ((in_use("VmSize") + MOST) * 2**20, hard))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@functools.cache
def ready() -> None:
    """Converts something once, as the first conversion starts the threads of JAX."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "whole"
        file.write_bytes(written("womd_scenario"))
        assert outcome(file) == "scenes"


def in_use(what: str) -> int:
    """MB of this process by a name of /proc/self/status; VmHWM is the most since `CLEAR` was last written to."""
    return int(STATUS.read_text().split(f"{what}:")[1].split()[0]) // 1024


def tried(file: Path, told: Told) -> None:
    """Adds what becomes of a file."""
    ready()
    CLEAR.write_text("5")
    before, start = in_use("VmHWM"), time.process_time()
    try:
        with limited(), warnings.catch_warnings():
            warnings.simplefilter("error")
            what = outcome(file)
    except (Exception, TooLongError) as error:
        what = type(error).__name__
        traceback.print_exc()
    took, grew = time.process_time() - start, in_use("VmHWM") - before
    what = "too large" if grew > LARGEST else what
    told.outcomes[what] += 1
    told.slowest, told.largest = max(told.slowest, took), max(told.largest, grew)
    if what not in ("scenes", "error"):
        kept = Path(tempfile.gettempdir()) / f"fuzz_{file.name}"
        kept.write_bytes(file.read_bytes())
        told.kept.append(kept)


def bases(kind: str, folder: Path = SHARED) -> list[Path]:
    """The recordings of others that are damaged; none where they are not there."""
    folders = {"scenarionet": "scenarionet_*", "gpudrive_json": "gpudrive_json"}
    return sorted(folder.glob(f"{folders.get(kind, kind)}/*"))


def run(kind: str, numbers: range, seed: int, sources: list[bytes]) -> Told:
    """What becomes of damaged copies; each depends on kind, seed, number and sources alone."""
    told = Told()
    with tempfile.TemporaryDirectory() as folder:
        for number in numbers:
            draw = random.Random(f"{kind} {seed} {number}")
            file = Path(folder) / f"{kind}_{seed}_{number}"
            file.write_bytes(mutated(kind, draw.choice(sources), draw))
            tried(file, told)
            file.unlink()
    return told


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz_logs", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=1000, help="damaged copies of each format")
    parser.add_argument("--first", type=int, default=0, help="number of the first")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=FORMATS, nargs="*", default=FORMATS)
    parser.add_argument("--data", type=Path, default=SHARED, help="folder of the recordings")
    options = parser.parse_args()
    clean = True
    for kind in options.kind:
        real = bases(kind, options.data)
        sources = [file.read_bytes() for file in real] or [written(kind)]
        faulthandler.dump_traceback_later(60 + 4 * LONGEST * options.count, exit=True)  # compiled code does not hear the signal
        told = run(kind, range(options.first, options.first + options.count), options.seed, sources)
        clean &= told.clean
        what = f"{len(real)} recordings of others" if real else "our own recording"
        print(f"{kind}, of {what}: {dict(told.outcomes)}, slowest {told.slowest:.2f} s, largest {told.largest:.0f} MB", flush=True)
        for kept in told.kept:
            print(f"  kept: {kept}")
    sys.exit(0 if clean else "some gave neither scenes nor one line of a reader")


if __name__ == "__main__":
    main()
