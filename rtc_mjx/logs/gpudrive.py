"""GPUDrive and Nocturne JSON: scenes of the Waymo Open Motion Dataset without lane connectivity.

Files of several ages: older ones have no heights, ids, lane types, scenario id or metadata; headings are in degrees in some and in
radians in others, and nothing says which.
"""

import json
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from rtc_mjx.errors import UsageError
from rtc_mjx.logs.plain import dictionary, flat, name, names, number, sequence, whole
from rtc_mjx.logs.recording import (
    MOST_POINTS,
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
FASTEST_STILL = 2.0  # m/s, above which a road user heads where it moves


def read(data: bytes, source: str) -> Recording:
    """The recording in a file.

    Args:
        data: the whole file.
        source: the file, for messages.

    Raises:
        UsageError: it is no such JSON, or does not hold together.
    """
    try:
        held = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{source}: it is no JSON: {str(error).splitlines()[0]}") from error
    held = dictionary(held, "its content", source)
    metadata = held.get("metadata")
    metadata = metadata if isinstance(metadata, dict) else {}
    objects = [dictionary(o, "an object", source) for o in sequence(held.get("objects"), "objects", source)]
    repairs: Counter[str] = Counter()
    tracks, heights = _tracks(objects, source, repairs)
    times = tracks.valid.shape[1]
    wanted = metadata.get("tracks_to_predict")
    chosen = [whole(p.get("track_index") if isinstance(p, dict) else p, -1) for p in wanted] if isinstance(wanted, list) else None
    sdc = whole(metadata.get("sdc_track_index"), -1)
    unknown = [i for i in chosen or [] if not 0 <= i < len(objects)]
    refuse_if(bool(unknown), source, f"tracks_to_predict names tracks {unknown[:5]}; there are {len(objects)}")
    refuse_if(not -1 <= sdc < len(objects), source, f"sdc_track_index is {sdc}; there are {len(objects)} objects")
    return Recording(
        scenario=name(held.get("scenario_id")) or name(held.get("name")),
        source=source,
        kind="gpudrive_json",
        times=np.arange(times) / RATE,
        now=min(10, times - 1),
        tracks=tracks,
        map=_map(sequence(held.get("roads"), "roads", source), heights, source, repairs),
        signals=_signals(held.get("tl_states"), times, source),
        sdc=sdc,
        to_predict=None if chosen is None else tuple(chosen),
        of_interest=names(metadata.get("objects_of_interest")),
        repairs={what: count for what, count in repairs.items() if count},
    )


def _tracks(objects: list[dict[str, Any]], source: str, repairs: Counter[str]) -> tuple[Tracks, bool]:
    """The road users, and whether the file knows heights."""
    ids = tuple(name(o.get("id")) or f"#{i}" for i, o in enumerate(objects))
    times = max((len(o["position"]) for o in objects if isinstance(o.get("position"), list)), default=0)
    out, heights = empty_tracks(ids, times, source), False
    for i, held in enumerate(objects):
        place = points(held.get("position"), "an object's position", source)
        speed = points(held.get("velocity"), "an object's velocity", source)[:, :2]
        heading = flat(held.get("heading"), "an object's heading", source)
        valid = flat(held.get("valid"), "an object's valid", source) == 1
        count = min(len(place), len(speed), len(heading), len(valid))
        if count < times:
            repairs["objects shorter than the others"] += 1
        heights |= any(isinstance(p, dict) and "z" in p for p in held["position"][:1])
        marked = (place[:count, :2] == ABSENT).any(axis=1) | (heading[:count] == ABSENT)
        repairs["states at -10000 said to be valid, taken as absent"] += int(np.sum(marked & valid[:count]))
        out.kinds[i] = KINDS.get(str(held.get("type")).lower(), OTHER)
        out.pose[i, :count, :3], out.pose[i, :count, 3] = place[:count], heading[:count]
        out.velocity[i, :count], out.valid[i, :count] = speed[:count], valid[:count] & ~marked
        out.size[i] = [number(held.get(side)) for side in ("length", "width", "height")]
    if in_degrees(out):
        out.pose[..., 3] = np.radians(out.pose[..., 3])
        repairs["headings in degrees, turned into radians"] += int(np.sum(out.valid))
    return out, heights


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


def points(value: Any, what: str, source: str) -> np.ndarray:
    """Points as files have them: a list of {x, y} or {x, y, z}, or one of them; a missing z is 0."""
    held = [value] if isinstance(value, dict) else sequence(value, what, source)
    told = [(number(p.get("x")), number(p.get("y")), number(p.get("z", 0.0))) for p in (dictionary(p, what, source) for p in held)]
    return np.array(told, float).reshape(-1, 3)


def _map(roads: Sequence[Any], heights: bool, source: str, repairs: Counter[str]) -> Map:
    held: dict[str, list[Any]] = {place: [] for place in ("lanes", "stop_signs", *PLACES.values())}
    total = 0
    for i, road in enumerate(dictionary(r, "a road", source) for r in roads):
        known, kind = name(road.get("id")) or f"#{i}", str(road.get("type")).lower()
        line = points(road.get("geometry"), "a road's geometry", source)
        total += len(line)
        refuse_if(total > MOST_POINTS, source, f"its map has more than {MOST_POINTS} points")
        if kind == "lane":
            held["lanes"].append(Lane(known, line, LANES.get(whole(road.get("map_element_id"), 0), "unknown")))
        elif kind == "stop_sign" and len(line):
            held["stop_signs"].append(StopSign(known, line[0], ()))
        elif kind in PLACES:
            held[PLACES[kind]].append(Feature(known, line))
        else:
            repairs["map features of an unknown kind"] += 1
    return Map(connected=False, heights=heights, **{place: tuple(features) for place, features in held.items()})


def _signals(states: Any, times: int, source: str) -> Signals:
    """Traffic lights by lane: {lane: {state: [...], x: [...], y: [...], z: [...], time_index: [...]}}."""
    told: list[tuple[int, str, int, float, float, float]] = []
    for lane, held in (states if isinstance(states, dict) else {}).items():
        held = dictionary(held, f"tl_states of lane {str(lane)[:40]}", source)
        names_of = sequence(held.get("state", []), "a traffic light's state", source)
        at = held.get("time_index", list(range(len(names_of))))
        columns = [sequence(held.get(axis, []), f"a traffic light's {axis}", source) for axis in ("x", "y", "z")]
        for i, (time, state) in enumerate(zip(sequence(at, "a traffic light's time_index", source), names_of, strict=False)):
            place = [number(column[i]) if i < len(column) else float("nan") for column in columns]
            if state in SIGNAL_STATES and 0 <= whole(time, -1) < times:
                told.append((whole(time, -1), str(lane)[:80], SIGNAL_STATES.index(state), *place))  # type: ignore[arg-type]  # x, y and z
    return Signals(
        time=np.array([t[0] for t in told], int),
        lane=tuple(t[1] for t in told),
        state=np.array([t[2] for t in told], int),
        stop=np.array([t[3:] for t in told], float).reshape(-1, 3),
    )
