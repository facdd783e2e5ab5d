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

from rtc_mjx import config, dataset, evaluate, inverse_dynamics, train
from rtc_mjx.config import Config
from rtc_mjx.errors import UsageError
from rtc_mjx.inverse_dynamics import FitOptions, fit, start_of
from rtc_mjx.learner import compiled_chunk, start_all
from rtc_mjx.logs.convert import Options
from rtc_mjx.logs.store import scenes
from rtc_mjx.methods import METHODS
from rtc_mjx.physics import rest_surroundings, simulate, specialised_step
from rtc_mjx.realism import at_log_rate
from rtc_mjx.runs import RECORDINGS
from rtc_mjx.scenes.recorded import FOLLOWED, HEADED, Recorded, fitted, part_of
from rtc_mjx.scenes.recorded import driven as logged
from rtc_mjx.team import ALONE, Team

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
    parts = {part: part_of(scene.converted, part, scene.train_share) for part in ("train", "test")}
    recorded = {part: {held.name.rsplit("/", 1)[0] for held in held} for part, held in parts.items()}
    assert recorded["train"] and recorded["test"] and not recorded["train"] & recorded["test"]
    fewer = part_of(scene.converted[len(scene.converted) // 2 :], "train", scene.train_share)
    assert {held.name for held in fewer} <= {held.name for held in parts["train"]}  # no recording changes its part for others
    assert sum(len(held) for held in parts.values()) == len(scene.converted)


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


@pytest.mark.usefixtures("quick_to_compile")
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


@pytest.mark.usefixtures("quick_to_compile")
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
