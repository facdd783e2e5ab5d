"""Recordings: every format gives the same scene; what is damaged or malicious gives one line and nothing else."""

import dataclasses
import json
import pickle
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from rtc_mjx.errors import UsageError
from rtc_mjx.logs import AMBER, GREEN, NO_SIGNAL, RED, pickled, read, store
from rtc_mjx.logs.convert import Options, convert
from rtc_mjx.logs.levels import level_of, sampled
from rtc_mjx.logs.recording import Recording
from rtc_mjx.logs.road import cleaned, four_corners, prepare, simplified
from tests import fuzz_logs, malicious, recorded

KINDS = read.KINDS
SMALL = Options(lanes=6, points=8, road_users=4, edges=8, crosswalks=2)
ROOT = Path(__file__).resolve().parents[1]
shared = pytest.mark.skipif(not recorded.SHARED.is_dir(), reason="the recordings of ../shared/data are not there")


def file_of(kind: str, folder: Path) -> Path:
    file = folder / "file"  # no ending: the content tells
    file.write_bytes(recorded.written(kind))
    return file


def made(kind: str, folder: Path) -> Recording:
    return next(read.recordings(file_of(kind, folder)))


def from_bytes(data: bytes, folder: Path) -> Recording:
    (folder / "file").write_bytes(data)
    return next(read.recordings(folder / "file"))


# What is read


@pytest.mark.parametrize("kind", KINDS)
def test_a_recording_is_what_its_file_says(kind, tmp_path):
    recording = made(kind, tmp_path)
    held, road = recording.tracks, recording.map
    assert (recording.kind, recording.scenario, recording.sdc, recording.to_predict) == (kind, "made", 0, (1,))
    assert held.ids == ("11", "12", "13") and held.kinds.tolist() == [1, 1, 2] and recording.of_interest == ("11", "12")
    assert np.allclose(recording.times, np.arange(91) / 10, atol=1e-6) and recording.now == 10
    assert np.allclose(held.pose[0, 30], [8035.0, -3000.0, 20.8, held.pose[0, 30, 3]], atol=1e-3) and held.valid.all()
    assert np.allclose(held.velocity[1], [9.0, 0.0]) and np.allclose(held.size[0], [4.8, 2.0, 1.6])
    assert [lane.kind for lane in road.lanes] == ["surface_street"] * 3 + ["bike_lane"]
    assert tuple(map(len, (road.road_edges, road.crosswalks, road.stop_signs))) == (2, 1, 1)
    assert recording.signals.lane == ("2",) * 91 and recording.signals.state.tolist() == recorded.SIGNAL
    assert road.connected == (kind in ("womd_scenario", "scenarionet"))


def test_every_format_gives_the_same_scene(tmp_path):
    scenes = {kind: convert(made(kind, tmp_path), SMALL).scenes[0] for kind in KINDS}
    assert {kind: s.connectivity for kind, s in scenes.items()} == {
        "womd_scenario": "logged", "womd_tf_example": "derived", "gpudrive_json": "derived", "scenarionet": "logged",
    }  # fmt: skip
    first = scenes["womd_scenario"].scene
    for kind, other in scenes.items():
        for name in ("lanes", "successors", "edges", "edge_valid", "crosswalks"):
            assert np.allclose(getattr(first.road, name), getattr(other.scene.road, name), atol=2e-3), (kind, name)
        for name in ("signals", "pose", "velocity", "size", "kind", "valid", "controlled"):
            assert np.allclose(getattr(first, name), getattr(other.scene, name), atol=0.011), (kind, name)


def test_a_scene_says_where_signals_successors_and_rights_of_way_are(tmp_path):
    scene = convert(made("womd_scenario", tmp_path), SMALL).scenes[0].scene
    road = scene.road
    assert road.successors[:3].tolist() == [[1, 2, -1, -1], [-1] * 4, [-1] * 4]
    assert road.gives_way[:3].tolist() == [0, 0, 2]
    assert [scene.signals[t, 1] for t in (0, 39, 40, 49, 50, 90)] == [RED, RED, AMBER, AMBER, GREEN, GREEN]
    assert not scene.signals[:, [0, 2, 3, 4, 5]].any()
    assert np.allclose(road.lanes[1, 0], [55.0, 0.0]) and np.allclose(scene.pose[0, 0], 0.0)  # metres from the agent's start
    a, b, c, _ = road.crosswalks[0]
    assert np.linalg.norm(b - a) == pytest.approx(12.0) and np.linalg.norm(c - b) == pytest.approx(3.0)


