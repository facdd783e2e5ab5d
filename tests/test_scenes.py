"""Laws that every scene obeys, and those of the double goal problem. A new scene is tested by standing in SCENES."""

import copy
import dataclasses

import dm_env
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from absl.testing import absltest
from dm_env import test_utils
from jax import random
from made import demonstrated, made

from rtc_mjx import cache, dataset, evaluate, reference
from rtc_mjx.environment import Environment
from rtc_mjx.errors import NonFiniteError, UsageError
from rtc_mjx.rollout import rollout
from rtc_mjx.scenes import SCENES, Actor, DoubleGoal, Intersection, double_goal, scene_type, split_items
from rtc_mjx.trajectory import Demonstration


def experts(name):
    return demonstrated(name)[0]


@pytest.fixture(params=SCENES)
def scene(request):
    return made(request.param)


SILENT = {"routes": (4, 5, 6, 7), "road_users": (9,)}
ANY = {"routes": range(4, 10), "road_users": (9,)}  # in a few recordings there may be no signal, and nobody on foot


def playback(scene, actions):
    return Actor((), lambda memory, observation, action: (memory, action), actions)


def test_trajectories_have_one_state_more_than_actions(scene):
    track = experts(scene.name).trajectory
    assert track.actions.shape[1:] == (scene.steps, len(scene.world.control_ids))
    assert track.observations.shape[1] == track.states.qpos.shape[1] == scene.steps + 1


def test_an_episode_starts_where_reset_says(scene):
    held = experts(scene.name)
    assert np.array_equal(held.trajectory.states.qpos[:, 0], held.episode.start.qpos)
    assert all(x.shape[1] == scene.steps + 1 for x in jax.tree.leaves(held.episode.surroundings))


def test_experts_are_finite_and_differ(scene):
    track = experts(scene.name).trajectory
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(track))
    assert np.all(np.std(track.actions, axis=(0, 1)) > 0)


def test_episodes_start_differently(scene):
    start = experts(scene.name).episode
    assert any(np.std(x, axis=0).max() > 0 for x in jax.tree.leaves((start.start.qpos, start.surroundings.pose)))


def test_no_observation_is_constant(scene):
    seen = experts(scene.name).trajectory.observations
    own, sets = split_items(scene.sets, seen.shape[-1] - sum(s.count * s.size for s in scene.sets), seen)
    assert np.all(np.std(own.reshape(-1, own.shape[-1]), axis=0) > 0)
    for held, items in zip(scene.sets, sets, strict=True):
        spread = np.std(items.reshape(-1, held.size), axis=0)
        silent = {"roundabout": SILENT, "merge": SILENT, "womd": ANY}.get(scene.name, {}).get(held.name, ())  # without signals or people
        assert set(np.flatnonzero(spread == 0)) <= set(silent), (held.name, np.flatnonzero(spread == 0))
        assert np.all(np.abs(items[items[..., 0] < 0.5]) == 0)  # what is not there says nothing


def test_a_rollout_is_a_function_of_its_inputs(scene):
    """Playing an expert's actions back gives the expert's states, and c MuJoCo agrees with them."""
    held = jax.tree.map(lambda x: x[0], experts(scene.name))
    again = rollout(scene, playback(scene, held.trajectory.actions), held.episode)
    assert np.allclose(again.states.qpos, held.trajectory.states.qpos, atol=1e-5)


def test_rollout_matches_c_mujoco(scene, x64):
    held = jax.tree.map(lambda x: x[1].astype(float) if x.dtype.kind == "f" else x[1], experts(scene.name))
    track = rollout(scene, playback(scene, held.trajectory.actions), held.episode)
    model = copy.copy(scene.world.mj)
    for mocap, (long, wide) in enumerate(held.episode.surroundings.size[0]):
        body = scene.world.mocap_ids[mocap]
        if mocap in scene.world.users:
            model.geom_size[model.body_geomadr[body], :2] = wide / 2, (long - wide) / 2
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = held.episode.start.qpos, held.episode.start.qvel
    for time, action in enumerate(held.trajectory.actions):
        before, after = held.episode.surroundings.pose[time], held.episode.surroundings.pose[time + 1]
        data.ctrl[list(scene.world.control_ids)] = action
        for step in range(scene.substeps):  # bodies move straight on within a control step
            x, y, heading = (before + step / scene.substeps * (after - before)).T
            data.mocap_pos[:, 0], data.mocap_pos[:, 1] = x, y
            data.mocap_quat[:] = np.stack([np.cos(heading / 2), 0 * x, 0 * x, np.sin(heading / 2)], axis=1)
            mujoco.mj_step(model, data)
        assert np.allclose(track.states.qpos[time + 1], data.qpos, atol=1e-6), time


