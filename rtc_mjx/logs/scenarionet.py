"""ScenarioNet pickles: scenes of the Waymo Open Motion Dataset and of nuScenes as dictionaries of numpy arrays, in several versions.

Lanes of nuScenes have no connectivity, and their third column is a heading, not a height; there are no road edges either.
"""

from typing import Any

import numpy as np

from rtc_mjx.logs import pickled
from rtc_mjx.logs.plain import Plain, name, number, text, whole
from rtc_mjx.logs.recording import (
    MOST_FEATURES,
    MOST_LINKS,
    MOST_POINTS,
    MOST_SIGNALS,
    MOST_TRACKS,
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
    current,
    empty_tracks,
    no_signals,
)
from rtc_mjx.logs.scene import CYCLIST, PEDESTRIAN, RATE, VEHICLE

KINDS = {"VEHICLE": VEHICLE, "PEDESTRIAN": PEDESTRIAN, "CYCLIST": CYCLIST, "UNSET": 0}
LANES: dict[str, LaneKind] = {
    "LANE_FREEWAY": "freeway", "LANE_SURFACE_STREET": "surface_street", "LANE_SURFACE_UNSTRUCTURE": "surface_street",
    "LANE_BIKE_LANE": "bike_lane",
}  # fmt: skip
AREAS = {"CROSSWALK": "crosswalks", "CROSS_WALK": "crosswalks", "SPEED_BUMP": "speed_bumps", "DRIVEWAY": "driveways"}
KMH = 1 / 3.6  # m/s
STOP = "a traffic light's stop_point"


def read(data: bytes, source: str) -> Recording:
    """The recording in a file.

    Args:
        data: the whole file.
        source: the file, for messages.

    Raises:
        UsageError: it is no such pickle, holds more than data, or does not hold together.
    """
    ask = Plain(source)
    held = ask.dictionary(pickled.load(data, source), "its content")
    metadata = held.get("metadata") if isinstance(held.get("metadata"), dict) else {}
    told: dict[Any, Any] = {**held, **ask.dictionary(metadata, "metadata")}
    tracks = _tracks(ask.dictionary(held.get("tracks"), "tracks"), ask)
    times = _times(told.get("ts"), tracks.valid.shape[1], ask)
    features = ask.dictionary(held.get("map_features"), "map_features")
    return Recording(
        scenario=name(told.get("scenario_id")) or name(held.get("id")),
        source=source,
        kind="scenarionet",
        times=times,
        now=current(whole(told.get("current_time_index"), 0), len(times), ask.repairs),
        tracks=tracks,
        map=_map(features, told.get("dataset") == "nuscenes", ask),
        signals=_signals(held.get("dynamic_map_states"), len(times), ask),
        sdc=_sdc(told, tracks.ids),
        to_predict=_to_predict(told.get("tracks_to_predict"), tracks.ids, ask),
        of_interest=ask.names(told.get("objects_of_interest"), "objects_of_interest"),
        repairs={what: count for what, count in ask.repairs.items() if count},
    )


def _to_predict(wanted: Any, ids: tuple[str, ...], ask: Plain) -> tuple[int, ...] | None:
    if not isinstance(wanted, dict | list):
        return None
    index = {known: i for i, known in reversed(list(enumerate(ids)))}
    named = dict.fromkeys(ask.names(list(wanted), "tracks_to_predict"))
    ask.repairs["tracks to predict that are not among the tracks"] += len(named.keys() - index.keys())
    return tuple(index[known] for known in named if known in index)


def _sdc(told: dict[Any, Any], ids: tuple[str, ...]) -> int:
    """Newer files name the car's id; older ones have that id in sdc_track_index, newer ones an index there."""
    for key in ("sdc_id", "sdc_track_index"):
        if name(told.get(key)) in ids:
            return ids.index(name(told.get(key)))
    return -1


