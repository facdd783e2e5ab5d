"""Recordings and submissions as the Sim Agents challenge takes them: cases worked out by hand, and what the public code gives."""

import dataclasses
import json
import random
import struct
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtc_mjx import challenge
from rtc_mjx.errors import RunError, UsageError
from rtc_mjx.logs import womd
from rtc_mjx.logs.read import recordings
from rtc_mjx.sim_agents import Rollouts, of_recording, places, rollouts
from rtc_mjx.sim_agents.recorded import FUTURE, NOW
from rtc_mjx.sim_agents.roads import distance_to_road_edge
from tests import recorded
from tests.recorded import ORIGIN, SHARED, place, scenario

SCENE, SUBMISSION = SHARED / "womd_scenario" / "637f20cafde22ff8.tfrecord", SHARED / "wosac" / "637f20cafde22ff8_submission.binproto"
real = pytest.mark.skipif(not (SCENE.exists() and SUBMISSION.exists()), reason="the shared recordings are not here")
IDS = ("11", "12", "13")


# Recordings ----------------------------------------------------------------------------------------------------------


def task_of(message):
    return of_recording(womd.read(message.SerializeToString(), "made"))


def test_everybody_there_at_the_current_time_is_simulated_and_the_named_are_scored():
    made = scenario()
    for i, state in enumerate(made.tracks[2].states):
        state.valid = i != NOW  # the pedestrian is missing at the current time only
    task = task_of(made)
    assert task.ids == ("11", "12") and task.scored.tolist() == [0, 1, -1, -1, -1]  # drives itself, is to be predicted
    assert task_of(scenario()).ids == IDS and task_of(scenario()).scored.tolist() == [0, 1, -1, -1, -1]
    assert np.array_equal(task.log.valid.sum(axis=1)[:3], [91, 91, 0])


def test_positions_are_in_space_from_where_a_scored_agent_is_at_the_current_time():
    task = task_of(scenario())
    assert np.allclose(task.origin, [ORIGIN[0] + 5 + 10, ORIGIN[1], ORIGIN[2] + 0.8])
    assert np.allclose(task.log.pose[:3, NOW, :3], [[0, 0, 0], [-16, 0.2, 0], [26, 6, 0]], atol=1e-5)
    assert np.allclose(task.log.size[:3], [[4.8, 2, 1.6], [4.5, 1.9, 1.6], [0.6, 0.6, 1.6]])
    assert task.log.vehicle[:3].tolist() == [True, True, False]
    segments = task.edges.segments[task.edges.valid]
    assert segments.shape == (240, 2, 3) and np.allclose(segments[..., 2], -0.8)  # a metre long each; boxes stand on the ground
    assert np.allclose(segments[0], [[-15, -7, -0.8], [-14, -7, -0.8]], atol=1e-3)


def test_the_size_is_that_of_the_current_time():
    made = scenario()
    made.tracks[0].states[NOW].length = 5.5
    assert float(task_of(made).log.size[0, 0]) == 5.5


@pytest.mark.parametrize(("above", "expected"), [(1.5, -3.0), (0.5, 3.0)])
def test_an_edge_above_counts_where_three_times_its_height_is_nearer_than_ones_own_edge(above, expected):
    """The first car is 2 m wide and stands 4 m from the edge to its left, and 7 m from that to its right; 2 m to its left runs the edge of
    another road, 1.5 or 0.5 m above, beyond which it would be. Left wheels: 3 m from their own edge, hypot(1, 3 x 1.5) = 4.6 or
    hypot(1, 3 x 0.5) = 1.8 from the other one. In the first case they are on the road by 3 m; in the second off it by 1 m, and the right
    wheels by 3 m. Without the stretch, hypot(1, 1.5) = 1.8 would be nearer in the first case too."""
    made = scenario()
    edge = made.map_features.add(id=99).road_edge
    for x in range(0, 120, 2):
        edge.polyline.add(**place(x, 2.0, above))
    task = task_of(made)
    past = distance_to_road_edge(task.log.pose[:1, NOW : NOW + 1], task.log.size[:1], task.edges)
    assert float(past[0, 0]) == pytest.approx(expected, abs=1e-3)


def test_stop_points_are_those_of_the_log_and_signals_those_of_their_lane():
    made = scenario()
    for at in made.dynamic_map_states:
        at.lane_states[0].stop_point.CopyFrom(type(at.lane_states[0].stop_point)(**place(70, 0)))
    lines = task_of(made).lines
    assert np.allclose(lines.stop[:3], [[-15, 0], [55, 0], [45, 0]], atol=1e-3)  # the third lane has no signal: its start
    assert lines.red.sum(axis=0)[:3].tolist() == [0, 40, 0] and bool(lines.red[:40, 1].all())
    assert np.sum(np.any(lines.lanes != lines.lanes[:, :1], axis=(1, 2))) == 3  # nobody's signal is on a bike lane