def test_field_order_and_packing_do_not_matter(tmp_path):
    """The wire format leaves both free; here every message has its fields in reverse, and numbers unpacked or packed."""

    def reversed_fields(message: object, packed: bool) -> bytes:
        out = b""
        for field, value in reversed(message.ListFields()):  # type: ignore[attr-defined]  # a message
            values = list(value) if field.is_repeated else [value]
            if field.message_type is not None:
                out += b"".join(tag(field.number, 2) + sized(reversed_fields(v, packed)) for v in values)
                continue
            single = [(len_free(type(message)(), field, v)) for v in values]
            if field.is_repeated and packed and not isinstance(values[0], bytes):
                out += tag(field.number, 2) + sized(b"".join(s[1] for s in single))
            else:
                out += b"".join(s[0] + s[1] for s in single)
        return out

    def tag(number: int, kind: int) -> bytes:
        return bytes([number << 3 | kind])

    def sized(data: bytes) -> bytes:
        size, out = len(data), b""
        while size > 127:
            out, size = out + bytes([size & 127 | 128]), size >> 7
        return out + bytes([size]) + data

    def len_free(empty: object, field: object, value: object) -> tuple[bytes, bytes]:
        if field.is_repeated:  # type: ignore[attr-defined]
            getattr(empty, field.name).append(value)  # type: ignore[attr-defined]
        else:
            setattr(empty, field.name, value)  # type: ignore[attr-defined]
        data = empty.SerializeToString()  # type: ignore[attr-defined]
        return data[:1], data[1:]

    plain = made("womd_scenario", tmp_path)
    for packed in (False, True):
        again = from_bytes(recorded.tfrecord(reversed_fields(recorded.scenario(), packed)), tmp_path)
        assert np.array_equal(again.tracks.pose, plain.tracks.pose) and again.tracks.ids == plain.tracks.ids
        assert [lane.exits for lane in again.map.lanes] == [lane.exits for lane in plain.map.lanes]
        assert np.array_equal(again.times, plain.times) and again.signals.lane == plain.signals.lane


def test_headings_in_degrees_are_told_from_radians(tmp_path):
    in_degrees = from_bytes(json.dumps(recorded.gpudrive(degrees=True)).encode(), tmp_path)
    assert np.allclose(np.cos(in_degrees.tracks.pose[..., 3]), np.cos(np.radians(370.0)))
    assert in_degrees.repairs["headings in degrees, turned into radians"] == 3 * 91
    held = recorded.gpudrive()
    for one in held["objects"]:  # 3 degrees could be 3 rad; but they head where they move
        one["heading"] = [3.0] * 91
    assert np.allclose(from_bytes(json.dumps(held).encode(), tmp_path).tracks.pose[..., 3], np.radians(3.0))


def test_older_files_without_heights_ids_and_types_are_read(tmp_path):
    recording = from_bytes(json.dumps(recorded.gpudrive(old=True)).encode(), tmp_path)
    assert not recording.map.heights and recording.sdc == -1 and recording.to_predict is None
    conversion = convert(recording, SMALL)
    assert len(conversion.scenes) == 2 and conversion.notes["lanes of unknown type, taken as drivable"] == 4
    for control, what in (("sdc", "which car drove itself"), ("predict", "which tracks to predict")):
        with pytest.raises(UsageError, match=what):
            convert(recording, dataclasses.replace(SMALL, control=control))


def test_minus_ten_thousand_marks_what_is_not_there(tmp_path):
    held = recorded.gpudrive()
    held["objects"][1]["position"][5] = {"x": -10000.0, "y": -10000.0, "z": -10000.0}
    recording = from_bytes(json.dumps(held).encode(), tmp_path)
    assert not recording.tracks.valid[1, 5] and recording.tracks.valid[1].sum() == 90 and sum(recording.repairs.values()) == 1


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_pickles_of_every_protocol_give_the_same(protocol, tmp_path):
    recording = from_bytes(pickle.dumps(recorded.scenarionet(), protocol=protocol), tmp_path)
    assert np.array_equal(recording.tracks.pose, made("scenarionet", tmp_path).tracks.pose)


def test_a_heading_in_nuscenes_lanes_is_no_height(tmp_path):
    recording = from_bytes(pickle.dumps(recorded.scenarionet("nuscenes")), tmp_path)
    assert not recording.map.heights and all(not lane.line[:, 2].any() for lane in recording.map.lanes)
    assert convert(recording, SMALL).scenes[0].connectivity == "derived"


# What is made of it


def test_controlled_agents_are_those_asked_for(tmp_path):
    recording = made("womd_scenario", tmp_path)
    names = {c: [s.name for s in convert(recording, dataclasses.replace(SMALL, control=c)).scenes] for c in ("sdc", "predict", "moving")}
    assert names == {"sdc": ["made/11"], "predict": ["made/12"], "moving": ["made/11", "made/12"]}
    recording.tracks.valid[1, 0] = False  # comes later: cannot start there
    assert [s.name for s in convert(recording, SMALL).scenes] == ["made/11"]
    late = convert(recording, dataclasses.replace(SMALL, control="predict"))
    assert not late.scenes and late.notes["agents named that are no vehicles or not there at the start, left out"] == 1


