"""Recorded traffic as a scene: controls by inverse dynamics, replayed drivers, parts that share nothing, every method on it."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import recorded as files
from jax import random
from made import made, recordings

from rtc_mjx import config, data, dataset, evaluate, inverse_dynamics, reference, train
from rtc_mjx.config import Config
from rtc_mjx.errors import UsageError
from rtc_mjx.inverse_dynamics import Fit, FitOptions, fit, start_of
from rtc_mjx.logs import store
from rtc_mjx.logs.convert import Options
from rtc_mjx.logs.store import scenes
from rtc_mjx.methods import METHODS
from rtc_mjx.physics import rest_surroundings, simulate, specialised_step
from rtc_mjx.recorded_realism import at_log_rate
from rtc_mjx.runs import RECORDINGS
from rtc_mjx.scenes import pool
from rtc_mjx.scenes import recorded as recorded_scenes
from rtc_mjx.scenes.pool import FOLLOWED, HEADED, fitted, part_of
from rtc_mjx.scenes.pool import driven as logged
from rtc_mjx.scenes.recorded import Recorded
from rtc_mjx.team import ALONE, Team
from rtc_mjx.updates import compiled_chunk, start_all

STEP, SUBSTEPS = 0.3, 6
KINDS = ("womd_scenario", "womd_tf_example", "gpudrive_json", "scenarionet_waymo", "scenarionet_nuscenes")


def driven(key, steps=30):
    """Poses of a car under smooth random controls, and the controls."""
    world = inverse_dynamics.alone()
    pull, bend = random.split(key)
    knots = jnp.linspace(0, 5, steps)

    def smooth(key, size):
        return size * jnp.interp(knots, jnp.arange(6.0), random.normal(key, (6,)))

    actions = jnp.stack([smooth(pull, 0.8), smooth(bend, 0.05)], axis=1)
    start = start_of(jnp.zeros((2, 3)), jnp.array([9.0, 0.0]), STEP)
    step = specialised_step(world)
    _, states = simulate(world, start, actions, rest_surroundings(world), substeps=SUBSTEPS, one_step=step)
    return jnp.concatenate([start.qpos[None], states.qpos])[:, :3], actions


@jax.jit
def followed(poses):
    return jax.vmap(lambda p: fit(start_of(jnp.zeros((2, 3)), jnp.array([9.0, 0.0]), STEP), p, SUBSTEPS, FitOptions(updates=100)))(poses)


def test_a_path_that_the_car_drove_is_followed_to_a_centimetre():
    poses, actions = jax.jit(jax.vmap(driven))(random.split(random.key(0), 16))
    found = followed(poses)
    assert np.median(found.position_error) < 0.01 and np.max(found.position_error) < 0.1
    assert np.median(np.abs(found.actions - actions), axis=(0, 1)) == pytest.approx([0, 0], abs=0.05)


def test_a_path_that_no_car_can_drive_is_told_by_its_error():
    """It moves sideways at 3 m/s, its heading ahead all the time."""
    poses = jnp.stack([9.0 * STEP * jnp.arange(31), 3.0 * STEP * jnp.arange(31), jnp.zeros(31)], axis=1)[None]
    found = followed(poses)
    assert np.mean(found.position_error) > FOLLOWED or np.mean(found.heading_error) > HEADED


def test_controls_replayed_without_the_driver_give_the_same_motion():
    poses, _ = jax.jit(jax.vmap(driven))(random.split(random.key(1), 4))
    found, world = followed(poses), inverse_dynamics.alone()
    start = start_of(jnp.zeros((2, 3)), jnp.array([9.0, 0.0]), STEP)
    for i in range(4):
        _, states = simulate(world, start, found.actions[i], rest_surroundings(world), substeps=SUBSTEPS, one_step=specialised_step(world))
        off = np.linalg.norm(states.qpos[:, :2] - poses[i, 1:, :2], axis=1)
        assert np.allclose(off, found.position_error[i, 1:], atol=2e-3)


def test_logged_drivers_are_followed():
    """Over the vehicles that move in all recordings at hand: median 0.15 m and 95th percentile 0.5 m are wanted."""
    logs = [held.scene for held in scenes([recordings(*KINDS)], Options(road_users=4, lanes=4, edges=4))]
    found = fitted(*(np.stack(x) for x in zip(*(logged(log, made("womd").steps) for log in logs), strict=True)))
    assert len(logs) > 200
    assert np.median(found.position_error) < 0.05 and np.percentile(found.position_error, 95) < 0.2
    assert np.mean(np.mean(found.position_error, axis=1) > FOLLOWED) < 0.02


def test_replayed_experts_stay_with_the_log():
    scene = made("womd")
    held = dataset.demonstrations(scene, 64, dataset.TEST)
    logs = scene.pool("test").logs
    where = np.stack([log[agent][::3] for log, agent in zip(logs.pose, logs.controlled, strict=True)])[: len(held.trajectory.states.qpos)]
    off = np.linalg.norm(held.trajectory.states.qpos[..., :2] - where[..., :2], axis=-1)
    assert np.median(off) < 0.05 and np.percentile(off, 95) < 0.3


def test_parts_share_no_recording_and_leave_none_out():
    scene = made("womd")
    parts = {part: scene.available(part) for part in ("train", "test")}
    names = {part: {place.scenario for place in held} for part, held in parts.items()}
    assert names["train"] and names["test"] and not names["train"] & names["test"]
    fewer = part_of(sorted(names["train"] | names["test"])[3:], "train", scene.train_share)
    assert fewer <= names["train"]  # no recording changes its part for others
    assert sum(len(held) for held in parts.values()) == len(scene.places)


def test_recordings_that_are_not_there_leave_no_run_behind(tmp_path):
    argv = ["--scene", "womd", "--scene.data", str(tmp_path / "none"), "--method", "bc", "--run", str(tmp_path / "run")]
    with pytest.raises(UsageError, match="no such file"):
        train.main(argv)
    assert not (tmp_path / "run").exists()


def test_processes_with_other_recordings_are_named():
    class Pair(Team):
        def exchange(self, value, last=False):
            return [value, value | {"digest": "another"}]

    held = Config(scene=made("womd"))
    train.compare_recordings(held, ALONE)
    with pytest.raises(UsageError, match=r"^process 1 \(there\) has other recordings .*another.* than process 0 \(here\)"):
        train.compare_recordings(held, Pair(hosts=("here", "there")))


def test_recorded_scenes_say_what_they_cannot_do(tmp_path):
    with pytest.raises(UsageError, match=r"--scene\.data.*where the recordings are"):
        Recorded().pool("train")
    with pytest.raises(UsageError, match=r"--scene\.steps 40"):
        dataclasses.replace(made("womd"), steps=40).pool("train")
    with pytest.raises(UsageError, match="one expert each"):
        dataset.by_others(made("womd"), 4, dataset.TEST, 2)
    (tmp_path / "one.json").write_bytes(files.written("gpudrive_json"))
    unconnected = ["--scene", "womd", "--scene.data", str(tmp_path / "one.json"), "--method", "symphony"]
    with pytest.raises(UsageError, match=r"symphony.*connect"):
        config.from_command_line(unconnected, "train")


SMALL = {
    "scene.steps": 5, "scene.road-users": 1, "updates": 2, "batch": 4, "experts.train": 8, "experts.test": 4,
    "every.log": 1, "every.test": 2, "every.save": 2, "model.width": 8, "model.discriminator-width": 8,
    "model.type-size": 2, "model.prior-components": 2,
}  # fmt: skip


def settings(method, folder):
    argv = ["--scene", "womd", "--scene.data", recordings("scenarionet_waymo"), "--method", method, "--run", str(folder)]
    return config.from_command_line([*argv, *(x for name, value in SMALL.items() for x in (f"--{name}", str(value)))], "train")


logged_drivers = functools.cache(dataset.demonstrations)  # the same for all methods


@pytest.mark.parametrize("method", METHODS)
def test_every_method_learns_from_recordings(method, tmp_path):
    held = settings(method, tmp_path)
    expert = logged_drivers(held.scene, held.experts.train, dataset.TRAIN)
    learner = held.learner(dataset.statistics(held.scene, expert))
    before = start_all(learner, held.all_seeds)
    after, told = compiled_chunk(learner, 2)(jax.tree.map(jnp.copy, before), dataset.without_truth(expert))
    assert int(after.update[0]) == 2 and all(np.all(np.isfinite(x)) for x in told.values())
    assert np.all(told.get("trajectories_dropped", 0) == 0)
    moved = jax.tree.map(lambda a, b: bool(np.any(a != b)), before.networks.policy, after.networks.policy)
    assert any(jax.tree.leaves(moved))


def test_a_training_on_recordings_is_tested_and_evaluated(tmp_path):
    run = train.train(settings("symphony", tmp_path / "run"))
    line = run.metrics()[-1]
    assert line["update"] == 2 and {"curvature_jsd", "min_ade"} <= set(line)
    result = evaluate.evaluate(run, 4)
    assert result["reaction"] == {} and result["reference"]["expert"]["min_ade"] == 0.0
    assert json.loads(json.dumps(result)) == result
    (ours,), replay = result["sim_agents"]["prior"], result["sim_agents"]["log_replay"]
    assert replay["average_displacement_error"] == 0 < ours["average_displacement_error"]
    assert 0 < ours["realism_meta_metric"] < replay["realism_meta_metric"] <= 1

    began_with = json.loads((run.folder / RECORDINGS).read_text())
    told = result["recordings"]
    assert told["train"] + told["test"] == len(began_with) and told["train"] == len(run.config.scene.pool("train").names)
    (run.folder / RECORDINGS).write_text(json.dumps([*began_with[1:], "test another/1 0"]))
    for use in (evaluate.main, lambda argv: train.main([*argv, "--resume"])):
        with pytest.raises(UsageError, match="2 went or came"):
            use(["--run", str(run.folder)])
    (run.folder / RECORDINGS).unlink()
    with pytest.raises(UsageError, match="not known which recordings"):
        evaluate.evaluate(run, 4)


def test_poses_at_the_rate_of_the_log_pass_through_those_of_the_control_steps():
    scene = made("womd")
    held = dataset.demonstrations(scene, 2, dataset.TEST)
    one = jax.tree.map(lambda x: jnp.asarray(x[0]), dataset.without_truth(held))
    fine = at_log_rate(scene, one.episode, one.trajectory)
    assert fine.shape == (90, 4)
    assert np.allclose(fine[2::3, jnp.array([0, 1, 3])], one.trajectory.states.qpos[1:, :3], atol=2e-3)
    step = np.linalg.norm(np.diff(fine[:, :2], axis=0), axis=1)
    assert np.max(np.abs(np.diff(step))) < 0.2  # no jump between control steps: less than 20 m/s^2


# What is chosen of recordings, and what is said of the rest


@pytest.fixture
def mixed(tmp_path, monkeypatch):
    """Six recordings that log connectivity, three that do not; all agents are taken to be followed, without looking for controls."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(pool, "fitted", with_errors(lambda scenes: np.zeros(scenes)))
    (tmp_path / "in").mkdir()
    shard = files.tfrecord(*(files.scenario(f"w{i}").SerializeToString() for i in range(6)))
    (tmp_path / "in" / "shard").write_bytes(shard)
    for i in range(3):
        (tmp_path / "in" / f"g{i}.json").write_text(json.dumps(files.gpudrive() | {"scenario_id": f"g{i}"}))
    yield tmp_path / "in"
    recorded_scenes._pool.cache_clear()


