"""Malicious recordings: pickles that run code, and files of every format that grow without end or are not what they claim.

Each is fine but for the one thing, so that the readers get to it.
"""

import _codecs
import json
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
from numpy._core import multiarray

from tests.recorded import example, features, gpudrive, scenario, scenarionet, tfrecord


class Bomb:
    """What a malicious pickle asks to be called, and with which state."""

    def __init__(self, function: Any, *arguments: Any, state: Any = None) -> None:
        self.called = (function, arguments) if state is None else (function, arguments, state)

    def __reduce__(self) -> Any:
        return self.called


def executed(flag: Path) -> dict[str, bytes]:
    """Pickles that call something; `flag` exists afterwards if one of them ran."""
    return {
        "system": pickle.dumps(Bomb(os.system, f"touch {flag}")),
        "eval": pickle.dumps({"tracks": Bomb(eval, f"open({str(flag)!r}, 'w')")}),
        "exec in protocol 0": pickle.dumps(Bomb(exec, f"open({str(flag)!r}, 'w')"), protocol=0),
        "in a scene": pickle.dumps(scenarionet() | {"version": Bomb(os.system, f"touch {flag}")}),
        "instance": b"\x80\x02" + f"(S'touch {flag}'\nios\nsystem\n.".encode(),
        "object": b"\x80\x04\x95\x00\x00\x00\x00\x00\x00\x00\x00(cos\nsystem\n" + f"V{flag}\no.".encode(),
        "new object": b"\x80\x04cos\nsystem\nVtouch\n\x85\x81.",
        "attribute of a name": b"\x80\x04\x8c\x05numpy\x8c\x0bndarray.ctx\x93)R.",
        "getattr": pickle.dumps(Bomb(getattr, np.ndarray, "tofile")),
        "numpy load": pickle.dumps(Bomb(np.load, str(flag))),
        "huge array": pickle.dumps(Bomb(np.zeros, (10**12,))),
        "extension": b"\x80\x04\x82\x01.",
        "persistent": b"\x80\x04Nq\x00Q.",
    }


def nested(depth: int = 30) -> Any:
    """A tuple that holds one tuple ten times, which holds another ten times, and so on: twenty bytes in a pickle for each tenfold."""
    out: Any = ("x",)
    for _ in range(depth):
        out = (out,) * 10
    return out


def bombs() -> dict[str, bytes]:
    """Pickles that are small or damaged, and endless or impossible for who carries them out without care."""
    array = np.zeros(4)
    text, numbers = "x" * 500_000, list(range(100_000))
    collide = [(k * (2**61 - 1)).to_bytes(12, "little") for k in range(1, 150_000)]
    long = pickle.dumps(nested(), protocol=3)[2:-1]
    array_of = (multiarray._reconstruct, np.ndarray, (0,), b"b")
    wide = (np.dtype("U9999"), bytes(4 * 9999))
    return {
        "array that claims more than it has": pickle.dumps(array).replace(b"K\x04\x85", b"J\xff\xff\xff\x7f\x85"),
        "a name with an escape that is none": b"\x80\x04cnu\\Bmpy\nndarray\n.",
        "huge bytes": b"\x80\x04\x8e" + b"\xff" * 7 + b"\x00" + b"x.",
        "huge text": b"\x80\x04\x8d" + b"\xff" * 6 + b"\x00\x00x.",
        "huge memo": b"\x80\x04Nr\xff\xff\xff\x7f.",
        "huge number": b"\x80\x02\x8b\xff\xff\xff\x7f\x01.",
        "million lists": b"".join((b"\x80\x04", b"]" * 1_100_000, b".")),
        "deep tuple as a key": b"".join((b"\x80\x04}", b")" + b"\x85" * 200_000, b"Ns.")),
        "deep tuple": b"\x80\x04)" + b"\x85" * 200_000 + b".",
        "itself": b"\x80\x04}q\x00\x8c\x06tracksh\x00s\x8c\x0cmap_featuresh\x00s.",
        "nested tuples as a dtype": pickle.dumps(Bomb(np.dtype, nested())),
        "nested tuples as an encoding": pickle.dumps(Bomb(_codecs.encode, "x", nested())),
        "nested tuples as a shape": pickle.dumps(Bomb(*array_of, state=(1, nested(), np.dtype("f8"), False, b""))),
        "nested tuples as a module": b"\x80\x03" + long + b"\x8c\x01x\x93.",
        "nested tuples as a name": b"\x80\x03\x8c\x01x" + long + b"\x93.",
        "one text encoded over and over": pickle.dumps([Bomb(_codecs.encode, text, "latin1") for _ in range(20_000)]),
        "one list copied over and over": pickle.dumps([Bomb(set, numbers) for _ in range(50_000)]),
        "one list as many arrays": pickle.dumps(
            [Bomb(*array_of, state=(1, (10**5,), np.dtype("O"), False, numbers)) for _ in range(50_000)]
        ),
        "one text as many numbers": pickle.dumps([Bomb(multiarray.scalar, *wide) for _ in range(50_000)]),
        "keys that collide": b"\x80\x04}(" + b"".join(b"\x8a\x0c" + k + b"N" for k in collide) + b"u.",
        "memos that collide": b"\x80\x04N" + b"".join(b"p%d\n" % int.from_bytes(k, "little") for k in collide) + b".",
    }