def test_other_rates_are_resampled_and_too_short_or_coarse_logs_refused(tmp_path):
    recording = made("womd_scenario", tmp_path)
    slower = dataclasses.replace(recording, times=recording.times * 1.5)  # 6.7 Hz, 13.5 s: the cars are slower in truth
    conversion = convert(slower, SMALL)
    x = conversion.scenes[0].scene.pose[0, :, 0]
    assert np.allclose(x, np.arange(91) / 10 * 10.0 / 1.5, atol=1e-3) and conversion.notes["times resampled to 10 Hz"] > 30
    for times, why in ((recording.times / 2, "lasts 4.5 s"), (recording.times * 3, "3.3 Hz"), (-recording.times, "do not increase")):
        with pytest.raises(UsageError, match=why):
            convert(dataclasses.replace(recording, times=times), SMALL)
    with pytest.raises(UsageError, match="from 4 s on"):
        convert(recording, dataclasses.replace(SMALL, start=4.0))


def test_headings_between_two_times_take_the_shorter_way_round(tmp_path):
    recording = dataclasses.replace(made("womd_scenario", tmp_path), times=np.arange(91) / 8)
    recording.tracks.pose[0, :, 3] = np.where(np.arange(91) % 2, 3.1, -3.1)
    heading = convert(recording, SMALL).scenes[0].scene.pose[0, :, 2]
    assert np.all(np.abs(np.cos(heading)) > 0.99)


def test_a_later_start_is_a_later_scene(tmp_path):
    slower = dataclasses.replace(made("womd_scenario", tmp_path), times=np.arange(91) / 5)
    early, late = (convert(slower, dataclasses.replace(SMALL, start=s)).scenes[0] for s in (0.0, 4.0))
    assert np.allclose(late.origin - early.origin, [20.0, 0.0, 0.0], atol=1e-6)
    assert [late.scene.signals[t, 1] for t in (0, 38, 41)] == [RED, RED, AMBER]


def test_what_does_not_fit_is_dropped_farthest_first_and_counted(tmp_path):
    conversion = convert(made("womd_scenario", tmp_path), dataclasses.replace(SMALL, road_users=2, lanes=2, edges=1, successors=1))
    scene = conversion.scenes[0]
    assert scene.users == ("11", "12")  # the one on foot is 35 m away
    assert np.allclose(scene.scene.road.lanes[0, 0], [-5.0, 0.0]) and scene.scene.road.successors.tolist() == [[1], [-1]]
    assert conversion.dropped == {
        "road users beyond those that fit": 2, "lanes beyond those that fit": 2, "road edge segments beyond those that fit": 2,
        "scenes in which the log comes nearest to a lane or road edge that does not fit": 2,
    }  # fmt: skip


def test_simplified_lines_stay_where_they_were():
    angle = np.linspace(0, 2, 200)
    line = np.concatenate([np.stack([np.linspace(-80, 0, 160), np.zeros(160)], 1), 20 * np.stack([np.sin(angle), 1 - np.cos(angle)], 1)])
    kept, off = simplified(line, 32)
    assert off <= 0.05 and len(kept) < 32 and kept[:2] != [0, 1]  # the straight part needs no points
    polyline = np.concatenate([np.linspace(line[a], line[b], 800) for a, b in zip(kept[:-1], kept[1:], strict=True)])
    assert max(np.min(np.linalg.norm(polyline - p, axis=1)) for p in line) < 0.05 + 0.06
    rough, more = simplified(line, 4)
    assert len(rough) == 4 and more > 0.3


def test_who_comes_later_waits_where_it_will_appear(tmp_path):
    recording = made("womd_scenario", tmp_path)
    recording.tracks.valid[1, :30] = False
    scene = convert(recording, dataclasses.replace(SMALL, control="sdc")).scenes[0].scene
    assert (scene.pose[1, :30] == scene.pose[1, 30]).all() and not scene.valid[1, :30].any() and scene.valid[1, 30:].all()
    assert not scene.velocity[1, :30].any()


def test_maps_beyond_all_measure_are_refused(tmp_path):
    held = recorded.scenario()
    lane = held.map_features[0].lane
    lane.exit_lanes.extend([2] * 600_000)
    with pytest.raises(UsageError, match="more than 50000 links between lanes"):
        from_scenario(held)
    held = recorded.scenario()
    held.map_features.extend([held.map_features[0]] * 5000)
    with pytest.raises(UsageError, match="5009 lanes|5004 lanes"):
        convert(from_scenario(held), SMALL)
    far = np.array([[[-1e6, 0, 0], [1e6, 0, 0.0]]])
    assert len(sampled(far).points) == 100


def test_an_area_becomes_the_smallest_rectangle_with_its_longer_side_first():
    turn = np.array([[np.cos(0.4), np.sin(0.4)], [-np.sin(0.4), np.cos(0.4)]])
    corners = np.array([[0, 0], [3, 0], [3, 6], [3, 12], [0, 12.0]]) @ turn
    a, b, c, d = four_corners(np.pad(corners, [(0, 0), (0, 1)], constant_values=7.0))
    assert np.linalg.norm(b - a) == pytest.approx(12) and np.linalg.norm(c - b) == pytest.approx(3) and np.allclose(a + c, b + d)
    assert a[2] == 7.0