def test_boxes_of_files_without_heights_stand_on_the_map():
    made = womd.read(scenario().SerializeToString(), "made")
    flat = dataclasses.replace(made.map, heights=False, road_edges=tuple(
        dataclasses.replace(edge, points=edge.points * [1, 1, 0]) for edge in made.map.road_edges
    ))  # fmt: skip
    size = np.where([True, True, False], made.tracks.size, np.nan)
    task = of_recording(dataclasses.replace(made, map=flat, tracks=dataclasses.replace(made.tracks, size=size)))
    assert np.allclose(task.log.pose[:3, :, 2], 0) and np.allclose(task.edges.segments[task.edges.valid][..., 2], -0.8)
    assert task.notes["agents of unknown height, taken as 1.6 m high"] == 3


def test_who_cannot_be_scored_is_told():
    made = womd.read(scenario().SerializeToString(), "made")
    with pytest.raises(UsageError, match="made: it does not say which car drove itself"):
        of_recording(dataclasses.replace(made, sdc=-1, to_predict=None))
    for now in (-1, 91):
        with pytest.raises(UsageError, match=f"made: its current time is number {now}; it has 91 times"):
            of_recording(dataclasses.replace(made, now=now))
    valid = made.tracks.valid.copy()
    valid[:2, NOW] = False
    with pytest.raises(UsageError, match="none of the agents to score is there"):
        of_recording(dataclasses.replace(made, tracks=dataclasses.replace(made.tracks, valid=valid)))
    assert of_recording(dataclasses.replace(made, to_predict=None)).notes == {
        "lists of tracks to predict that are missing: only the self-driving car is scored": 1
    }


# Submissions ---------------------------------------------------------------------------------------------------------


def varint(value):
    return bytes([value & 0x7F | 0x80]) + varint(value >> 7) if value > 0x7F else bytes([value])


def field(number, content):
    """A field of a message, as the wire has it: bytes with their length, or a number."""
    return varint(number << 3) + varint(content) if isinstance(content, int) else varint(number << 3 | 2) + varint(len(content)) + content


def trajectory(name, pose, packed=True):
    floats = [struct.pack(f"<{len(pose)}f", *column) for column in np.asarray(pose).T]
    if packed:
        coordinates = [field(2 + i, held) for i, held in enumerate(floats)]
    else:  # one field a number
        coordinates = [
            b"".join(varint((2 + i) << 3 | 5) + held[k : k + 4] for k in range(0, len(held), 4)) for i, held in enumerate(floats)
        ]
    return field(6, int(name)) + b"".join(coordinates)


def written(name, scenes, packed=True):
    """A ScenarioRollouts: of each rollout the poses of each agent, by its id."""
    told = [b"".join(field(1, trajectory(agent, pose, packed)) for agent, pose in scene.items()) for scene in scenes]
    return field(1, name.encode()) + b"".join(field(2, scene) for scene in told)


def submission(*held):
    return b"".join(field(1, one) for one in held) + field(2, 1) + field(3, b"somebody@example.org")


def poses(count=FUTURE, start=0.0):
    return start + np.arange(count * 4, dtype=np.float32).reshape(count, 4) / 8  # exact in float32


def whole(**changes):
    """Rollouts of the made recording, two of them."""
    scenes = [{name: poses(start=k + int(name)) for name in IDS} for k in range(2)]
    for name, pose in changes.items():
        scenes[1][name.strip("a_")] = pose
    return written("made", scenes)


def read_back(path, data):
    path.write_bytes(data)
    ((name, held),) = places([path]).items()
    return name, rollouts(held)


@pytest.mark.parametrize("packed", [True, False])
def test_a_submission_is_read_as_it_was_written(packed, tmp_path):
    scenes = [{"7": poses(start=k), "12": poses(start=-k)} for k in range(3)]
    one = written("made", scenes, packed)
    for data in (one, submission(one)):
        name, found = read_back(tmp_path / "it.binproto", data)
        assert name == "made" and set(found.ids) == {"7", "12"}
        for k, scene in enumerate(scenes):
            for i, agent in enumerate(found.ids):
                assert np.array_equal(found.pose[k, i], scene[agent])


