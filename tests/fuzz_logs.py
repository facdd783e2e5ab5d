"""Damaged and malicious recordings: each gives scenes or one `UsageError` that names the file, in bounded time and memory.

python -m tests.fuzz_logs --count 1000      # of each format; uses the recordings of ../shared/data where they are there
"""

import argparse
import copy
import json
import pickle
import random
import resource
import sys
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rtc_mjx.errors import UsageError
from rtc_mjx.logs import messages, read
from rtc_mjx.logs.convert import Options, convert
from tests.recorded import SHARED, tfrecord, written

JUNK: list[Any] = [
    None, True, -1, 0, 2**31, 2**63, -(2**63) - 1, 10**400, 1e308, float("nan"), float("inf"), "", "x" * 1000, "é", b"\x00", [], {}, [[]],
    [None], [[1.0]] * 50, {"a": 1}, [1e300] * 91, [float("nan")] * 91, ("a", 1),
]  # fmt: skip
FORMATS = read.KINDS


def mutated(kind: str, data: bytes, draw: random.Random) -> bytes:
    """A damaged copy of a file."""
    ways: list[Callable[[], bytes]] = [lambda: _bytes(data, draw)]
    if kind in ("womd_scenario", "womd_tf_example"):
        ways += [lambda: tfrecord(_bytes(data[12:-4], draw)), lambda: tfrecord(_fields(kind, data[12:-4], draw))] * 2
    elif kind == "gpudrive_json":
        ways += [lambda: json.dumps(_tree(json.loads(data), draw), default=str).encode()] * 2
    else:
        ways += [lambda: _repickled(data, draw)] * 2
    return draw.choice(ways)()


def _bytes(data: bytes, draw: random.Random) -> bytes:
    """Bits flipped, cut off, taken out, doubled, moved, or lengths made huge."""
    out, at = bytearray(data), draw.randrange(len(data))
    span = slice(at, at + draw.choice([1, 4, 27, 1000]))
    way = draw.randrange(6)
    if way == 0:
        for _ in range(draw.choice([1, 3, 30])):
            out[draw.randrange(len(out))] ^= 1 << draw.randrange(8)
    elif way == 1:
        del out[at:]
    elif way == 2:
        del out[span]
    elif way == 3:
        out[at:at] = out[span] * draw.choice([1, 100])
    elif way == 4:
        out[span] = draw.choice([b"\xff" * 9 + b"\x7f", b"\xff\xff\xff\x7f", b"\x00" * 8, b"\x12\x00" * 5000, draw.randbytes(8)])
    else:
        piece = bytes(out[span])
        del out[span]
        at = draw.randrange(len(out) + 1)
        out[at:at] = piece
    return bytes(out)


def _fields(kind: str, payload: bytes, draw: random.Random) -> bytes:
    """Fields of the message removed, doubled, reordered or set to something odd, anywhere in it."""
    message = (messages.Scenario if kind == "womd_scenario" else messages.Example).FromString(payload)
    for _ in range(draw.choice([1, 1, 5])):
        _one_field(message, draw)
    return bytes(message.SerializeToString())


def _one_field(message: Any, draw: random.Random) -> None:
    while True:
        set_here = message.ListFields()
        if not set_here:
            return
        field, value = draw.choice(set_here)
        repeated = field.is_repeated
        if field.message_type is not None and draw.random() < 0.7:
            message = draw.choice(value) if repeated else value
            continue
        return _odd(message, field, value, draw) if not repeated else _odd_list(message, field, value, draw)


def _odd(message: Any, field: Any, value: Any, draw: random.Random) -> None:
    if field.message_type is not None or draw.random() < 0.3:
        message.ClearField(field.name)
        return
    for junk in draw.sample(JUNK, len(JUNK)):
        try:
            setattr(message, field.name, junk)
            return
        except (TypeError, ValueError, OverflowError):
            continue


def _odd_list(message: Any, field: Any, value: Any, draw: random.Random) -> None:
    items = list(value)
    way = draw.randrange(5)
    if way == 0:
        items = []
    elif way == 1:
        draw.shuffle(items)
    elif way == 2:
        items = items * draw.choice([2, 20])
    elif way == 3:
        del items[draw.randrange(len(items)) :]
    elif field.message_type is None and isinstance(items[0], int | float):
        items[draw.randrange(len(items))] = draw.choice(
            [-1, 2**31 - 1, 0, 99999] if isinstance(items[0], int) else [float("nan"), 3e38, -1.0]
        )
    kept = [copy.deepcopy(x) for x in items]
    message.ClearField(field.name)
    getattr(message, field.name).extend(kept)


def _tree(held: Any, draw: random.Random) -> Any:
    """Entries of nested dictionaries and lists removed, doubled, reordered or replaced by something odd."""
    for _ in range(draw.choice([1, 1, 5])):
        at = held
        while isinstance(at, dict | list) and at:
            key = draw.choice(list(at)) if isinstance(at, dict) else draw.randrange(len(at))
            if draw.random() < 0.25 or not isinstance(at[key], dict | list):
                way = draw.randrange(4)
                if way == 0:
                    del at[key]
                elif way == 1 and isinstance(at, list):
                    at[:] = draw.sample(at, len(at)) * draw.choice([1, 3])
                else:
                    at[key] = draw.choice(JUNK)
                break
            at = at[key]
    return held


