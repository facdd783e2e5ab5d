"""tf.Example records of the Waymo Open Motion Dataset: the same scenes as flat arrays of fixed lengths, without lane connectivity."""

import dataclasses
from typing import Any

import numpy as np

from rtc_mjx.logs import messages
from rtc_mjx.logs.plain import text
from rtc_mjx.logs.recording import (
    MOST_POINTS,
    MOST_SIGNALS,
    OTHER,
    SIGNAL_STATES,
    Feature,
    Lane,
    LaneKind,
    Map,
    Recording,
    Signals,
    StopSign,
    Tracks,
    empty_tracks,
    no_signals,
    refuse_if,
)
from rtc_mjx.logs.womd import MOST_ID, parsed

PARTS = ("past", "current", "future")
STATE = ("x", "y", "z", "bbox_yaw", "velocity_x", "velocity_y", "length", "width", "height")
LANES: dict[int, LaneKind] = {0: "unknown", 1: "freeway", 2: "surface_street", 3: "bike_lane"}
EDGES = (14, 15, 16)
STOP_SIGN = 17
FLAGS = ("is_sdc", "tracks_to_predict", "objects_of_interest")
AREAS = {18: "crosswalks", 19: "speed_bumps", 20: "driveways"}


class Arrays:
    """The features of an Example by name, asked for with their shape."""

    def __init__(self, payload: bytes, source: str) -> None:
        self.source = source
        self.values = {bytes(e.key): e.value for e in parsed(messages.Example, payload, source).features.feature}

    def __contains__(self, name: str) -> bool:
        return name.encode() in self.values

    def __call__(self, name: str, columns: int) -> np.ndarray:
        """The numbers of a feature, in rows.

        Raises:
            UsageError: it is missing, or does not have that many columns.
        """
        held = self.values.get(name.encode())
        refuse_if(held is None, self.source, f"feature {name} is missing")
        floats, integers = held.float_list.value, held.int64_list.value  # type: ignore[union-attr]  # refused above
        with np.errstate(invalid="ignore"):  # a signalling NaN becomes a quiet one
            flat = np.array(floats, float) if floats else np.array(integers, np.int64)
        refuse_if(flat.size % columns > 0, self.source, f"feature {name} has {flat.size} numbers, which is no multiple of {columns}")
        return flat.reshape(-1, columns)

    def whole(self, name: str) -> np.ndarray:
        """A feature of whole numbers, some of which are floats in the files; -1 for what is none."""
        numbers = self(name, 1)[:, 0]
        return np.where(np.isfinite(numbers) & (np.abs(numbers) < 2**62), numbers, -1).astype(np.int64)

    def over_time(self, group: str, name: str, lengths: tuple[int, ...], rows: int, times_first: bool) -> np.ndarray:
        """Past, current and future of a feature as (rows, times)."""
        parts = []
        for part, length in zip(PARTS, lengths, strict=True):
            found = self(f"{group}/{part}/{name}", rows if times_first else length)
            found = found.T if times_first else found
            refuse_if(found.shape != (rows, length), self.source, f"feature {group}/{part}/{name} is not {rows} x {length}")
            parts.append(found)
        return np.concatenate(parts, axis=1)

    def text(self, name: str) -> str:
        """The text of a feature; empty where it is missing."""
        held = self.values.get(name.encode())
        told = held.bytes_list.value[0] if held is not None and len(held.bytes_list.value) else b""
        return text(told[:MOST_ID].decode("utf-8", "replace"))


