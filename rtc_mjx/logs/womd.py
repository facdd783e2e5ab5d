"""Scenario protos of the Waymo Open Motion Dataset: maps with connectivity, signals, tracks_to_predict."""

from collections import Counter
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError

from rtc_mjx.errors import UsageError
from rtc_mjx.logs import messages
from rtc_mjx.logs.plain import text
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
    refuse_if,
)

MOST_ID = 1000  # bytes of a scenario's id that are looked at; real ones have 16
LANE_KINDS: tuple[LaneKind, ...] = ("unknown", "freeway", "surface_street", "bike_lane")


def read(payload: bytes, source: str) -> Recording:
    """The recording in a record's payload.

    Args:
        payload: a serialised Scenario.
        source: file and record, for messages.

    Raises:
        UsageError: it is not a Scenario, or does not hold together.
    """
    scenario = parsed(messages.Scenario, payload, source)
    times = np.array(scenario.timestamps_seconds, float)
    sdc, repairs = int(scenario.sdc_track_index), Counter[str]()
    tracks = _tracks(scenario.tracks, len(times), source, repairs)
    known = range(len(tracks.ids))
    wanted = tuple(dict.fromkeys(int(p.track_index) for p in scenario.tracks_to_predict))
    unknown = [i for i in wanted if i not in known]
    refuse_if(bool(unknown), source, f"tracks_to_predict names tracks {unknown[:5]}; there are {len(known)}")
    named = scenario.HasField("sdc_track_index")
    refuse_if(named and sdc not in known, source, f"sdc_track_index is {sdc}; there are {len(known)} tracks")
    return Recording(
        scenario=text(scenario.scenario_id[:MOST_ID].decode("utf-8", "replace")),
        source=source,
        kind="womd_scenario",
        times=times,
        now=current(int(scenario.current_time_index), len(times), repairs),
        tracks=tracks,
        map=read_map(scenario.map_features, source, repairs),
        signals=_signals(scenario.dynamic_map_states, len(times), source, repairs),
        sdc=sdc if named else -1,
        to_predict=wanted,
        of_interest=tuple(str(i) for i in scenario.objects_of_interest),
        repairs={what: count for what, count in repairs.items() if count},
    )


def parsed(message: Any, payload: bytes, source: str) -> Any:
    """A message of a class.

    Raises:
        UsageError: the bytes are none.
    """
    try:
        return message.FromString(payload)
    except DecodeError as error:
        raise UsageError(f"{source}: it is no {message.DESCRIPTOR.name} message: {str(error).splitlines()[0]}") from error


def _tracks(logged: Any, times: int, source: str, repairs: Counter[str]) -> Tracks:
    refuse_if(len(logged) > MOST_TRACKS, source, f"it claims {len(logged)} tracks; more than {MOST_TRACKS} are not read")
    out = empty_tracks(tuple(str(t.id) for t in logged), times, source)
    again = [known for known, count in Counter(out.ids).items() if count > 1]
    refuse_if(bool(again), source, f"it has several tracks with the ids {again[:5]}; each road user has one of its own")
    for i, track in enumerate(logged):
        states = [
            (s.center_x, s.center_y, s.center_z, s.heading, s.velocity_x, s.velocity_y, s.length, s.width, s.height, s.valid)
            for s in track.states[:times]
        ]
        repairs["tracks with another number of states than times"] += len(track.states) != times
        out.kinds[i] = track.object_type if 0 <= track.object_type <= OTHER else 0
        numbers, there = np.array(states, float).reshape(-1, 10), slice(0, len(states))
        out.pose[i, there], out.velocity[i, there] = numbers[:, :4], numbers[:, 4:6]
        out.size[i, there], out.valid[i, there] = numbers[:, 6:9], numbers[:, 9] > 0
    return out