def test_features_and_metrics_are_finite_and_the_expert_equals_itself(scene):
    _, features = demonstrated(scene.name)
    features = {name: x[None] for name, x in features.items()}
    result = scene.metrics(features, features)
    assert all(np.isfinite(v) for v in result.values()) and set(scene.main_metrics) <= set(result)
    assert all(v == 0 for name, v in result.items() if "jsd" in name)


@pytest.mark.parametrize("scene", [DoubleGoal(), Intersection(steps=4, road_users=1)], ids=lambda scene: scene.name)
def test_agents_are_compared_with_as_many_experts_as_they_have_rollouts(scene, tmp_path, monkeypatch):
    """They are made once, and those of the floor are others."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    theirs, floor = reference.both(scene, 4)
    assert all(x.shape[:2] == (scene.samples, 4) for held in (theirs, floor) for x in held.values())
    name = "return" if scene.samples == 1 else "ade"
    assert np.all(theirs[name] > 0) and not np.array_equal(theirs[name], floor[name])
    monkeypatch.setattr(cache, "write_arrays", None)  # would be called if they were made again
    again = reference.experts(scene, 4)
    assert all(np.array_equal(x, again[name]) for name, x in theirs.items())
    log = evaluate.references(scene, 4).get("log_replay")
    assert (log is None) == (scene.samples == 1)  # there the demonstrations themselves are what agents are compared with
    assert log is None or (log["min_ade"] == 0 and log["progress_jsd"] > 0 and np.isfinite(list(log.values())).all())


def test_what_is_seen_at_the_start_has_a_finite_derivative(scene):
    """By the state, on episodes that leave room for routes and road users that are not there."""
    held = jax.tree.map(lambda x: jnp.asarray(x[:32]), experts(scene.name).episode)

    def seen(qpos, episode):
        start = dataclasses.replace(episode.start, qpos=qpos)
        return scene.observe(episode, jnp.array(0), start)

    assert np.all(np.isfinite(jax.jit(jax.vmap(jax.jacrev(seen)))(held.start.qpos, held)))


def test_demonstrations_come_from_the_cache_unchanged(scene, tmp_path, monkeypatch):
    if scene.recorded("train", 1) is not None:
        pytest.skip("recordings have a cache of their own, of converted scenes (test_logs.py)")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    first = dataset.demonstrations(scene, 8, 3)
    (file,) = tmp_path.rglob("demonstrations/*.npz")
    stamp = file.stat().st_mtime_ns
    second = dataset.demonstrations(scene, 8, 3)
    assert file.stat().st_mtime_ns == stamp
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True))
    file.write_bytes(file.read_bytes()[:200])  # cut short by a crash of the machine
    third = dataset.demonstrations(scene, 8, 3)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(third), strict=True))


def test_cached_demonstrations_depend_on_every_setting(scene):
    prints = {
        dataset.fingerprint(s, n, k) for s in (scene, dataclasses.replace(scene, steps=scene.steps + 1)) for n in (8, 9) for k in (0, 1)
    }
    assert len(prints) == 8


def test_unknown_scene_is_refused():
    with pytest.raises(UsageError, match=r"nowhere.*double_goal"):
        scene_type("nowhere")


class TestConformance(test_utils.EnvironmentTestMixin, absltest.TestCase):
    """dm_env's own conformance suite."""

    def make_object_under_test(self):
        return Environment(made("double_goal"))


def test_environment_lives_whole_episodes_and_keeps_dm_controls_physics_in_step(scene):
    environment = Environment(scene, seed=2)
    action = np.full(environment.action_spec().shape, 0.1)
    for _ in range(2):
        steps = [environment.reset()]
        while not steps[-1].last():
            steps.append(environment.step(action))
        assert len(steps) == scene.steps + 1 and steps[-1].discount == 1.0
        assert all(s.observation.shape == environment.observation_spec().shape for s in steps)
    state = environment._now[2]
    assert np.allclose(environment.physics.data.qpos, state.qpos, atol=1e-6)
    body = environment.physics.named.data.xpos[scene.agent_body]
    assert np.allclose(body[:2], np.asarray(scene.world.mj.body(scene.agent_body).pos)[:2] + state.qpos[:2], atol=1e-5)
    assert environment.physics.data.time == pytest.approx(scene.steps * environment.control_timestep())