def with_errors(of):
    """In place of `fitted`: controls of nothing, with these errors in m."""

    def fitted(poses, velocity):
        error = np.tile(of(len(poses))[:, None], poses.shape[1])
        return Fit(np.zeros((len(poses), poses.shape[1] - 1, 2), np.float32), error, 0 * error)

    return fitted


def test_what_the_command_converted_a_training_converts_no_more(mixed, monkeypatch):
    data.main([str(mixed), "--convert"])
    monkeypatch.setattr(store, "convert", None)  # from here on nothing is converted
    scene = Recorded(data=str(mixed))
    assert len(scene.listed) == 9 and len(scene.pool("train").names) + len(scene.pool("test").names) == 18


def test_no_more_scenes_are_held_than_asked_for_and_a_hash_chooses_them(mixed):
    every, few = Recorded(data=str(mixed)), Recorded(data=str(mixed), most=6)
    assert (len(few.pool("train").names), len(few.pool("test").names)) == (4, 2)
    assert all(len(x) == 4 for x in jax.tree.leaves(few.pool("train").logs))
    assert few.pool("train").names == every.pool("train").names[:4]
    there = every.available("train")
    assert few.counts()["scenes to learn from beyond those that are held (--scene.most)"] == len(there) - 4
    assert [p.name for p in pool.chosen(there[::-1], 4)] == [p.name for p in pool.chosen(there, 4)] != [p.name for p in there[:4]]
    for name, log in zip(few.pool("train").names, few.pool("train").logs.pose, strict=True):  # each with its own log
        assert log[0, 30, 0] == pytest.approx(30.0 if name.endswith("/11") else 27.0, abs=0.02)