def test_each_scenario_of_a_submission_is_found_by_its_id(tmp_path):
    held = [written(f"s{i}", [{"1": poses(start=i)}]) for i in range(3)]
    (tmp_path / "a").write_bytes(submission(*held[:2]))
    (tmp_path / "b").write_bytes(submission(held[2]))
    found = places([tmp_path])
    assert [float(rollouts(found[f"s{i}"]).pose[0, 0, 0, 0]) for i in range(3)] == [0, 1, 2]
    (tmp_path / "c").write_bytes(held[1])
    with pytest.raises(UsageError, match="scenario s1 has rollouts already in .*a"):
        places([tmp_path])


def test_poses_come_in_the_recordings_order_and_frame():
    task = task_of(scenario())
    held = Rollouts("made", ("13", "11", "12"), np.stack([np.full((1, FUTURE, 4), float(i)) for i in range(3)], axis=1))
    found = task.simulated(held)
    assert found.shape == (1, 64, FUTURE, 4)
    for i, value in enumerate((1, 2, 0)):  # 11, 12, 13
        assert np.allclose(found[0, i], value - np.array([*task.origin, 0.0]), atol=1e-3)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "the file is empty"),
        (b"some text, no message", "does not hold together"),
        (whole()[:-5], "does not hold together at byte"),
        (submission(), "has no rollouts"),
        (submission(b"\xff"), "holds something else"),
        (submission(field(2, b"")), "does not name the scenario"),
        (submission(field(1, b"made")), "it has 0 rollouts; 1 to 1024 are read"),
        (written("made", [{}]), "it has no agents"),
        (whole(a_12=poses(79)), "trajectories have 79 to 80 times"),
        (whole(a_12=poses() * np.nan), "agent 12 has poses that are not finite"),
        (whole(a_14=poses()), "rollout 1 has other agents than the first: 14"),
        (written("made", [{"1": poses()}]) + field(2, field(1, trajectory("1", poses()) + field(5, b"\0\0\0\0"))), "heading 81"),
        (written("made", []) + field(2, field(1, trajectory("1", poses())) * 2), "rollout 0: agent 1 is there twice"),
        (recorded.tfrecord(b"abc"), "does not hold together"),
    ],
)  # fmt: skip
def test_what_is_no_submission_is_told_in_one_line(data, why, tmp_path):
    with pytest.raises(UsageError, match=why) as caught:
        read_back(tmp_path / "it.binproto", data)
    assert "it.binproto" in str(caught.value) and "\n" not in str(caught.value)


def test_a_damaged_submission_gives_rollouts_or_one_line(tmp_path):
    task, sound, rng = task_of(scenario()), submission(whole()), random.Random(0)
    for _ in range(300):
        data = bytearray(sound)
        kind, at = rng.randrange(3), rng.randrange(len(sound))
        if kind == 0:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del data[at : at + rng.randrange(1, 50)]
        else:
            data[at:at] = data[at // 2 : at // 2 + rng.randrange(1, 50)]
        try:
            task.simulated(read_back(tmp_path / "it.binproto", bytes(data))[1])
        except UsageError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("scenes", "why"),
    [
        ([{"11": poses(), "12": poses()}], "agents 13 are there at the current time of made and are not simulated"),
        ([{name: poses() for name in (*IDS, "99")}], "agents 99 are simulated, but are not there"),
        ([{name: poses(79) for name in IDS}], "have 79 times; 80 at 10 Hz are expected"),
    ],
)
def test_rollouts_of_other_agents_or_times_are_refused(scenes, why, tmp_path):
    _, found = read_back(tmp_path / "it.binproto", written("made", scenes))
    with pytest.raises(UsageError, match=why):
        task_of(scenario()).simulated(found)


# The command ---------------------------------------------------------------------------------------------------------


def files(folder: Path, ahead=0.0, name="made"):
    """The made recording, and a submission with its log, moved by some metres."""
    (folder / "it.tfrecord").write_bytes(recorded.tfrecord(scenario().SerializeToString()))
    tracks = next(recordings(folder / "it.tfrecord")).tracks
    held = {name: tracks.pose[i, NOW + 1 :] + [ahead, 0, 0, 0] for i, name in enumerate(tracks.ids)}
    (folder / "it.binproto").write_bytes(submission(written(name, [held] * 32)))
    return [str(folder / "it.tfrecord"), "--submission", str(folder / "it.binproto")]


def test_the_command_scores_log_replay_and_a_submission(tmp_path, capsys):
    challenge.main([*files(tmp_path, ahead=2.0), "--json", str(tmp_path / "it.json")])
    told = json.loads((tmp_path / "it.json").read_text())
    (scene,) = told["scenes"]
    assert (scene["name"], scene["agents"], scene["judged"], scene["count"]) == ("made", 3, 2, 32)
    assert scene["log_replay"]["min_average_displacement_error"] == 0
    assert scene["submission"]["min_average_displacement_error"] == pytest.approx(2.0 * 80 / 91, abs=1e-3)
    assert told["mean"] == {who: scene[who] for who in ("log_replay", "submission")}
    out = capsys.readouterr().out
    assert out.startswith("made: 3 agents, 2 scored; realism 0.") and f"{scene['submission'][challenge.META]:.4f}" in out