class Bomb:
    """What a malicious pickle asks to be called."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.called = function, arguments

    def __reduce__(self) -> Any:
        return self.called


def malicious(flag: Path) -> dict[str, bytes]:
    """Pickles that run code, or grow without end; `flag` exists afterwards if one of them ran."""
    import os

    import numpy as np

    deep: Any = ()
    for _ in range(100_000):
        deep = (deep,)
    shared: list[Any] = [1.0] * 10
    for _ in range(30):
        shared = [shared] * 10
    many = b"".join((b"\x80\x04", b"]" * 1_100_000, b"."))
    nested = b"".join((b"\x80\x04}", b")" + b"\x85" * 200_000, b"Ns."))
    return {
        "system": pickle.dumps(Bomb(os.system, f"touch {flag}")),
        "eval": pickle.dumps({"tracks": Bomb(eval, f"open({str(flag)!r}, 'w')")}),
        "exec in protocol 0": pickle.dumps(Bomb(exec, f"open({str(flag)!r}, 'w')"), protocol=0),
        "instance": b"\x80\x02" + f"(S'touch {flag}'\nios\nsystem\n.".encode(),
        "object": b"\x80\x04\x95\x00\x00\x00\x00\x00\x00\x00\x00(cos\nsystem\n" + f"V{flag}\no.".encode(),
        "new object": b"\x80\x04cos\nsystem\nVtouch\n\x85\x81.",
        "attribute of a name": b"\x80\x04\x8c\x05numpy\x8c\x0bndarray.ctx\x93)R.",
        "getattr": pickle.dumps(Bomb(getattr, np.ndarray, "tofile")),
        "numpy load": pickle.dumps(Bomb(np.load, str(flag))),
        "huge array": pickle.dumps(Bomb(np.zeros, (10**12,))),
        "array that claims more than it has": pickle.dumps(np.zeros(4)).replace(b"K\x04\x85", b"J\xff\xff\xff\x7f\x85"),
        "huge bytes": b"\x80\x04\x8e" + b"\xff" * 7 + b"\x00" + b"x.",
        "huge text": b"\x80\x04\x8d" + b"\xff" * 6 + b"\x00\x00x.",
        "huge memo": b"\x80\x04Nr\xff\xff\xff\x7f.",
        "huge number": b"\x80\x02\x8b\xff\xff\xff\x7f\x01.",
        "million lists": many,
        "deep tuple as a key": nested,
        "deep tuple": pickle.dumps(None)[:2] + b")" + b"\x85" * 200_000 + b".",
        "shared lists": pickle.dumps({"tracks": {"1": {"type": "VEHICLE", "position": shared}}, "map_features": {}}),
        "itself": b"\x80\x04}q\x00\x8c\x06tracksh\x00s\x8c\x0cmap_featuresh\x00s.",
        "extension": b"\x80\x04\x82\x01.",
        "persistent": b"\x80\x04Nq\x00Q.",
    }


def outcome(file: Path) -> str:
    """What reading and converting comes to: scenes, or one line that names the file.

    Raises:
        AssertionError: the error has several lines or does not name the file.
    """
    try:
        for recording in read.recordings(file):
            convert(recording, Options(lanes=64, points=16))
    except UsageError as error:
        assert file.name in str(error) and "\n" not in str(error), f"{error!r} should be one line that names {file.name}"
        return "error"
    return "scenes"


def bases(kind: str) -> list[bytes]:
    """What is damaged: our own file, and up to two real ones."""
    folder = {"womd_scenario": "womd_scenario", "womd_tf_example": "womd_tf_example", "gpudrive_json": "gpudrive_json"}.get(
        kind, "scenarionet_*"
    )
    return [written(kind), *(f.read_bytes() for f in sorted(SHARED.glob(f"{folder}/*"), key=lambda f: f.stat().st_size)[:2])]


def _repickled(data: bytes, draw: random.Random) -> bytes:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # old pickles of numpy name modules that have moved
        held = pickle.loads(data)  # our own file, or a real one that we trust
    return pickle.dumps(_tree(held, draw), protocol=draw.choice([2, 3, 4, 5]))


def run(kind: str, count: int, seed: int, sources: list[bytes]) -> tuple[Counter[str], float]:
    """Outcomes of many damaged copies, and the slowest in s.

    Raises:
        Exception: whatever a loader raises beside `UsageError`; the offending file is kept and named.
    """
    draw, outcomes, slowest = random.Random(f"{kind}{seed}"), Counter[str](), 0.0
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("error")
        for number in range(count):
            file = Path(folder) / f"damaged{number}"
            file.write_bytes(mutated(kind, draw.choice(sources), draw))
            start = time.perf_counter()
            try:
                outcomes[outcome(file)] += 1
            except Exception:
                kept = Path(tempfile.gettempdir()) / f"fuzz_{kind}_{seed}_{number}"
                kept.write_bytes(file.read_bytes())
                sys.stderr.write(f"{kind} {number}: kept as {kept}\n")
                raise
            slowest = max(slowest, time.perf_counter() - start)
            file.unlink()
    return outcomes, slowest


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m tests.fuzz_logs", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=1000, help="damaged copies of each format")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=FORMATS, nargs="*", default=FORMATS)
    options = parser.parse_args()
    for kind in options.kind:
        outcomes, slowest = run(kind, options.count, options.seed, bases(kind))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{kind}: {dict(outcomes)}, slowest {slowest:.2f} s, peak memory so far {peak:.0f} MB", flush=True)


if __name__ == "__main__":
    main()
