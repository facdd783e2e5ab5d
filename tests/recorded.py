"""Recordings made for tests, in every format: a car, a car behind it, someone on foot; a lane that branches, a bike lane, a light."""

import io
import json
import math
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np

from rtc_mjx.logs import messages
from rtc_mjx.logs.tfrecord import masked

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
STEPS = 91
ORIGIN = (8000.0, -3000.0, 20.0)
LANES = {  # id -> (points, type, exits); the second lane goes straight on, the third to the left
    1: ([(0, 0), (60, 0)], 2, [2, 3]),
    2: ([(60, 0), (160, 0)], 2, []),
    3: ([(60, 0), (75, 3), (80, 18), (80, 60)], 2, []),
    4: ([(0, -4), (160, -4)], 3, []),
}
TRACKS = [  # id, kind, x at t = 0, y, speed along x, length, width
    (11, 1, 5.0, 0.0, 10.0, 4.8, 2.0),
    (12, 1, -10.0, 0.2, 9.0, 4.5, 1.9),
    (13, 2, 40.0, 6.0, 1.0, 0.6, 0.6),
]
SIGNAL = [4] * 40 + [5] * 10 + [6] * 41  # stop, caution, go
CROSSWALK = [(50, -6), (53, -6), (53, 6), (50, 6)]
EDGES = {21: [(0, -7), (160, -7)], 22: [(80, 4), (0, 4)]}


def place(x: float, y: float, z: float = 0.0) -> dict[str, float]:
    return {"x": ORIGIN[0] + x, "y": ORIGIN[1] + y, "z": ORIGIN[2] + z}


