"""ScenarioNet pickles: scenes of the Waymo Open Motion Dataset and of nuScenes as dictionaries of numpy arrays, in several versions.

Lanes of nuScenes have no connectivity, and their third column is a heading, not a height; there are no road edges either.
"""

from collections import Counter
from typing import Any

import numpy as np

from rtc_mjx.logs import pickled
from rtc_mjx.logs.plain import dictionary, flat, name, names, number, rows, whole
from rtc_mjx.logs.recording import (
    MOST_POINTS,
    MPH,
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
from rtc_mjx.logs.scene import CYCLIST, PEDESTRIAN, RATE, VEHICLE

KINDS = {"VEHICLE": VEHICLE, "PEDESTRIAN": PEDESTRIAN, "CYCLIST": CYCLIST, "UNSET": 0}
LANES: dict[str, LaneKind] = {
    "LANE_FREEWAY": "freeway", "LANE_SURFACE_STREET": "surface_street", "LANE_SURFACE_UNSTRUCTURE": "surface_street",
    "LANE_BIKE_LANE": "bike_lane",
}  # fmt: skip
AREAS = {"CROSSWALK": "crosswalks", "CROSS_WALK": "crosswalks", "SPEED_BUMP": "speed_bumps", "DRIVEWAY": "driveways"}
KMH = 1 / 3.6  # m/s


def read(data: bytes, source: str) -> Recording:
    """The recording in a file.

    Args:
        data: the whole file.
        source: the file, for messages.

    Raises:
        UsageError: it is no such pickle, holds more than data, or does not hold together.
    """
    held = dictionary(pickled.load(data, source), "its content", source)
    metadata = held.get("metadata") if isinstance(held.get("metadata"), dict) else {}
    told: dict[Any, Any] = {**held, **dictionary(metadata, "metadata", source)}
    repairs: Counter[str] = Counter()
    given = dictionary(held.get("tracks"), "tracks", source)
    tracks = _tracks(given, source, repairs)
    times = _times(told.get("ts"), tracks.valid.shape[1], source, repairs)
    wanted = told.get("tracks_to_predict")
    chosen = [tracks.ids.index(i) for i in names(list(wanted)) if i in tracks.ids] if isinstance(wanted, dict | list) else None
    return Recording(
        scenario=name(told.get("scenario_id")) or name(held.get("id")),
        source=source,
        kind="scenarionet",
        times=times,
        now=min(max(0, whole(told.get("current_time_index"), 0)), len(times) - 1),
        tracks=tracks,
        map=_map(dictionary(held.get("map_features"), "map_features", source), told.get("dataset") == "nuscenes", source, repairs),
        signals=_signals(held.get("dynamic_map_states"), len(times), source, repairs),
        sdc=_sdc(told, tracks.ids),
        to_predict=None if chosen is None else tuple(chosen),
        of_interest=names(told.get("objects_of_interest")),
        repairs={what: count for what, count in repairs.items() if count},
    )


def _sdc(told: dict[Any, Any], ids: tuple[str, ...]) -> int:
    """Newer files name the car's id; older ones have that id in sdc_track_index, newer ones an index there."""
    for key in ("sdc_id", "sdc_track_index"):
        if name(told.get(key)) in ids:
            return ids.index(name(told.get(key)))
    return -1


def _tracks(given: dict[Any, Any], source: str, repairs: Counter[str]) -> Tracks:
    states = [dictionary(t, "a track", source) for t in given.values()]
    states = [dictionary(t.get("state", t), "a track's state", source) for t in states]
    places = [rows(s.get("position"), 3, "a track's position", source) for s in states]
    out = empty_tracks(tuple(name(i) for i in given), max((len(p) for p in places), default=0), source)
    for i, (track, state, place) in enumerate(zip(given.values(), states, places, strict=True)):
        heading, valid = (flat(state.get(what), f"a track's {what}", source) for what in ("heading", "valid"))
        velocity = rows(state.get("velocity"), 2, "a track's velocity", source)
        count = min(len(place), len(heading), len(valid), len(velocity))
        repairs["tracks shorter than the others"] += count < out.valid.shape[1]
        out.kinds[i] = KINDS.get(str(track.get("type")), OTHER)
        out.pose[i, :count, :3], out.pose[i, :count, 3] = place[:count], heading[:count]
        out.velocity[i, :count], out.valid[i, :count] = velocity[:count], valid[:count] > 0
        sides = _sizes(state, source)[:count]
        out.size[i, : len(sides)] = sides
    return out


def _sizes(state: dict[Any, Any], source: str) -> np.ndarray:
    """Length, width and height over time: one array of three columns, or three."""
    if "size" in state:
        return rows(state["size"], 3, "a track's size", source)
    sides = [flat(state.get(side, []), f"a track's {side}", source) for side in ("length", "width", "height")]
    count = min(len(s) for s in sides)
    return np.stack([s[:count] for s in sides], axis=-1)


def _times(stamps: Any, count: int, source: str, repairs: Counter[str]) -> np.ndarray:
    held = flat(stamps, "ts", source) if stamps is not None else np.zeros(0)
    if len(held) == count:
        return held
    repairs["times without a stamp, taken as 10 Hz"] += count
    return np.arange(count) / RATE


def _map(features: dict[Any, Any], flat_lanes: bool, source: str, repairs: Counter[str]) -> Map:
    held: dict[str, list[Any]] = {place: [] for place in ("lanes", "road_edges", "road_lines", "stop_signs", *AREAS.values())}
    total, connected = 0, False
    for known, feature in features.items():
        feature, known = dictionary(feature, "a map feature", source), name(known)
        kind = str(feature["type"]) if isinstance(feature.get("type"), str) else ""  # in old files it may be the feature itself
        line = rows(feature.get("polyline", feature.get("polygon", [])), 2 if flat_lanes else 3, "a map feature's points", source)
        line = np.pad(line, [(0, 0), (0, 1)]) if flat_lanes else line
        total += len(line)
        refuse_if(total > MOST_POINTS, source, f"its map has more than {MOST_POINTS} points")
        if kind in LANES or kind.startswith("LANE_"):
            held["lanes"].append(_lane(known, line, LANES.get(kind, "unknown"), feature))
            connected |= bool(held["lanes"][-1].entries or held["lanes"][-1].exits)
        elif kind.upper() == "STOP_SIGN":
            place = flat(feature.get("position", feature.get("pos", [])), "a stop sign's position", source)
            place = place if len(place) == 3 else np.full(3, np.nan)
            held["stop_signs"].append(StopSign(known, place, names(feature.get("lane", feature.get("lanes")))))
        elif kind.startswith(("ROAD_EDGE", "ROAD_LINE")):
            held["road_edges" if kind.startswith("ROAD_EDGE") else "road_lines"].append(Feature(known, line))
        elif kind in AREAS:
            held[AREAS[kind]].append(Feature(known, line))
        else:
            repairs["map features of an unknown kind"] += 1
    return Map(connected=connected, heights=not flat_lanes, **{place: tuple(x) for place, x in held.items()})


def _lane(known: str, line: np.ndarray, kind: LaneKind, feature: dict[Any, Any]) -> Lane:
    mph, kmh = number(feature.get("speed_limit_mph")), number(feature.get("speed_limit_kmh"))
    return Lane(
        id=known,
        line=line,
        kind=kind,
        speed_limit=MPH * mph if np.isfinite(mph) else KMH * kmh,
        entries=names(feature.get("entry_lanes")),
        exits=names(feature.get("exit_lanes")),
        left=_neighbours(feature.get("left_neighbor")),
        right=_neighbours(feature.get("right_neighbor")),
    )


def _neighbours(beside: Any) -> tuple[str, ...]:
    """Ids of neighbours: {feature_id} in newer files, {id} in older ones."""
    held = beside if isinstance(beside, list) else []
    return names([n.get("feature_id", n.get("id")) if isinstance(n, dict) else n for n in held])


def _signals(states: Any, times: int, source: str, repairs: Counter[str]) -> Signals:
    """Traffic lights by lane; the list by time of the oldest files is empty in all that we have seen, and left out."""
    if not isinstance(states, dict):
        odd = [x for x in states if x and x != [{}]] if isinstance(states, list) else []
        repairs["signal states of an unknown layout, dropped"] += len(odd)
        return no_signals()
    told: list[tuple[int, str, int, tuple[float, ...]]] = []
    for light, held in states.items():
        held = dictionary(held, "a traffic light", source)
        state = dictionary(held.get("state"), "a traffic light's state", source)
        seen = state.get("object_state", [])
        seen = list(seen.value.reshape(-1)) if isinstance(seen, pickled.Array) else list(seen) if isinstance(seen, list | tuple) else []
        there = names(state["lane"]) if "lane" in state else (name(held.get("lane", light)) or name(light),) * len(seen)
        stops = state.get("stop_point", held.get("stop_point"))
        place = rows(stops, 3, "a traffic light's stop_point", source) if _many(stops) else np.tile(_one(stops, source), (len(seen), 1))
        for time, (x, lane) in enumerate(zip(seen[:times], there, strict=False)):
            index = _state(x)
            if index is not None and not ("lane" in state and lane == "0"):  # files fill up with lane 0
                told.append((time, lane, index, tuple(place[time]) if time < len(place) else (float("nan"),) * 3))
    return Signals(
        time=np.array([t[0] for t in told], int),
        lane=tuple(t[1] for t in told),
        state=np.array([t[2] for t in told], int),
        stop=np.array([t[3] for t in told], float).reshape(-1, 3),
    )


def _many(stops: Any) -> bool:
    return isinstance(stops, pickled.Array) and stops.value.ndim == 2


def _one(stops: Any, source: str) -> np.ndarray:
    place = flat(stops, "a traffic light's stop_point", source) if isinstance(stops, pickled.Array | list | tuple) else np.zeros(0)
    return place if len(place) == 3 else np.full(3, np.nan)


def _state(x: Any) -> int | None:
    """Index of a signal state: text such as LANE_STATE_GO, or the number of the proto; None: none is told."""
    if isinstance(x, str):
        told = x.removeprefix("LANE_STATE_").lower()
        return SIGNAL_STATES.index(told) if told in SIGNAL_STATES else None
    index = whole(x, -1)
    return index if 0 <= index < len(SIGNAL_STATES) else None