def read(payload: bytes, source: str) -> Recording:
    """The recording in a record's payload.

    Args:
        payload: a serialised Example with the features of the motion dataset.
        source: file and record, for messages.

    Raises:
        UsageError: it is not such an Example, or does not hold together.
    """
    arrays = Arrays(payload, source)
    ids, kinds = arrays.whole("state/id"), arrays.whole("state/type")
    slots = len(ids)
    refuse_if(not slots or len(kinds) != slots, source, f"feature state/id has {slots} numbers, state/type {len(kinds)}")
    lengths = tuple(arrays(f"state/{part}/x", 1).size // slots for part in PARTS)
    refuse_if(not all(lengths), source, f"its past, current and future have {lengths} times; at least one of each is needed")
    rows, repairs = np.flatnonzero(kinds >= 0), dict[str, int]()
    tracks = _tracks(arrays, rows, lengths, ids, kinds)
    flags = {name: arrays.whole(f"state/{name}") if f"state/{name}" in arrays else np.zeros(0) for name in FLAGS}
    marked = {name: [i for i, row in enumerate(rows) if row < len(flag) and flag[row] == 1] for name, flag in flags.items()}
    return Recording(
        scenario=arrays.text("scenario/id"),
        source=source,
        kind="womd_tf_example",
        times=_times(arrays, lengths, slots, rows, repairs),
        now=lengths[0],
        tracks=tracks,
        map=_map(arrays, source),
        signals=_signals(arrays, lengths, repairs),
        sdc=marked["is_sdc"][0] if marked["is_sdc"] else -1,
        to_predict=tuple(marked["tracks_to_predict"]),
        of_interest=tuple(tracks.ids[i] for i in marked["objects_of_interest"]),
        repairs=repairs,
    )


def _tracks(arrays: Arrays, rows: np.ndarray, lengths: tuple[int, ...], ids: np.ndarray, kinds: np.ndarray) -> Tracks:
    out = empty_tracks(tuple(str(ids[row]) for row in rows), sum(lengths), arrays.source)
    held = np.stack([arrays.over_time("state", name, lengths, len(ids), False)[rows] for name in STATE], axis=-1).astype(float)
    valid = arrays.over_time("state", "valid", lengths, len(ids), False)[rows] == 1
    out.kinds[:] = np.where(kinds[rows] <= OTHER, kinds[rows], 0)
    return dataclasses.replace(out, pose=held[..., :4], velocity=held[..., 4:6], size=held[..., 6:9], valid=valid)


def _times(arrays: Arrays, lengths: tuple[int, ...], slots: int, rows: np.ndarray, repairs: dict[str, int]) -> np.ndarray:
    """Seconds, from the timestamps of whoever is there at most times."""
    if all(f"state/{part}/timestamp_micros" in arrays for part in PARTS):
        stamps = arrays.over_time("state", "timestamp_micros", lengths, slots, False)[rows].astype(float) / 1e6
        known = (stamps > 0).sum(axis=1)
        if len(known) and known.max() >= stamps.shape[1] - 1:
            return stamps[int(np.argmax(known))]
    repairs["times without a stamp, taken as 10 Hz"] = sum(lengths)
    return np.arange(sum(lengths)) / 10.0


def _map(arrays: Arrays, source: str) -> Map:
    """Features from samples: runs of points of the same id and type."""
    xyz, valid = arrays("roadgraph_samples/xyz", 3).astype(float), arrays.whole("roadgraph_samples/valid") == 1
    ids, kinds = arrays.whole("roadgraph_samples/id"), arrays.whole("roadgraph_samples/type")
    refuse_if(len(xyz) > MOST_POINTS, source, f"its map has more than {MOST_POINTS} points")
    refuse_if(len({len(xyz), len(valid), len(ids), len(kinds)}) > 1, source, "its roadgraph_samples differ in number")
    xyz, ids, kinds = xyz[valid], ids[valid], kinds[valid]
    starts = np.flatnonzero(np.concatenate([[True], (ids[1:] != ids[:-1]) | (kinds[1:] != kinds[:-1])])) if len(ids) else np.zeros(0, int)
    held: dict[str, list[Any]] = {name: [] for name in ("lanes", "road_edges", "road_lines", "stop_signs", *AREAS.values())}
    for start, stop in zip(starts, [*starts[1:], len(ids)], strict=True):
        name, kind, points = str(ids[start]), int(kinds[start]), xyz[start:stop]
        if kind in LANES:
            held["lanes"].append(Lane(name, points, LANES[kind]))
        elif kind == STOP_SIGN:
            held["stop_signs"].append(StopSign(name, points[0], ()))
        else:
            held[AREAS.get(kind, "road_edges" if kind in EDGES else "road_lines")].append(Feature(name, points))
    features: dict[str, Any] = {name: tuple(found) for name, found in held.items()}
    return Map(connected=False, **features)


def _signals(arrays: Arrays, lengths: tuple[int, ...], repairs: dict[str, int]) -> Signals:
    """Traffic lights lie (times, lights) in the record."""
    group = "traffic_light_state"
    if f"{group}/current/state" not in arrays:
        repairs["records without traffic lights"] = 1
        return no_signals()
    lights = arrays(f"{group}/current/state", 1).size
    held = {name: arrays.over_time(group, name, lengths, max(1, lights), True) for name in ("state", "id", "valid", "x", "y", "z")}
    there = (held["valid"] == 1) & (held["state"] >= 0) & (held["state"] < len(SIGNAL_STATES))
    time, light = np.nonzero(there.T)
    refuse_if(
        len(time) > MOST_SIGNALS, arrays.source, f"it claims {len(time)} states of traffic lights; more than {MOST_SIGNALS} are not read"
    )
    stop = np.stack([held[name][light, time].astype(float) for name in ("x", "y", "z")], axis=-1)
    return Signals(time, tuple(f"{i:.0f}" for i in held["id"][light, time]), held["state"][light, time].astype(int), stop)