def web() -> dict[str, Any]:
    """Half of the lanes have no length, and all of these lead to all others: whoever follows them for each lane walks for long."""
    lane = scenarionet()["map_features"]["1"]
    ways = {f"way{i}": lane | {"entry_lanes": [], "exit_lanes": ["hub0"]} for i in range(4000)}
    hubs = {}
    for i in range(24):
        ahead = [f"hub{i + 1}", *list(ways)[:1900]]
        hubs[f"hub{i}"] = lane | {"polyline": np.zeros((1, 3)), "entry_lanes": [], "exit_lanes": ahead}
    return ways | hubs


def pickles() -> dict[str, bytes]:
    """Pickles of scenes in which one value stands in many places, or one is odd."""
    line, row, ids = np.zeros((20_000, 3)), [1.0] * 4000, [str(i) for i in range(20_000)]
    light = scenarionet()["dynamic_map_states"]["2"]
    track = scenarionet()["tracks"]["11"]
    state = track["state"]
    lane = scenarionet()["map_features"]["1"]
    go = np.array(["LANE_STATE_GO"] * 91)

    def scene(**changes: Any) -> bytes:
        return pickle.dumps(scenarionet() | changes, protocol=4)

    def tracks(count: int, **changes: Any) -> bytes:
        return scene(tracks={str(i): track | {"state": state | changes} for i in range(count)})

    def features_of(count: int, **changes: Any) -> bytes:
        one = lane | changes
        return scene(map_features={str(i): one for i in range(count)})

    def lights(count: int, states: Any = light["state"], **changes: Any) -> bytes:
        one = light | {"state": states} | changes
        return scene(dynamic_map_states={str(i): one for i in range(count)})

    wanted = scenarionet()["metadata"] | {"tracks_to_predict": [str(i) for i in range(300_000)]}
    return {
        "characters that do not exist": lights(1, {"object_state": go}).replace(go.tobytes(), b"\x00\x00\x00\xff" + go.tobytes()[4:]),
        "nested tuples as a type": scene(tracks={"11": track | {"type": nested()}}),
        "nested tuples as a position": tracks(1, position=nested()),
        "nested tuples as links": features_of(3, exit_lanes=nested()),
        "one list of links of many lanes": features_of(400, exit_lanes=ids),
        "one list of neighbours of many lanes": features_of(400, left_neighbor=ids),
        "links that lead nowhere": features_of(1, exit_lanes=ids, entry_lanes=["0"] * 20_000),
        "links across": scene(map_features=web()),
        "one line of many lanes": features_of(50_000, polyline=line),
        "one lane many times": features_of(120_000),
        "one position of many tracks": tracks(5_000, position=np.zeros((50_000, 3))),
        "one track many times": tracks(150_000),
        "one row many times": features_of(3, polyline=[row] * 4000),
        "one light many times": lights(100_000),
        "one list of states of many lights": lights(5_000, {"object_state": ["LANE_STATE_GO"] * 10_000}),
        "one list of lanes of many lights": lights(5_000, {"object_state": ["LANE_STATE_GO"] * 91, "lane": ids}),
        "one stop point of many lights": lights(5_000, {"object_state": ["LANE_STATE_GO"] * 91}, stop_point=np.zeros((100_000, 3))),
        "one long text as many types": scene(map_features={str(i): one for one in [{"type": "x" * 30_000_000}] for i in range(50_000)}),
        "more tracks to predict than tracks": scene(tracks={str(i): track for i in range(9_000)}, metadata=wanted),
        "an array without columns": tracks(3, position=np.zeros((2**31, 0))),
        "a heading of two columns": tracks(3, heading=np.zeros((91, 2))),
        "a signalling NaN": tracks(3, heading=np.frombuffer(bytes.fromhex("0100a07f") * 91, "<f4")),
        "least numbers": tracks(3, valid=[np.int64(-(2**63))] * 91),
        "lines in an id": scene(metadata=scenarionet()["metadata"] | {"scenario_id": "a\nb\ud800", "ts": np.zeros(91)}),
    }  # fmt: skip