def test_states_and_points_that_are_not_finite_are_taken_out_and_counted(tmp_path):
    recording = made("womd_scenario", tmp_path)
    recording.tracks.pose[1, 3] = np.nan
    recording.tracks.velocity[2, 4] = 1e30
    recording.map.lanes[0].line[10] = np.inf
    conversion = convert(recording, SMALL)
    assert conversion.notes["states that are not finite or beyond 1,000 km, taken as absent"] == 2
    assert conversion.notes["map points that are not finite or beyond 1,000 km, dropped"] == 1
    for scene in conversion.scenes:
        assert all(np.isfinite(x).all() for x in (scene.scene.pose, scene.scene.velocity, scene.scene.road.lanes))


def test_a_vehicle_wider_than_long_is_turned(tmp_path):
    recording = made("womd_scenario", tmp_path)
    recording.tracks.size[0, :, :2] = 1.7, 4.1
    conversion = convert(recording, SMALL)
    assert conversion.scenes[0].scene.size[0].tolist() == pytest.approx([4.1, 1.7])
    assert conversion.dropped["vehicles wider than long, length and width exchanged"] == 2


def test_a_way_through_a_lane_without_a_length_goes_on_behind_it(tmp_path):
    held = recorded.scenario()
    held.map_features[0].lane.exit_lanes[:] = [5]
    point = held.map_features.add(id=5)
    point.lane.type = 2
    point.lane.polyline.add(**recorded.place(60, 0))
    point.lane.exit_lanes.extend([2, 3])
    for lane in held.map_features[1:3]:
        del lane.lane.entry_lanes[:]
    conversion = convert(from_bytes(recorded.tfrecord(held.SerializeToString()), tmp_path), SMALL)
    assert conversion.scenes[0].scene.road.successors[0].tolist() == [1, 2, -1, -1]


def bridge() -> bytes:
    """The same scene, with a road 6 m below that crosses: a lane, two edges, a car."""
    held = recorded.scenario()
    lane = held.map_features.add(id=50).lane
    lane.type = 2
    for y in range(-60, 61):
        lane.polyline.add(**recorded.place(100, y, -6.0))
    for known, x in ((51, 97), (52, 103)):
        edge = held.map_features.add(id=known).road_edge
        for y in range(-60, 61):
            edge.polyline.add(**recorded.place(x, y, -6.0))
    below = held.tracks.add(id=60, object_type=1)
    for i, state in enumerate(recorded.states(recorded.TRACKS[0])):
        state |= {"center_x": 8100.0, "center_y": -3045.0 + i, "center_z": 14.8, "heading": 1.57, "velocity_x": 0.0, "velocity_y": 10.0}
        below.states.add(**state)
    return recorded.tfrecord(held.SerializeToString())


def test_what_passes_below_a_bridge_is_left_out_and_what_is_on_it_stays(tmp_path):
    recording = from_bytes(bridge(), tmp_path)
    conversion = convert(recording, dataclasses.replace(SMALL, control="sdc"))
    scene = conversion.scenes[0]
    assert scene.users == ("11", "12", "13")
    assert conversion.dropped == {
        "road users on another level, left out": 1,
        "lanes on another level, left out": 1,
        "road edge segments on another level, left out": 2,
    }
    crossing = dataclasses.replace(recording, map=dataclasses.replace(recording.map, heights=False))
    assert "60" in convert(crossing, dataclasses.replace(SMALL, control="sdc")).scenes[0].users


def test_a_hill_is_no_other_level():
    x = np.linspace(0, 200, 101)
    line = np.stack([x, 0 * x, 0.06 * x], axis=1)[None]
    roads = dataclasses.replace(_empty_roads(), lanes=line, successors=((),))
    level = level_of(roads, line[0, :5], 0.0)
    beside = line + np.array([0.0, 6.0, 0.3])
    assert level.holds(sampled(beside), 1).all() and not level.holds(sampled(beside + np.array([0, 0, 6.0])), 1).any()


def _empty_roads():
    lane = recorded.scenario()
    return prepare(from_scenario(lane), 4)


def from_scenario(message) -> Recording:
    from rtc_mjx.logs import womd

    return womd.read(message.SerializeToString(), "made")


def test_points_that_repeat_are_one_point():
    notes = Counter()
    line = cleaned(np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [1, 0, 0], [np.nan, 0, 0], [2, 0, 0.0]]), notes)
    assert line[:, 0].tolist() == [0, 1, 2] and sum(notes.values()) == 1


def test_flashing_lights_and_unknown_ones_are_no_signals(tmp_path):
    held = recorded.scenario()
    for state in held.dynamic_map_states:
        state.lane_states[0].state = 7
    flashing = convert(from_scenario(held), SMALL).scenes[0].scene
    assert (flashing.signals == NO_SIGNAL).all() and flashing.road.gives_way[1] == 2


# Files, folders, damage