def test_types_of_another_episode_are_of_another_recording(mixed):
    scene = Recorded(data=str(mixed))
    recordings = np.array([name.rsplit("/", 1)[0] for name in scene.pool("test").names])
    assert 1 < len(set(recordings)) < len(recordings)
    assert np.all(evaluate.elsewhere(scene, np.unique(recordings, return_inverse=True)[1]) != scene.groups(len(recordings)))


@pytest.mark.parametrize("sizes", [(1,) * 7, (3, 2, 1), (4, 4), (5, 1, 1), (2, 3, 3, 1)])
def test_another_is_a_permutation_into_other_groups_as_far_as_there_are_any(sizes):
    groups = np.random.default_rng(0).permutation(np.repeat(np.arange(len(sizes)), sizes))
    other, most = evaluate.another(groups), max(sizes)
    assert sorted(other) == list(range(len(groups)))
    assert np.sum(groups[other] == groups) == max(0, 2 * most - len(groups))


def test_what_conversion_dropped_is_among_the_notes(mixed):
    told = Recorded(data=str(mixed)).converted()
    assert told["bike lanes, not for driving (in converting 9 recordings to 18 scenes)"] == 9


def test_counts_tell_both_parts_and_who_was_left_out_and_why(mixed, monkeypatch):
    monkeypatch.setattr(pool, "fitted", with_errors(lambda scenes: np.where(np.arange(scenes) == 1, 3.0, 0.0)))
    told = Recorded(data=str(mixed)).counts()
    assert told["recordings to learn from"] + told["recordings to test on"] == 9
    assert told["scenes to learn from"] + told["scenes to test on"] == 16
    assert told["agents that no car can follow (left out)"] == 2 and "agents whose log ends early (left out)" not in told