def _tracks(given: dict[Any, Any], ask: Plain) -> Tracks:
    ask.refuse_if(len(given) > MOST_TRACKS, f"it claims {len(given)} tracks; more than {MOST_TRACKS} are not read")
    tracks = [ask.dictionary(t, "a track") for t in given.values()]
    states = [ask.dictionary(t.get("state", t), "a track's state") for t in tracks]
    places = [ask.rows(s.get("position"), 3, "a track's position") for s in states]
    out = empty_tracks(tuple(name(i) for i in given), max((len(p) for p in places), default=0), ask.source)
    for i, (track, state, place) in enumerate(zip(tracks, states, places, strict=True)):
        heading, valid = (ask.flat(state.get(what), f"a track's {what}") for what in ("heading", "valid"))
        velocity = ask.rows(state.get("velocity"), 2, "a track's velocity")
        lengths = {len(place), len(heading), len(valid), len(velocity)}
        count = min(lengths)
        ask.repairs["tracks shorter than the others"] += count < out.valid.shape[1]
        ask.repairs["tracks with parts of different lengths, cut to the shortest"] += len(lengths) > 1
        out.kinds[i] = KINDS.get(text(track.get("type")), OTHER)
        out.pose[i, :count, :3], out.pose[i, :count, 3] = place[:count], heading[:count]
        out.velocity[i, :count], out.valid[i, :count] = velocity[:count], valid[:count] > 0
        sides = _sizes(state, ask)[:count]
        out.size[i, : len(sides)] = sides
    return out


def _sizes(state: dict[Any, Any], ask: Plain) -> np.ndarray:
    """Length, width and height over time: one array of three columns, or three."""
    if "size" in state:
        return ask.rows(state["size"], 3, "a track's size")
    sides = [ask.flat(state.get(side, []), f"a track's {side}") for side in ("length", "width", "height")]
    count = min(len(s) for s in sides)
    return np.stack([s[:count] for s in sides], axis=-1)


def _times(stamps: Any, count: int, ask: Plain) -> np.ndarray:
    held = ask.flat(stamps, "ts") if stamps is not None else np.zeros(0)
    if len(held) == count:
        return held
    ask.repairs["times without a stamp, taken as 10 Hz"] += count
    return np.arange(count) / RATE


def _map(features: dict[Any, Any], flat_lanes: bool, ask: Plain) -> Map:
    held: dict[str, list[Any]] = {place: [] for place in ("lanes", "road_edges", "road_lines", "stop_signs", *AREAS.values())}
    ask.refuse_if(len(features) > MOST_FEATURES, f"its map has {len(features)} features; more than {MOST_FEATURES} are not read")
    total, links, connected = 0, 0, False
    for known, feature in features.items():
        feature, known = ask.dictionary(feature, "a map feature"), name(known)
        kind = text(feature.get("type"))  # in old files it may be the feature itself
        line = ask.rows(feature.get("polyline", feature.get("polygon", [])), 2 if flat_lanes else 3, "a map feature's points")
        line = np.pad(line, [(0, 0), (0, 1)]) if flat_lanes else line
        total += len(line)
        ask.refuse_if(total > MOST_POINTS, f"its map has more than {MOST_POINTS} points")
        if kind in LANES or kind.startswith("LANE_"):
            lane = _lane(known, line, LANES.get(kind, "unknown"), feature, ask)
            held["lanes"].append(lane)
            connected |= bool(lane.entries or lane.exits)
            links += sum(map(len, (lane.entries, lane.exits, lane.left, lane.right)))
            ask.refuse_if(links > MOST_LINKS, f"its map has more than {MOST_LINKS} links between lanes")
        elif kind.upper() == "STOP_SIGN":
            place = _one(feature.get("position", feature.get("pos")), "a stop sign's position", ask)
            held["stop_signs"].append(StopSign(known, place, ask.names(feature.get("lane", feature.get("lanes")), "a stop sign's lanes")))
        elif kind.startswith(("ROAD_EDGE", "ROAD_LINE")):
            held["road_edges" if kind.startswith("ROAD_EDGE") else "road_lines"].append(Feature(known, line))
        elif kind in AREAS:
            held[AREAS[kind]].append(Feature(known, line))
        else:
            ask.repairs["map features of an unknown kind"] += 1
    return Map(connected=connected, heights=not flat_lanes, **{place: tuple(x) for place, x in held.items()})