def dense(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """About every metre, as recordings have it."""
    out = [points[0]]
    for (a, b), (c, d) in zip(points[:-1], points[1:], strict=True):
        count = max(1, round(math.hypot(c - a, d - b)))
        out += [(a + (c - a) * i / count, b + (d - b) * i / count) for i in range(1, count + 1)]
    return out


def states(track: tuple[Any, ...]) -> list[dict[str, float]]:
    _, _, x, y, speed, length, width = track
    return [
        {**{f"center_{k}": v for k, v in place(x + speed * i / 10, y, 0.8).items()}, "length": length, "width": width, "height": 1.6,
         "heading": 0.0, "velocity_x": speed, "velocity_y": 0.0, "valid": True}
        for i in range(STEPS)
    ]  # fmt: skip


def scenario(name: str = "made") -> Any:
    """A Scenario message."""
    out = messages.Scenario(scenario_id=name.encode(), sdc_track_index=0, current_time_index=10)
    out.timestamps_seconds.extend(i / 10 for i in range(STEPS))
    for track in TRACKS:
        held = out.tracks.add(id=track[0], object_type=track[1])
        for state in states(track):
            held.states.add(**state)
    for known, (points, kind, exits) in LANES.items():
        feature = out.map_features.add(id=known)
        feature.lane.type, feature.lane.speed_limit_mph = kind, 25.0
        feature.lane.exit_lanes.extend(exits)
        feature.lane.entry_lanes.extend(i for i, (_, _, after) in LANES.items() if known in after)
        for x, y in dense(points):
            feature.lane.polyline.add(**place(x, y))
    for known, points in EDGES.items():
        feature = out.map_features.add(id=known)
        for x, y in dense(points):
            feature.road_edge.polyline.add(**place(x, y))
    area = out.map_features.add(id=31).crosswalk
    for x, y in CROSSWALK:
        area.polygon.add(**place(x, y))
    sign = out.map_features.add(id=41).stop_sign
    sign.lane.append(3)
    sign.position.CopyFrom(type(sign.position)(**place(62, 3)))
    for state in SIGNAL:
        light = out.dynamic_map_states.add().lane_states.add(lane=2, state=state)
        light.stop_point.CopyFrom(type(light.stop_point)(**place(60, 0)))
    out.tracks_to_predict.add(track_index=1)
    out.objects_of_interest.extend([11, 12])
    return out


def tfrecord(*payloads: bytes) -> bytes:
    out = io.BytesIO()
    for payload in payloads:
        head = struct.pack("<Q", len(payload))
        out.write(head + struct.pack("<I", masked(head)) + payload + struct.pack("<I", masked(payload)))
    return out.getvalue()


def features() -> dict[str, np.ndarray]:
    """The features of a tf.Example, with 4 slots for tracks of which 3 are used."""
    out: dict[str, np.ndarray] = {"state/id": np.array([11, 12, 13, -1], np.float32), "state/type": np.array([1, 1, 2, -1], np.float32)}
    out |= {"state/is_sdc": np.array([1, 0, 0, 0]), "state/tracks_to_predict": np.array([0, 1, 0, -1])}
    out |= {"state/objects_of_interest": np.array([1, 1, 0, 0])}
    names = {"x": "center_x", "y": "center_y", "z": "center_z", "bbox_yaw": "heading"}
    names |= {n: n for n in ("length", "width", "height", "velocity_x", "velocity_y", "valid")}
    for part, span in (("past", slice(0, 10)), ("current", slice(10, 11)), ("future", slice(11, STEPS))):
        for name, source in names.items():
            rows = np.array([[s[source] for s in states(t)] for t in TRACKS] + [[-1.0] * STEPS])[:, span]
            out[f"state/{part}/{name}"] = rows.astype(np.int64 if name == "valid" else np.float32)
        stamps = np.tile(np.arange(STEPS)[span] * 100_000, (4, 1))
        out[f"state/{part}/timestamp_micros"] = stamps
        lights = np.stack([np.array(SIGNAL)[span], np.full(STEPS, -1)[span]], axis=1)
        out |= {f"traffic_light_state/{part}/state": lights, f"traffic_light_state/{part}/id": np.where(lights < 0, -1, 2)}
        out[f"traffic_light_state/{part}/valid"] = (lights >= 0).astype(np.int64)
        for axis, value in place(60, 0).items():
            out[f"traffic_light_state/{part}/{axis}"] = np.full(lights.shape, value, np.float32)
    lines = [(i, {2: 2, 3: 3}[kind], points) for i, (points, kind, _) in LANES.items()]
    lines += [(i, 15, points) for i, points in EDGES.items()] + [(31, 18, CROSSWALK), (41, 17, [(62.0, 3.0)])]
    samples = [(i, kind, place(x, y)) for i, kind, points in lines for x, y in (dense(points) if kind < 17 else points)]
    out["roadgraph_samples/id"] = np.array([s[0] for s in samples] + [-1] * 5)
    out["roadgraph_samples/type"] = np.array([s[1] for s in samples] + [-1] * 5)
    out["roadgraph_samples/valid"] = np.array([1] * len(samples) + [0] * 5)
    out["roadgraph_samples/xyz"] = np.array([list(s[2].values()) for s in samples] + [[-1.0] * 3] * 5, np.float32)
    return out


def example(held: dict[str, np.ndarray], name: str = "made") -> bytes:
    out = messages.Example()
    out.features.feature.add(key=b"scenario/id").value.bytes_list.value.append(name.encode())
    for key, numbers in held.items():
        value = out.features.feature.add(key=key.encode()).value
        if numbers.dtype.kind == "f":
            value.float_list.value.extend(float(x) for x in numbers.ravel())
        else:
            value.int64_list.value.extend(int(x) for x in numbers.ravel())
    return out.SerializeToString()


def gpudrive(degrees: bool = False, old: bool = False) -> dict[str, Any]:
    """GPUDrive JSON; old files lack heights, ids, lane types, scenario id and metadata."""

    def point(x: float, y: float, z: float = 0.0) -> dict[str, float]:
        return {k: v for k, v in place(x, y, z).items() if not (old and k == "z")}

    turn = 370.0 if degrees else 0.01
    objects = []
    for known, kind, x, y, speed, length, width in TRACKS:
        held = {
            "position": [point(x + speed * i / 10, y, 0.8) for i in range(STEPS)], "heading": [turn] * STEPS, "valid": [True] * STEPS,
            "velocity": [{"x": speed, "y": 0.0}] * STEPS, "width": width, "length": length, "type": ["", "vehicle", "pedestrian"][kind],
            "goalPosition": point(x, y),
        }  # fmt: skip
        objects.append(held if old else held | {"id": known, "height": 1.6, "mark_as_expert": False})
    roads = [
        {"type": "lane", "geometry": [point(*p) for p in dense(line)], "map_element_id": kind, "id": i}
        for i, (line, kind, _) in LANES.items()
    ]
    roads += [
        {"type": "road_edge", "geometry": [point(*p) for p in dense(line)], "map_element_id": 15, "id": i} for i, line in EDGES.items()
    ]
    roads += [{"type": "crosswalk", "geometry": [point(*p) for p in CROSSWALK], "map_element_id": 18, "id": 31}]
    roads += [{"type": "stop_sign", "geometry": [point(62, 3)], "map_element_id": 17, "id": 41}]
    if old:
        roads = [{k: v for k, v in r.items() if k in ("type", "geometry")} for r in roads]
        return {"name": "made.json", "objects": objects, "roads": roads, "tl_states": {}}
    names = {4: "stop", 5: "caution", 6: "go"}
    light = {"state": [names[s] for s in SIGNAL], "time_index": list(range(STEPS)), **{k: [v] * STEPS for k, v in place(60, 0).items()}}
    return {
        "name": "made.json", "scenario_id": "made", "objects": objects, "roads": roads, "tl_states": {"2": light},
        "metadata": {"sdc_track_index": 0, "tracks_to_predict": [{"track_index": 1, "difficulty": 1}], "objects_of_interest": [11, 12]},
    }  # fmt: skip


def scenarionet(dataset: str = "waymo") -> dict[str, Any]:
    """A ScenarioNet dictionary; lanes of nuScenes have a heading in place of a height, and no connectivity."""
    waymo = dataset == "waymo"
    tracks = {}
    for known, kind, x, y, speed, length, width in TRACKS:
        along = x + speed * np.arange(STEPS) / 10
        position = np.stack([ORIGIN[0] + along, np.full(STEPS, ORIGIN[1] + y), np.full(STEPS, ORIGIN[2] + 0.8)], axis=1)
        sides = {"length": length, "width": width, "height": 1.6}
        state = {
            "position": position,
            "heading": np.zeros(STEPS),
            "velocity": np.tile([speed, 0.0], (STEPS, 1)),
            "valid": np.ones(STEPS, bool),
        }
        tracks[str(known)] = {
            "type": ["", "VEHICLE", "PEDESTRIAN"][kind], "metadata": {"track_length": STEPS},
            "state": state | {side: np.full((STEPS, 1), value) for side, value in sides.items()},
        }  # fmt: skip
    features: dict[str, Any] = {}
    for known, (points, kind, exits) in LANES.items():
        line = np.array([(ORIGIN[0] + x, ORIGIN[1] + y, ORIGIN[2] if waymo else 0.7) for x, y in dense(points)])
        features[str(known)] = {"type": {2: "LANE_SURFACE_STREET", 3: "LANE_BIKE_LANE"}[kind], "polyline": line}
        if waymo:
            entries = [str(i) for i, (_, _, after) in LANES.items() if known in after]
            features[str(known)] |= {"entry_lanes": entries, "exit_lanes": [str(i) for i in exits], "speed_limit_mph": 25.0}
    if waymo:
        features |= {
            str(i): {"type": "ROAD_EDGE_BOUNDARY", "polyline": np.array([list(place(*p).values()) for p in dense(line)])}
            for i, line in EDGES.items()
        }
        features["31"] = {"type": "CROSSWALK", "polygon": np.array([list(place(*p).values()) for p in CROSSWALK])}
        features["41"] = {"type": "STOP_SIGN", "lane": ["3"], "position": np.array(list(place(62, 3).values()))}
    names = {4: "LANE_STATE_STOP", 5: "LANE_STATE_CAUTION", 6: "LANE_STATE_GO"}
    light = {
        "type": "TRAFFIC_LIGHT",
        "state": {"object_state": [names[s] for s in SIGNAL]},
        "lane": "2",
        "stop_point": np.array(list(place(60, 0).values())),
    }
    metadata = {"dataset": dataset, "ts": np.arange(STEPS) / 10, "sdc_id": "11", "scenario_id": "made", "current_time_index": 10}
    metadata |= {"tracks_to_predict": {"12": {"track_index": 1, "track_id": "12"}}, "objects_of_interest": ["11", "12"]}
    lights = {"2": light} if waymo else {}
    return {
        "id": "made",
        "version": "v1.2",
        "length": STEPS,
        "tracks": tracks,
        "map_features": features,
        "dynamic_map_states": lights,
        "metadata": metadata,
    }


def written(kind: str) -> bytes:
    """A whole file of a kind."""
    if kind == "womd_scenario":
        return tfrecord(scenario().SerializeToString())
    if kind == "womd_tf_example":
        return tfrecord(example(features()))
    return json.dumps(gpudrive()).encode() if kind == "gpudrive_json" else pickle.dumps(scenarionet(), protocol=4)