def test_files_folders_and_globs_are_found_and_nothing_is_said_in_one_line(tmp_path):
    for name in ("a/one", "a/b/two", "a/.hidden"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(recorded.written("gpudrive_json"))
    (tmp_path / "a/README.md").write_text("# what this is\n")
    (tmp_path / "empty").mkdir()
    assert [r.source for r in read.stream([tmp_path / "a"])] == [str(tmp_path / "a/b/two"), str(tmp_path / "a/one")]
    assert len(list(read.stream([f"{tmp_path}/a/o*", tmp_path / "a/one"]))) == 1
    for path, why in (
        (tmp_path / "none", "no such file"),
        (tmp_path / "empty", "holds no files"),
        (f"{tmp_path}/*.json", "no file matches"),
    ):
        with pytest.raises(UsageError, match=why):
            list(read.stream([path]))
    with pytest.raises(UsageError, match="README.md.*this is text"):
        list(read.stream([tmp_path / "a/README.md"]))


@pytest.mark.parametrize("kind", KINDS)
def test_the_wrong_loader_says_what_the_file_is(kind, tmp_path):
    file = file_of(kind, tmp_path)
    other = KINDS[(KINDS.index(kind) + 1) % len(KINDS)]
    with pytest.raises(UsageError, match=f"file: {other} is expected; this is {kind}"):
        next(read.recordings(file, other))


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (b"", "empty"), (b"\x1f\x8b\x08abc", "gzip"), (b"hello\n", "text"), (b'{"a": 1}', "JSON without objects"), (b"\x89PNG123", "PNG"),
        (recorded.tfrecord(b"\xff\xff"), "neither of Scenario"), (recorded.scenario().SerializeToString(), "protocol buffer on its own"),
        (bytes(range(250, 256)) * 20, "none of them"), (b"\x80\x04]\x94.", "its content should be a dictionary, not list"),
    ],
)  # fmt: skip
def test_other_files_are_named_for_what_they_are(data, what, tmp_path):
    with pytest.raises(UsageError, match=f"file: .*{what}") as error:
        from_bytes(data, tmp_path)
    assert "\n" not in str(error.value)


def test_damage_in_a_shard_names_the_record_and_keeps_those_before(tmp_path):
    payload = recorded.scenario().SerializeToString()
    whole = recorded.tfrecord(payload, payload, payload)
    third = len(whole) // 3
    cases = {
        "record 1: its checksum is wrong": whole[: third + 100] + b"\x00\x01" + whole[third + 102 :],
        "record 1: the checksum of its length": whole[:third] + b"\x07" + whole[third + 1 :],
        "record 2: .*truncated": whole[:-50], "record 2: the file ends within the record's head": whole[: 2 * third + 5],
    }  # fmt: skip
    for why, data in cases.items():
        (tmp_path / "file").write_bytes(data)
        seen = []
        with pytest.raises(UsageError, match=f"file, {why}"):
            for recording in read.recordings(tmp_path / "file"):
                seen.append(recording.scenario)
        assert len(seen) == int(why[7])


def test_a_length_beyond_the_file_allocates_nothing(tmp_path):
    import struct

    from rtc_mjx.logs.tfrecord import masked

    head = struct.pack("<Q", 2**60)
    with pytest.raises(UsageError, match="should have 1152921504606846976 bytes, but the file ends after 0"):
        from_bytes(head + struct.pack("<I", masked(head)) + b"1234", tmp_path)


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_files_give_scenes_or_one_line(kind):
    told = fuzz_logs.run(kind, range(60), 1, [recorded.written(kind)])
    assert told.clean and told.outcomes["scenes"] > 3 and told.outcomes["error"] > 5, told


@shared
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_recordings_of_others_give_scenes_or_one_line(kind):
    small = sorted(fuzz_logs.bases(kind), key=lambda file: file.stat().st_size)[:3]
    told = fuzz_logs.run(kind, range(50), 2, [file.read_bytes() for file in small])
    assert told.clean and told.outcomes["scenes"] > 3 and told.outcomes["error"] > 5, told


def test_malicious_pickles_run_nothing(tmp_path):
    for name, data in malicious.executed(tmp_path / "flag").items():
        assert outcomes(data, tmp_path) == {"error"}, name
    assert not (tmp_path / "flag").exists()


@pytest.mark.parametrize("cases", [malicious.bombs, malicious.pickles, malicious.texts, malicious.records])
def test_what_grows_without_end_is_refused_before_it_grows(cases, tmp_path):
    """In 10 s and 400 MB each, most of them in a hundredth of that; the processes of a test run share it."""
    for name, data in cases().items():
        assert outcomes(data, tmp_path) <= {"scenes", "error"}, name


def outcomes(data: bytes, folder: Path) -> set[str]:
    told, file = fuzz_logs.Told(), folder / "bad"
    file.write_bytes(data)
    fuzz_logs.tried(file, told)
    return set(told.outcomes)