def texts() -> dict[str, bytes]:
    """JSON that is odd in one place, or large in none."""
    held = gpudrive()
    deep: Any = []
    for _ in range(900):
        deep = [deep]
    odd = {
        "no position": {"position": {}}, "one position": {"position": {"x": 1, "y": 2}}, "deep type": {"type": deep},
        "huge number": {"heading": [10**400] * 91}, "NaN as a size": {"width": float("nan")}, "no heading": {"heading": None},
    }  # fmt: skip
    out = {name: json.dumps(held | {"objects": [held["objects"][0] | change, *held["objects"][1:]]}) for name, change in odd.items()}
    lights = {"2": {"state": ["go"] * 91, "time_index": [0] * 91}}
    out |= {
        "many empty roads": json.dumps(held)[:-1] + ', "roads": [' + "{}," * 5_000_000 + "{}]}",
        "many small roads": json.dumps(held)[:-1] + ', "roads": [' + '{"a":1},' * 900_000 + "{}]}",
        "many empty objects": json.dumps(held | {"objects": [{}] * 200_000}),
        "many lights": json.dumps(held | {"tl_states": {str(i): lights["2"] for i in range(8_000)}}),
        "deep lists": '{"objects": ' + "[" * 1_000_000,
        "one road many times": json.dumps(held | {"roads": [held["roads"][0] | {"geometry": []}] * 150_000}),
        "one to predict many times": json.dumps(held | {"metadata": {"tracks_to_predict": [0] * 300_000}}),
        "one to predict that is none": json.dumps(held | {"metadata": {"tracks_to_predict": [10**30]}}),
    }
    return {name: text.encode() for name, text in out.items()}


def records() -> dict[str, bytes]:
    """TFRecords of messages that claim much in few bytes."""
    held = scenario().SerializeToString()
    many = {"tracks": b"\x12\x00", "features": b"\x42\x00", "times": b"\x3a\x00", "to predict": b"\x5a\x00", "of interest": b"\x20\x01"}
    out = {f"many {what}": held + empty * 1_000_000 for what, empty in many.items()}
    wide = features() | {"traffic_light_state/current/state": np.ones(10**6, int)}
    one = b"\x0a\x02\x12\x00" + b"\x0a\x04\x0a\x00\x12\x00" * 10
    out |= {"lights of no light": example(wide), "empty features": example(features()) + one * 30_000}
    out |= {"lines in an id": held + b"\x2a\x03a\nb"}
    return {name: tfrecord(payload) for name, payload in out.items()}