def test_errors_of_the_command_are_one_line(tmp_path):
    recording, *rest = files(tmp_path, name="another")
    for argv, why in (
        ([recording, *rest], "rollouts of another; none of the recordings is one of these"),
        ([rest[1]], "a Sim Agents submission is scored by"),
        ([recording, "--submission", recording], "a Sim Agents submission is expected"),
        ([recording, "--submission", str(tmp_path / "none")], "there is no such file"),
        ([recording, "--json", str(tmp_path / "none" / "it.json")], "there is no folder"),
    ):
        with pytest.raises(UsageError, match=why) as caught:
            challenge.main(argv)
        assert "\n" not in str(caught.value)


def test_a_recording_that_cannot_be_scored_among_others_is_told_and_fails(tmp_path, capsys):
    files(tmp_path)
    (tmp_path / "it.binproto").unlink()
    old = scenario("nobody")
    old.ClearField("sdc_track_index")
    old.ClearField("tracks_to_predict")
    (tmp_path / "old.tfrecord").write_bytes(recorded.tfrecord(old.SerializeToString()))
    with pytest.raises(RunError, match="1 could not be scored"):
        challenge.main([str(tmp_path)])
    told = capsys.readouterr()
    assert "old.tfrecord, record 0: it does not say which car drove itself" in told.err and "made: 3 agents" in told.out


# What the public code gives ------------------------------------------------------------------------------------------

# of waymo-open-dataset-tf-2-12-0 1.6.7 with its settings of 2025, on the recording and the submission that come with its tests
PUBLIC = {
    "linear_speed_likelihood": 0.647147, "linear_acceleration_likelihood": 0.129309, "angular_speed_likelihood": 0.061596,
    "angular_acceleration_likelihood": 0.309280, "distance_to_nearest_object_likelihood": 0.237239, "collision_likelihood": 0.052868,
    "time_to_collision_likelihood": 0.754345, "distance_to_road_edge_likelihood": 0.402153, "offroad_likelihood": 0.073568,
    "traffic_light_violation_likelihood": 0.999969, "realism_meta_metric": 0.258240, "kinematic": 0.286833, "interactive": 0.249723,
    "map_based": 0.252852, "average_displacement_error": 2.505281, "min_average_displacement_error": 2.084689,
    "simulated_collision_rate": 0.6875, "simulated_offroad_rate": 0.265625, "simulated_traffic_light_violation_rate": 0.0,
}  # fmt: skip
# The public code takes a speed across a gap of the log, where absent agents stand at (0, 0), as known: thousands of m/s, so at once there.
ACROSS_GAPS = {"time_to_collision_likelihood": 0.782349, "interactive": 0.255947, "realism_meta_metric": 0.261040}


@real
def test_the_shared_submission_scores_what_the_public_code_gives_it():
    found = challenge.scored(next(recordings(SCENE)), places([SUBMISSION])["637f20cafde22ff8"])
    assert (found.agents, found.judged, found.count, found.notes) == (50, 4, 32, {})
    for name, public in PUBLIC.items():
        assert found.submission[name] == pytest.approx(ACROSS_GAPS.get(name, public), abs=1e-4), name
    assert found.log_replay["realism_meta_metric"] == pytest.approx(0.838, abs=1e-3)
    assert found.log_replay["average_displacement_error"] == found.log_replay["simulated_offroad_rate"] == 0


@real
def test_the_shared_log_as_a_submission_scores_083():
    """A submission has its agents throughout; who leaves the log stands at (0, 0) then."""
    task = of_recording(next(recordings(SCENE)))
    found = challenge.figures(task, jnp.tile(task.replay(), (32, 1, 1, 1)))
    assert found["realism_meta_metric"] == pytest.approx(0.830, abs=1e-3)


@real
def test_what_is_scored_is_everything_a_recording_has():
    recording = next(recordings(SCENE))
    task = of_recording(recording)
    assert len(task.ids) == recording.tracks.valid[:, 10].sum()
    assert int(task.edges.valid.sum()) == sum(len(edge.points) - 1 for edge in recording.map.road_edges)
    assert jax.tree.all(jax.tree.map(lambda x: bool(np.all(np.isfinite(x))), (task.log, task.edges, task.lines)))