@pytest.mark.parametrize(
    ("held", "links", "why"),
    [
        ("exit_lanes", 400, "its map has more than 50000 links"), ("polyline", 4000, "its map has more than 500000 points"),
        ("left_neighbor", 400, "its map has more than 50000 links"),
    ],
)  # fmt: skip
def test_one_list_in_many_places_counts_as_often_as_it_stands_there(held, links, why, tmp_path):
    one = np.zeros((20_000, 3)) if held == "polyline" else ["7"] * 2_000
    lane = recorded.scenarionet()["map_features"]["1"] | {held: one}
    data = pickle.dumps(recorded.scenarionet() | {"map_features": {str(i): lane for i in range(links)}})
    assert len(data) < 600_000
    with pytest.raises(UsageError, match=why):
        from_bytes(data, tmp_path)


def test_an_object_with_one_position_is_there_once_and_heights_are_known(tmp_path):
    held = recorded.gpudrive()
    held["objects"][0]["position"] = {"x": 1, "y": 2, "z": 3}
    recording = from_bytes(json.dumps(held).encode(), tmp_path)
    assert recording.map.heights and recording.tracks.valid.sum(axis=1).tolist() == [1, 91, 91]
    assert set(recording.repairs) == {"objects shorter than the others", "objects with parts of different lengths, cut to the shortest"}


def test_arrays_of_another_shape_than_they_should_have_are_not_read_as_if_they_had_it(tmp_path):
    held = recorded.scenarionet()
    state = held["tracks"]["11"]["state"]
    for what, array in (("heading", np.zeros((91, 2))), ("position", np.zeros((91, 1))), ("velocity", np.zeros(182))):
        odd = held["tracks"] | {"11": held["tracks"]["11"] | {"state": state | {what: array}}}
        with pytest.raises(UsageError, match=f"a track's {what} should .*shape {re.escape(str(array.shape))}"):
            from_bytes(pickle.dumps(held | {"tracks": odd}), tmp_path)


def test_what_is_dropped_from_a_file_is_counted(tmp_path):
    held = recorded.gpudrive()
    held["tl_states"]["2"]["state"][3], held["metadata"]["objects_of_interest"] = "green", 7
    repairs = from_bytes(json.dumps(held).encode(), tmp_path).repairs
    assert repairs["signal states of an unknown kind or time, dropped"] == 1
    assert repairs["what should be objects_of_interest but is no list, dropped"] == 1
    other = recorded.scenarionet()
    other["dynamic_map_states"]["2"]["state"]["object_state"][3:5] = ["LANE_STATE_GREEN", None]  # None: nothing is told
    other["metadata"]["tracks_to_predict"] = ["12", "99", "12"]
    recording = from_bytes(pickle.dumps(other), tmp_path)
    assert recording.repairs["signal states of an unknown kind, dropped"] == 1 and len(recording.signals.time) == 89
    assert recording.repairs["tracks to predict that are not among the tracks"] == 1 and recording.to_predict == (1,)
    record = recorded.scenario()
    record.current_time_index = 5_000
    moved = from_scenario(record)
    assert moved.now == 90 and moved.repairs == {"current times outside of the recording, moved to its nearest": 1}


def test_two_road_users_do_not_have_one_id(tmp_path):
    record = recorded.scenario()
    record.tracks.append(record.tracks[1])
    with pytest.raises(UsageError, match=r"several tracks with the ids \['12'\]"):
        from_scenario(record)
    held = recorded.gpudrive()
    held["objects"].append(held["objects"][1])
    recording = from_bytes(json.dumps(held).encode(), tmp_path)
    assert recording.tracks.ids == ("11", "12", "13", "#3") and sum(recording.repairs.values()) == 1


def test_ids_are_one_line_that_can_be_printed(tmp_path):
    held = recorded.scenarionet()
    held["metadata"]["scenario_id"] = "a\nb\ud800" + "c" * 1000
    name = from_bytes(pickle.dumps(held), tmp_path).scenario
    assert name.startswith("a\\nb\\ud800ccc") and name.isprintable() and len(name) < 100
    assert from_scenario(recorded.scenario("a\nb")).scenario == "a\\nb"


@pytest.mark.parametrize("kind", KINDS)
def test_a_disk_that_fails_anywhere_is_one_line(kind, tmp_path, monkeypatch):
    file = file_of(kind, tmp_path)

    def failing(*_: object) -> bytes:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(Path, "read_bytes", failing)
    monkeypatch.setattr(read.tfrecord, "_record", failing)
    with pytest.raises(UsageError, match=r"file: it cannot be read: Input/output error"):
        next(read.recordings(file))