def _lane(known: str, line: np.ndarray, kind: LaneKind, feature: dict[Any, Any], ask: Plain) -> Lane:
    mph, kmh = number(feature.get("speed_limit_mph")), number(feature.get("speed_limit_kmh"))
    return Lane(
        id=known,
        line=line,
        kind=kind,
        speed_limit=MPH * mph if np.isfinite(mph) else KMH * kmh,
        entries=ask.names(feature.get("entry_lanes"), "a lane's entry_lanes"),
        exits=ask.names(feature.get("exit_lanes"), "a lane's exit_lanes"),
        left=_neighbours(feature.get("left_neighbor"), ask),
        right=_neighbours(feature.get("right_neighbor"), ask),
    )


def _neighbours(beside: Any, ask: Plain) -> tuple[str, ...]:
    """Ids of neighbours: {feature_id} in newer files, {id} in older ones."""
    held = ask.items(beside, "a lane's neighbours")
    return tuple(name(n.get("feature_id", n.get("id")) if isinstance(n, dict) else n) for n in held)


def _signals(states: Any, times: int, ask: Plain) -> Signals:
    """Traffic lights by lane; the list by time of the oldest files is empty in all that we have seen, and left out."""
    if not isinstance(states, dict):
        odd = [x for x in states if x and x != [{}]] if isinstance(states, list) else []
        ask.repairs["signal states of an unknown layout, dropped"] += len(odd)
        return no_signals()
    told: list[tuple[int, str, int, tuple[float, ...]]] = []
    for light, held in states.items():
        told += _light(light, ask.dictionary(held, "a traffic light"), times, ask)
        ask.refuse_if(len(told) > MOST_SIGNALS, f"it has more than {MOST_SIGNALS} states of traffic lights; so many are not read")
    return Signals(
        time=np.array([t[0] for t in told], int),
        lane=tuple(t[1] for t in told),
        state=np.array([t[2] for t in told], int),
        stop=np.array([t[3] for t in told], float).reshape(-1, 3),
    )


def _light(light: Any, held: dict[Any, Any], times: int, ask: Plain) -> list[tuple[int, str, int, tuple[float, ...]]]:
    """Time, lane, state and stop point of one light; files fill up with lane 0."""
    state = ask.dictionary(held.get("state"), "a traffic light's state")
    seen = ask.items(state.get("object_state"), "a traffic light's states")
    changing = ask.names(state["lane"], "a traffic light's lanes") if "lane" in state else None
    lanes = (name(held.get("lane", light)) or name(light),) * len(seen) if changing is None else changing
    ask.repairs["signal states without a time or a lane, dropped"] += len(seen) - min(len(seen), len(lanes), times)
    stops = state.get("stop_point", held.get("stop_point"))
    many = isinstance(stops, pickled.Array) and stops.value.ndim == 2
    places = ask.rows(stops, 3, STOP) if many else np.tile(_one(stops, STOP, ask), (min(len(seen), times), 1))
    told = []
    for time, (x, lane) in enumerate(zip(seen[:times], lanes, strict=False)):
        index = _state(x)
        ask.repairs["signal states of an unknown kind, dropped"] += index is None and x is not None
        if index is not None and not (changing is not None and lane == "0"):
            told.append((time, lane, index, tuple(places[time]) if time < len(places) else (float("nan"),) * 3))
    return told


def _one(place: Any, what: str, ask: Plain) -> np.ndarray:
    """A point; NaN where it is none."""
    told = ask.flat(place, what) if isinstance(place, pickled.Array | list | tuple) else np.zeros(0)
    return told if len(told) == 3 else np.full(3, np.nan)


def _state(x: Any) -> int | None:
    """Index of a signal state: text such as LANE_STATE_GO, or the number of the proto; None: none is told."""
    if isinstance(x, str):
        told = text(x).removeprefix("LANE_STATE_").lower()
        return SIGNAL_STATES.index(told) if told in SIGNAL_STATES else None
    index = whole(x, -1)
    return index if 0 <= index < len(SIGNAL_STATES) else None
