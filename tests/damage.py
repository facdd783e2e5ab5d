"""Damaged copies of recordings: bits flipped, cut off, fields removed, doubled, reordered or set to something odd, counts made huge."""

import contextlib
import copy
import json
import pickle
import random
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from rtc_mjx.logs import messages
from tests.recorded import tfrecord

JUNK: list[Any] = [
    None, True, -1, 0, 2**31, 2**63, -(2**63) - 1, 10**400, 1e308, float("nan"), float("inf"), "", "x" * 1000, "é", b"\x00", [], {}, [[]],
    [None], [[1.0]] * 50, {"a": 1}, [1e300] * 91, [float("nan")] * 91, ("a", 1),
    {"x": 1, "y": 2}, {"x": None}, [[[[[]]]]], list(range(2000)), "\ud800\n", np.zeros(3), np.array(["LANE_STATE_GO", "x" * 100]),
]  # fmt: skip

ARRAYS: list[Callable[[np.ndarray], np.ndarray]] = [  # what else an array may be
    np.transpose, np.ravel, lambda x: x[:0], lambda x: x[::2], lambda x: np.repeat(x, 20, axis=0), lambda x: x[None],
    lambda x: x.astype(object), lambda x: x.astype("U8"), lambda x: x.astype(x.dtype.newbyteorder()), lambda x: x.astype("f2"),
    lambda x: np.zeros((50_000, 0)), lambda x: x.view("u1"), lambda x: np.asfortranarray(x),
]  # fmt: skip


def mutated(kind: str, data: bytes, draw: random.Random) -> bytes:
    """A damaged copy of a file."""
    ways: list[Callable[[], bytes]] = [lambda: _bytes(data, draw)]
    if kind in ("womd_scenario", "womd_tf_example"):
        ways += [lambda: tfrecord(_bytes(data[12:-4], draw)), lambda: tfrecord(_fields(kind, data[12:-4], draw))] * 2
    elif kind == "gpudrive_json":
        ways += [lambda: json.dumps(_tree(json.loads(data), draw), default=repr).encode()] * 2
    else:
        ways += [lambda: _repickled(data, draw)] * 2
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # old pickles of numpy name modules that have moved; what does not fit a type overflows
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
                elif way == 1 and isinstance(at, dict):
                    at[key] = draw.choice(list(at.values()))
                elif way == 2 and isinstance(at[key], np.ndarray):
                    with contextlib.suppress(TypeError, ValueError):  # not every array can be all of these
                        at[key] = draw.choice(ARRAYS)(at[key])
                else:
                    at[key] = copy.deepcopy(draw.choice(JUNK))  # it may be damaged in its turn
                break
            at = at[key]
    return held


def _repickled(data: bytes, draw: random.Random) -> bytes:
    held = pickle.loads(data)  # our own file, or a real one that we trust
    return pickle.dumps(_tree(held, draw), protocol=draw.choice([2, 3, 4, 5]))