def test_what_no_reader_has_foreseen_is_one_line_too(tmp_path, monkeypatch):
    def broken(error: type[BaseException]):
        def read_it(data: bytes, source: str) -> Recording:
            raise error("first line\nsecond line")

        return read_it

    monkeypatch.setitem(read.WHOLE, "gpudrive_json", broken(TypeError))
    with pytest.raises(UsageError, match=r"file: it is damaged in a way .* \(TypeError: first line\)$") as told:
        made("gpudrive_json", tmp_path)
    assert isinstance(told.value.__cause__, TypeError)
    monkeypatch.setitem(read.RECORDS, "womd_scenario", broken(TypeError))
    with pytest.raises(UsageError, match="file, record 0: it is damaged in a way"):
        made("womd_scenario", tmp_path)
    for passed in (MemoryError, KeyboardInterrupt):
        monkeypatch.setitem(read.WHOLE, "gpudrive_json", broken(passed))
        with pytest.raises(passed):
            made("gpudrive_json", tmp_path)


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (b"\x80\x04cos\nsystem\n.", "os.system"), (b"\x80\x04cnumpy\nndarray\n)R.", "a call of numpy ndarray"),
        (b"\x80\x04]N}b.", "state of a NoneType"), (b"\x80\x04cbuiltins\nint\nN\x85R.", "a call of builtins int"),
        (b"\x80\x04cnumpy\ndtype\n\x8c\x0350i\x85R.", "arrays of type '50i'"),
        (b"\x80\x04cnumpy\ndtype\n]\x85R.", "arrays of type list"), (b"\x80\x04u.", "operations without a mark"),
    ],
)  # fmt: skip
def test_a_pickle_says_what_it_wanted(data, what):
    with pytest.raises(UsageError, match=f"made: its pickle holds {what}"):
        pickled.load(data, "made")


def test_a_name_that_runs_code_would_be_noticed(tmp_path):
    """The pickles above are what they say they are: the ordinary loader runs them."""
    flag = tmp_path / "flag"
    pickle.loads(malicious.executed(flag)["system"])
    assert flag.exists()


def test_memory_is_flat_over_a_shard(tmp_path):
    payload = recorded.tfrecord(recorded.scenario().SerializeToString())
    with (tmp_path / "shard").open("wb") as opened:
        for _ in range(400):
            opened.write(payload)
    code = (
        "import resource, sys; from pathlib import Path; from rtc_mjx.logs import read\n"
        "for number, _ in enumerate(read.recordings(Path(sys.argv[1]))):\n"
        "    if number in (20, 399): print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "shard"], capture_output=True, text=True, cwd=ROOT, check=True)
    early, late = map(int, done.stdout.split())
    assert late - early < 3_000  # kB; the shard has 16,000


# The cache


@pytest.fixture
def kept(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    file = tmp_path / "shard"
    file.write_bytes(recorded.tfrecord(*(recorded.scenario(f"s{i}").SerializeToString() for i in range(3))))
    return file


def same(one, other) -> bool:
    import jax

    return one.name == other.name and all(
        np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one.scene), jax.tree.leaves(other.scene), strict=True)
    )


def test_scenes_from_the_cache_are_the_scenes(kept, monkeypatch):
    first = list(store.scenes([kept], SMALL))
    monkeypatch.setattr(store, "convert", None)  # from here on nothing is converted
    again = list(store.scenes([kept], SMALL))
    assert len(first) == 6 and all(same(a, b) for a, b in zip(first, again, strict=True))
    assert again[0].users == first[0].users and again[0].connectivity == "logged" and np.array_equal(again[0].origin, first[0].origin)


def test_other_options_or_content_are_another_entry(kept):
    folders = {store.entry(kept, SMALL), store.entry(kept, dataclasses.replace(SMALL, start=1.0))}
    kept.write_bytes(recorded.tfrecord(recorded.scenario("other").SerializeToString()))
    assert len(folders | {store.entry(kept, SMALL)}) == 3