def test_environment_refuses_wrong_actions(scene):
    environment = Environment(scene)
    environment.reset()
    with pytest.raises(UsageError, match="shape"):
        environment.step(np.zeros(99))
    with pytest.raises(NonFiniteError, match="nan"):
        environment.step(np.full(environment.action_spec().shape, np.nan))


def test_environment_starts_an_episode_when_stepped_before_reset(scene):
    environment = Environment(scene)
    assert environment.step(np.zeros(environment.action_spec().shape)).step_type == dm_env.StepType.FIRST


# The double goal problem


def test_goals_keep_their_sides():
    y = experts("double_goal").episode.surroundings.pose[..., 1]
    assert np.all(y[..., 0] < 0) and np.all(y[..., 1] > 0)


def test_goals_drift_slowly_in_all_directions():
    pose = experts("double_goal").episode.surroundings.pose[..., :2]
    speed = np.linalg.norm(np.diff(pose, axis=1), axis=-1) / 0.05
    assert np.percentile(speed, 99) < 1.05 * double_goal.DRIFT[1] and np.percentile(speed, 1) > 0.9 * double_goal.DRIFT[0]
    way = np.sign(pose[:, -1] - pose[:, 0])
    assert all(abs(np.mean(way[..., axis])) < 0.2 for axis in (0, 1))


def test_expert_prefers_the_lower_goal_three_to_one():
    held = experts("double_goal")
    assert abs(np.mean(held.truth["goal"] == double_goal.LOWER) - 0.75) < 0.06
    ended_upper = held.trajectory.states.qpos[:, -1, 1] > 0
    assert np.mean(ended_upper == (held.truth["goal"] == double_goal.UPPER)) > 0.99


def test_neither_side_gives_the_goal_away_early():
    held = experts("double_goal")
    lower, below = held.truth["goal"] == double_goal.LOWER, held.trajectory.states.qpos[:, 15, 1] < 0
    assert 0.5 < np.mean(lower[below]) < 0.9 and 0.5 < np.mean(lower[~below]) < 0.9


def test_both_goals_are_equally_easy():
    """Experts sent to one or the other from the first step stay there equally long."""
    returns = []
    for probability in (1.0, 0.0):
        scene = DoubleGoal(lower_probability=probability)
        held = dataset.demonstrations(scene, 512, 6)
        returns.append(np.asarray(jax.vmap(scene.features)(held, held.trajectory)["return"]))
    assert abs(returns[0].mean() - returns[1].mean()) < 3 * np.hypot(*(r.std() / np.sqrt(len(r)) for r in returns))


def test_expert_turns_left_as_often_as_right_to_either_goal():
    held = experts("double_goal")
    features = jax.vmap(made("double_goal").features)(held, held.trajectory)
    left, upper = np.asarray(features["left"]) == 1, np.asarray(features["upper"]) == 1
    assert np.mean(left == (held.truth["bend"] < 0)) > 0.95  # it heads off to one side and comes back by turning to the other
    assert abs(np.mean(left[upper]) - 0.5) < 0.15 and abs(np.mean(left[~upper]) - 0.5) < 0.1


def test_return_counts_steps_at_a_goal():
    """By hand: placed on a goal for three of four steps, a little more than 0.1 m off in the last."""
    scene = DoubleGoal(steps=4)
    episode = scene.reset(random.key(0))
    goal = episode.surroundings.pose[:, 1, :2]
    states = jax.tree.map(lambda x: jnp.broadcast_to(x, (5, *x.shape)), episode.start)
    at_goal = type(states)(goal.at[4, 0].add(0.101), states.qvel, states.warmstart)
    track = rollout(scene, playback(scene, jnp.zeros((4, 2))), episode)
    features = scene.features(Demonstration(episode, track, ()), type(track)(at_goal, track.observations, track.actions))
    assert features["return"] == 3 and features["upper"] == 1