def test_where_nobody_is_left_the_reasons_are_told_apart(mixed, monkeypatch):
    scene = Recorded(data=str(mixed))
    monkeypatch.setattr(pool, "fitted", with_errors(lambda scenes: np.full(scenes, 3.0)))
    with pytest.raises(UsageError, match=r"to learn from, none of \d+ agents is left: 0 logs end early, and \d+ no car can follow"):
        scene.pool("train")
    monkeypatch.setattr(pool, "_agents", lambda logs, steps: (*agents(logs, steps)[:2], np.zeros(len(logs.kind), bool)))
    with pytest.raises(UsageError, match=r"left: [1-9]\d* logs end early, and 0 no car can follow"):
        scene.pool("train")


agents = pool._agents


def test_symphony_leaves_out_recordings_that_do_not_log_connectivity_and_says_how_many(mixed):
    argv = ["--scene", "womd", "--scene.data", str(mixed)]
    for method, count in (("symphony", 12), ("bc", 18)):
        scene = config.from_command_line([*argv, "--method", method], "train").scene
        assert len(scene.places) == count and bool(scene.labels) == (method == "symphony")
    unused = "scenes of recordings that do not log lane connectivity (left out)"
    assert dataclasses.replace(scene, only_connected=True).counts()[unused] == 6 and unused not in scene.counts()
    for file in mixed.glob("shard"):
        file.unlink()
    with pytest.raises(UsageError, match="none of the recordings"):
        _ = Recorded(data=str(mixed), only_connected=True).places


def test_curvature_is_left_out_only_where_no_recording_logs_connectivity(mixed):
    held = {
        name: np.zeros((1, 2)) for name in ("collision", "overlap", "offroad", "may_leave_road", "ade", "progress", "turned", "ran_red")
    }
    held |= {"curvature": np.array([[[0.1, 0.2], [9.0, 9.0]]]), "branching": np.array([[[True, True], [False, False]]])}
    assert Recorded(data=str(mixed)).metrics(held, held)["curvature_jsd"] == 0.0
    (mixed / "shard").unlink()
    recorded_scenes._pool.cache_clear()  # the same settings, other files
    assert "curvature_jsd" not in Recorded(data=str(mixed)).metrics(held, held)


def test_features_and_notes_say_what_a_recording_lacks(mixed):
    """Those that do not log connectivity have no road edges either: they count for neither curvature nor off-road time."""
    for i in range(3):
        lacking = files.gpudrive() | {"scenario_id": f"g{i}"}
        lacking["roads"] = [road for road in lacking["roads"] if road["type"] != "road_edge"]
        (mixed / f"g{i}.json").write_text(json.dumps(lacking))
    scene = Recorded(data=str(mixed), steps=3, road_users=1)
    held = dataset.demonstrations(scene, 99, dataset.TRAIN)
    lacks = np.array([name.startswith("g") for name in scene.pool("train").names])
    told = reference.expert_features(scene, held)
    assert 0 < np.sum(lacks) < len(lacks)
    assert not np.any(told["may_leave_road"][lacks]) and not np.any(told["branching"][lacks])
    notes = scene.notes(held.episode)
    assert notes["test episodes without road edges (not in offroad_time)"] == np.sum(lacks)
    assert notes["test episodes whose lanes are not logged as connected (not in curvature_jsd)"] == np.sum(lacks)


def test_a_training_says_what_it_learns_from(mixed, capsys):
    Recorded(data=str(mixed)).ready()
    said = capsys.readouterr().err
    assert "recordings to learn from" in said and "recordings to test on" in said and len(said.splitlines()) == 1