@pytest.mark.parametrize("damage", ["flip", "cut", "gone", "index"])
def test_a_damaged_entry_is_made_anew_and_said(kept, damage, caplog):
    first = list(store.scenes([kept], SMALL))
    folder = store.entry(kept, SMALL)
    part = folder / ("index.json" if damage == "index" else "000001.npz")
    data = bytearray(part.read_bytes())
    if damage == "gone":
        part.unlink()
    else:
        data[len(data) // 2] ^= 1
        part.write_bytes(data[: len(data) // 2] if damage in ("cut", "index") else data)
    again = list(store.scenes([kept], SMALL))
    assert all(same(a, b) for a, b in zip(first, again, strict=True))
    assert sum("made anew" in r.message for r in caplog.records) == 1 and store.whole(folder)


def test_what_else_lies_in_a_folder_is_passed_over(kept, tmp_path):
    (tmp_path / "in").mkdir()
    kept.rename(tmp_path / "in" / "shard")
    (tmp_path / "in" / "LICENSE").write_text("terms\n")
    assert len(list(store.scenes([tmp_path / "in"], SMALL))) == 6
    with pytest.raises(UsageError, match="no scene can be made"):
        list(store.scenes([tmp_path / "in"], dataclasses.replace(SMALL, start=5.0)))


def test_without_a_place_to_keep_them_scenes_are_made_all_the_same(kept, tmp_path, caplog):
    (tmp_path / "cache").write_text("a file where the folder should be")
    assert len(list(store.scenes([kept], SMALL))) == 6
    assert any("cannot be kept" in r.message for r in caplog.records)


def test_two_writers_killed_at_any_moment_leave_a_whole_entry_or_none(kept):
    """Both convert the same shard over and over; the second lives on for a while. Whatever is left then, the scenes are right."""
    kept.write_bytes(recorded.tfrecord(*(recorded.scenario(f"s{i}").SerializeToString() for i in range(6))))
    expected = [scene.name for scene in store.scenes([kept], SMALL)]
    folder = store.entry(kept, SMALL)
    code = (
        "import sys; from pathlib import Path; from rtc_mjx.logs import store; from tests.test_logs import SMALL\n"
        "print('ready', flush=True)\n"
        "while True: store.build(Path(sys.argv[1]), SMALL)\n"
    )
    children = [subprocess.Popen([sys.executable, "-c", code, str(kept)], cwd=ROOT, stdout=subprocess.PIPE) for _ in range(2)]
    try:
        for child in children:
            assert child.stdout is not None and child.stdout.readline() == b"ready\n"
        for child, wait in zip(children, (0.37, 0.21), strict=True):
            time.sleep(wait)
            child.send_signal(signal.SIGKILL)
            child.wait()
            assert store.whole(folder)  # the index is replaced by an equal one, never by half of one
            assert [scene.name for scene in store.scenes([kept], SMALL)] == expected
    finally:
        for child in children:
            child.kill()
            child.communicate()


def test_a_first_conversion_that_is_killed_leaves_no_entry(kept, monkeypatch):
    """Killed after two of three recordings: simulated by an interrupt, as the index is written last."""

    def interrupted(recording: Recording, became: object) -> None:
        if recording.scenario == "s1":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        store.build(kept, SMALL, interrupted)
    folder = store.entry(kept, SMALL)
    assert len(list(folder.glob("*.npz"))) == 2 and not store.whole(folder)
    assert len(list(store.scenes([kept], SMALL))) == 6 and store.whole(folder)


# The recordings that others made


@shared
def test_the_scenario_record_has_the_counts_of_its_file():
    (recording,) = read.stream([recorded.SHARED / "womd_scenario"])
    held, road = recording.tracks, recording.map
    counts = (len(held.ids), len(road.lanes), len(road.road_edges), len(road.crosswalks), len(road.stop_signs), len(recording.signals.time))
    assert counts == (83, 199, 28, 4, 8, 1092) and len(recording.to_predict or ()) == 3 and recording.sdc == 82


@shared
def test_every_shared_file_loads_and_can_be_driven():
    counts, connectivity, empty = Counter(), {}, []
    for recording in read.stream([recorded.SHARED]):
        counts[recording.kind] += 1
        conversion = convert(recording, Options(control="sdc" if recording.sdc >= 0 else "moving"))
        connectivity.setdefault(recording.kind, set()).update(s.connectivity for s in conversion.scenes)
        if not conversion.scenes:
            empty.append(Path(recording.source).name)
        moving = recording.tracks.valid & (np.linalg.norm(recording.tracks.velocity, axis=-1) > 4) & (recording.tracks.kinds == 1)[:, None]
        way = np.arctan2(recording.tracks.velocity[..., 1], recording.tracks.velocity[..., 0])
        if np.sum(moving) > 300:  # vehicles head where they go
            assert np.mean(np.cos(recording.tracks.pose[..., 3] - way)[moving]) > 0.8, recording.source
    assert counts == {"womd_scenario": 1, "womd_tf_example": 1, "gpudrive_json": 24, "scenarionet": 15}
    assert connectivity["womd_scenario"] == {"logged"} and connectivity["gpudrive_json"] == {"derived"}
    assert empty == ["tfrecord-00004-of-00150_246.json"]  # three cars, none of which is there throughout and moves


@shared
def test_derived_connectivity_is_that_which_is_logged_elsewhere():
    hit = known = found = 0
    for recording in read.stream([recorded.SHARED / "womd_scenario", recorded.SHARED / "scenarionet_waymo"]):
        unknown = dataclasses.replace(recording, map=dataclasses.replace(recording.map, connected=False))
        logged, derived = ({(i, j) for i, after in enumerate(prepare(r, 4).successors) for j in after} for r in (recording, unknown))
        hit, known, found = hit + len(logged & derived), known + len(logged), found + len(derived)
    assert hit / known > 0.995 and hit / found > 0.98


@shared
def test_at_the_overpass_the_motorway_below_is_left_out():
    options = Options(control="sdc", start=9.5)
    (recording,) = read.stream([recorded.SHARED / "scenarionet_waymo" / "eb4b91b10ca94ff2.pkl"])
    conversion = convert(recording, options)
    lanes = conversion.scenes[0].scene.road.lanes + conversion.scenes[0].origin[:2]
    below = [lane for lane in recording.map.lanes if lane.id in ("310", "311", "312", "313", "314", "315", "210", "211", "213", "214")]
    for lane in below:
        assert not np.any(np.all(np.abs(lanes[:, 0] - lane.line[0, :2]) < 0.5, axis=1)), lane.id
    assert conversion.dropped["road edge segments on another level, left out"] > 10
