"""GPUDrive and Nocturne JSON: scenes of the Waymo Open Motion Dataset without lane connectivity.

Files of several ages: older ones have no heights, ids, lane types, scenario id or metadata; headings are in degrees in some and in
radians in others, and nothing says which.
"""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from rtc_mjx.errors import UsageError
from rtc_mjx.logs.plain import Plain, name, number, text, whole
from rtc_mjx.logs.recording import (
    MOST_FEATURES,
    MOST_POINTS,
    MOST_SIGNALS,
    MOST_TRACKS,
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
    refuse_if,
)
from rtc_mjx.logs.scene import CYCLIST, PEDESTRIAN, RATE, VEHICLE

ABSENT = -10000.0  # marks a coordinate that is not there
KINDS = {"vehicle": VEHICLE, "pedestrian": PEDESTRIAN, "cyclist": CYCLIST, "other": OTHER}
LANES: dict[int, LaneKind] = {1: "freeway", 2: "surface_street", 3: "bike_lane"}  # by map_element_id
PLACES = {
    "road_edge": "road_edges", "road_line": "road_lines", "crosswalk": "crosswalks", "speed_bump": "speed_bumps", "driveway": "driveways",
}  # fmt: skip
MOST_JSON = 2_000_000  # values of a file, of which each may take a hundred times its text; real files have a quarter of a million
FASTEST_STILL = 2.0  # m/s, above which a road user heads where it moves


def read(data: bytes, source: str) -> Recording:
    """The recording in a file.

    Args:
        data: the whole file.
        source: the file, for messages.

    Raises:
        UsageError: it is no such JSON, or does not hold together.
    """
    ask = Plain(source)
    held = ask.dictionary(_parsed(data, source), "its content")
    metadata = held.get("metadata")
    ask.repairs["metadata that are no dictionary, dropped"] += not isinstance(metadata, dict | None)
    metadata = metadata if isinstance(metadata, dict) else {}
    objects = ask.sequence(held.get("objects"), "objects")
    ask.refuse_if(len(objects) > MOST_TRACKS, f"it claims {len(objects)} objects; more than {MOST_TRACKS} are not read")
    tracks, heights = _tracks([ask.dictionary(o, "an object") for o in objects], ask)
    times = tracks.valid.shape[1]
    sdc = whole(metadata.get("sdc_track_index"), -1)
    ask.refuse_if(not -1 <= sdc < len(objects), f"sdc_track_index is {sdc}; there are {len(objects)} objects")
    return Recording(
        scenario=name(held.get("scenario_id")) or name(held.get("name")),
        source=source,
        kind="gpudrive_json",
        times=np.arange(times) / RATE,
        now=min(10, times - 1),
        tracks=tracks,
        map=_map(ask.sequence(held.get("roads"), "roads"), heights, ask),
        signals=_signals(held.get("tl_states"), times, ask),
        sdc=sdc,
        to_predict=_to_predict(metadata.get("tracks_to_predict"), len(objects), ask),
        of_interest=ask.names(metadata.get("objects_of_interest"), "objects_of_interest"),
        repairs={what: count for what, count in ask.repairs.items() if count},
    )


def _parsed(data: bytes, source: str) -> Any:
    """What a file of JSON says.

    Raises:
        UsageError: it is none, or more than any recording is.
    """
    count = sum(map(data.count, (b",", b"[", b"{")))
    refuse_if(count > MOST_JSON, source, f"it has {count} values; files of this kind are read up to {MOST_JSON}")
    try:
        return json.loads(data)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{source}: it is no JSON: {str(error).splitlines()[0]}") from error


def _to_predict(wanted: Any, objects: int, ask: Plain) -> tuple[int, ...] | None:
    if wanted is None:
        return None
    held = ask.items(wanted, "tracks_to_predict")
    chosen = list(dict.fromkeys(whole(p.get("track_index") if isinstance(p, dict) else p, -1) for p in held))
    unknown = [i for i in chosen if not 0 <= i < objects]
    ask.refuse_if(bool(unknown), f"tracks_to_predict names tracks {unknown[:5]}; there are {objects}")
    return tuple(chosen) if isinstance(wanted, list) else None


def _tracks(objects: list[dict[str, Any]], ask: Plain) -> tuple[Tracks, bool]:
    """The road users, and whether the file knows heights."""
    ids = _ids(objects, ask)
    times = max((len(o["position"]) for o in objects if isinstance(o.get("position"), list)), default=0)
    out, heights = empty_tracks(ids, times, ask.source), False
    for i, held in enumerate(objects):
        told = point_list(held.get("position"), "an object's position", ask)
        place, speed = coordinates(told), coordinates(point_list(held.get("velocity"), "an object's velocity", ask))[:, :2]
        heading = ask.flat(held.get("heading"), "an object's heading")
        valid = ask.flat(held.get("valid"), "an object's valid") == 1
        lengths = {len(place), len(speed), len(heading), len(valid)}
        count = min(lengths)
        ask.repairs["objects shorter than the others"] += count < times
        ask.repairs["objects with parts of different lengths, cut to the shortest"] += len(lengths) > 1
        heights |= any("z" in p for p in told[:1])
        marked = (place[:count, :2] == ABSENT).any(axis=1) | (heading[:count] == ABSENT)
        ask.repairs["states at -10000 said to be valid, taken as absent"] += int(np.sum(marked & valid[:count]))
        out.kinds[i] = KINDS.get(text(held.get("type")).lower(), OTHER)
        out.pose[i, :count, :3], out.pose[i, :count, 3] = place[:count], heading[:count]
        out.velocity[i, :count], out.valid[i, :count] = speed[:count], valid[:count] & ~marked
        out.size[i] = [number(held.get(side)) for side in ("length", "width", "height")]
    if in_degrees(out):
        out.pose[..., 3] = np.radians(out.pose[..., 3])
        ask.repairs["headings in degrees, turned into radians"] += int(np.sum(out.valid))
    return out, heights