def read_map(features: Any, source: str, repairs: Counter[str]) -> Map:
    """The map of a Scenario's features."""
    held: dict[str, list[Any]] = {name: [] for name in ("road_edge", "road_line", "crosswalk", "speed_bump", "driveway")}
    lanes, signs, points, links = [], [], 0, 0
    refuse_if(len(features) > MOST_FEATURES, source, f"its map has {len(features)} features; more than {MOST_FEATURES} are not read")
    for feature in features:
        points, links = points + _points_of(feature), links + _links_of(feature)
        refuse_if(points > MOST_POINTS, source, f"its map has more than {MOST_POINTS} points")
        refuse_if(links > MOST_LINKS, source, f"its map has more than {MOST_LINKS} links between lanes")
        if feature.HasField("lane"):
            lanes.append(_lane(str(feature.id), feature.lane))
        elif feature.HasField("stop_sign"):
            sign = feature.stop_sign
            signs.append(StopSign(str(feature.id), _points([sign.position])[0], tuple(str(i) for i in sign.lane)))
        else:
            name = next((n for n in held if feature.HasField(n)), None)
            if name is None:
                repairs["map features of an unknown kind"] += 1
                continue
            shape = getattr(feature, name)
            held[name].append(Feature(str(feature.id), _points(shape.polyline if name.startswith("road") else shape.polygon)))
    return Map(
        lanes=tuple(lanes), connected=True, road_edges=tuple(held["road_edge"]), road_lines=tuple(held["road_line"]),
        crosswalks=tuple(held["crosswalk"]), speed_bumps=tuple(held["speed_bump"]), driveways=tuple(held["driveway"]),
        stop_signs=tuple(signs),
    )  # fmt: skip


def _points_of(feature: Any) -> int:
    """How many points a map feature has, before they are taken out of the message."""
    lines = (feature.lane.polyline, feature.road_line.polyline, feature.road_edge.polyline)
    areas = (feature.crosswalk.polygon, feature.speed_bump.polygon, feature.driveway.polygon)
    return sum(map(len, (*lines, *areas)))


def _links_of(feature: Any) -> int:
    lane = feature.lane
    return sum(map(len, (lane.entry_lanes, lane.exit_lanes, lane.left_neighbors, lane.right_neighbors, feature.stop_sign.lane)))


def _lane(name: str, lane: Any) -> Lane:
    kind: LaneKind = LANE_KINDS[lane.type] if 0 <= lane.type < len(LANE_KINDS) else "unknown"
    limit = MPH * lane.speed_limit_mph if lane.HasField("speed_limit_mph") else float("nan")
    entries, exits = (tuple(str(i) for i in ids) for ids in (lane.entry_lanes, lane.exit_lanes))
    left, right = (tuple(str(n.feature_id) for n in beside) for beside in (lane.left_neighbors, lane.right_neighbors))
    return Lane(name, _points(lane.polyline), kind, limit, entries, exits, left, right)


def _points(points: Any) -> np.ndarray:
    return np.array([(p.x, p.y, p.z) for p in points], float).reshape(-1, 3)


def _signals(states: Any, times: int, source: str, repairs: Counter[str]) -> Signals:
    count = sum(len(at.lane_states) for at in states)
    refuse_if(count > MOST_SIGNALS, source, f"it claims {count} states of traffic lights; more than {MOST_SIGNALS} are not read")
    told = [(i, s) for i, at in enumerate(states) for s in at.lane_states]
    kept = [(i, s) for i, s in told if i < times and 0 <= s.state < len(SIGNAL_STATES)]
    repairs["signal states of an unknown kind or time, dropped"] += len(told) - len(kept)
    nowhere = (float("nan"),) * 3
    stops = [(p.x, p.y, p.z) if s.HasField("stop_point") else nowhere for _, s in kept for p in [s.stop_point]]
    return Signals(
        time=np.array([i for i, _ in kept], int),
        lane=tuple(str(s.lane) for _, s in kept),
        state=np.array([s.state for _, s in kept], int),
        stop=np.array(stops, float).reshape(-1, 3),
    )