def _ids(objects: list[dict[str, Any]], ask: Plain) -> tuple[str, ...]:
    """The ids of objects; one that has none, or that of another before it, is named by its place."""
    out: list[str] = []
    seen: set[str] = set()
    for i, known in enumerate(name(o.get("id")) for o in objects):
        ask.repairs["objects with the id of another, named by their place"] += known in seen
        out.append(f"#{i}" if not known or known in seen else known)
        seen |= {known} - {""}
    return tuple(out)


def in_degrees(tracks: Tracks) -> bool:
    """Whether headings are degrees: some are beyond any angle in radians, or those who move head where they move only if so."""
    heading = tracks.pose[..., 3][tracks.valid]
    heading = heading[np.isfinite(heading)]
    if np.any(np.abs(heading) > 2 * np.pi + 0.1):
        return True
    moving = tracks.valid & (np.linalg.norm(tracks.velocity, axis=-1) > FASTEST_STILL)
    way, heading = np.arctan2(tracks.velocity[..., 1], tracks.velocity[..., 0])[moving], tracks.pose[..., 3][moving]
    fits = [np.nanmean(np.cos(h - way)) if len(way) else 1.0 for h in (heading, np.radians(heading))]
    return bool(fits[1] > fits[0] + 0.1)


def point_list(value: Any, what: str, ask: Plain) -> list[dict[str, Any]]:
    """Points as files have them: a list of {x, y} or {x, y, z}, or one of them."""
    held = [value] if isinstance(value, dict) else ask.sequence(value, what)
    ask.spend(3 * len(held), what)
    return [ask.dictionary(p, what) for p in held]


def coordinates(points: list[dict[str, Any]]) -> np.ndarray:
    """Points as rows; a missing z is 0."""
    return np.array([(number(p.get("x")), number(p.get("y")), number(p.get("z", 0.0))) for p in points], float).reshape(-1, 3)


def _map(roads: Sequence[Any], heights: bool, ask: Plain) -> Map:
    held: dict[str, list[Any]] = {place: [] for place in ("lanes", "stop_signs", *PLACES.values())}
    ask.refuse_if(len(roads) > MOST_FEATURES, f"its map has {len(roads)} roads; more than {MOST_FEATURES} are not read")
    total = 0
    for i, road in enumerate(ask.dictionary(r, "a road") for r in roads):
        known, kind = name(road.get("id")) or f"#{i}", text(road.get("type")).lower()
        told = point_list(road.get("geometry"), "a road's geometry", ask)
        total += len(told)
        ask.refuse_if(total > MOST_POINTS, f"its map has more than {MOST_POINTS} points")
        line = coordinates(told)
        if kind == "lane":
            held["lanes"].append(Lane(known, line, LANES.get(whole(road.get("map_element_id"), 0), "unknown")))
        elif kind == "stop_sign" and len(line):
            held["stop_signs"].append(StopSign(known, line[0], ()))
        elif kind in PLACES:
            held[PLACES[kind]].append(Feature(known, line))
        else:
            ask.repairs["map features of an unknown kind"] += 1
    return Map(connected=False, heights=heights, **{place: tuple(features) for place, features in held.items()})


def _signals(states: Any, times: int, ask: Plain) -> Signals:
    """Traffic lights by lane: {lane: {state: [...], x: [...], y: [...], z: [...], time_index: [...]}}."""
    told: list[tuple[int, str, int, tuple[float, ...]]] = []
    ask.repairs["signal states of an unknown layout, dropped"] += bool(states) and not isinstance(states, dict)
    for lane, held in (states if isinstance(states, dict) else {}).items():
        told += _light(name(lane), ask.dictionary(held, f"tl_states of lane {name(lane)[:40]}"), times, ask)
        ask.refuse_if(len(told) > MOST_SIGNALS, f"it has more than {MOST_SIGNALS} states of traffic lights; so many are not read")
    return Signals(
        time=np.array([t[0] for t in told], int),
        lane=tuple(t[1] for t in told),
        state=np.array([t[2] for t in told], int),
        stop=np.array([t[3] for t in told], float).reshape(-1, 3),
    )


def _light(lane: str, held: dict[Any, Any], times: int, ask: Plain) -> list[tuple[int, str, int, tuple[float, ...]]]:
    """Time, lane, state and stop point of one light."""
    states = ask.sequence(held.get("state", []), "a traffic light's state")
    at = ask.sequence(held.get("time_index", list(range(len(states)))), "a traffic light's time_index")
    columns = [ask.sequence(held.get(axis, []), f"a traffic light's {axis}") for axis in ("x", "y", "z")]
    told = []
    for i, (time, state) in enumerate(zip(at, states, strict=False)):
        place = tuple(number(column[i]) if i < len(column) else float("nan") for column in columns)
        if state in SIGNAL_STATES and 0 <= whole(time, -1) < times:
            told.append((whole(time, -1), lane, SIGNAL_STATES.index(state), place))
    ask.repairs["signal states of an unknown kind or time, dropped"] += max(len(states), len(at)) - len(told)
    return told
