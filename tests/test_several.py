"""Laws of several controlled cars in one world: what they are together, apart, and to each other."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random
from test_driving import GENERATED, straight_road

from rtc_mjx import config, dataset, evaluate, reference, render
from rtc_mjx.config import Config, Experts, Intervals
from rtc_mjx.environment import Environment
from rtc_mjx.errors import UsageError
from rtc_mjx.geometry import capsule_gap
from rtc_mjx.gradients import gradients
from rtc_mjx.learner import OptimiserOptions
from rtc_mjx.logs import VEHICLE
from rtc_mjx.methods import METHODS
from rtc_mjx.models import ModelOptions
from rtc_mjx.physics.car import CAR
from rtc_mjx.rollout import rollout
from rtc_mjx.runs import Run
from rtc_mjx.scenes import SCENES, Actor, Intersection, crew, merged, parted
from rtc_mjx.scenes.driver import expert_driver
from rtc_mjx.scenes.routes import nearest_lane
from rtc_mjx.scenes.several import cars_apart, cars_together
from rtc_mjx.trajectory import Demonstration
from rtc_mjx.updates import compiled_chunk, start, start_all, start_shapes

SMALL = ModelOptions(width=8, discriminator_width=8, mixture=1, type_size=2, prior_components=2)


def on_a_road(poses, speeds):
    """A straight road with cars that are driven, and nobody else."""
    log, count = straight_road(users=len(poses) + 1), len(poses)
    pose = jnp.asarray(poses, float)
    heading = jnp.stack([jnp.cos(pose[:, 2]), jnp.sin(pose[:, 2])], axis=1)
    velocity = jnp.asarray(speeds, float)[:, None] * heading
    return dataclasses.replace(
        log,
        pose=log.pose.at[:count].set(pose[:, None]),
        velocity=log.velocity.at[:count].set(velocity[:, None]),
        kind=log.kind.at[:count].set(VEHICLE),
        valid=log.valid.at[:count].set(True),
        controlled=jnp.arange(count) if count > 1 else jnp.array(0),
    )


def driven(scene, episode, keys):
    """The joint rollout of experts with these keys."""
    drivers = scene.each(lambda key, routes: expert_driver(key, scene, routes, scene.speeds)[0])
    return rollout(scene, crew(scene, drivers(keys, episode.context.routes)), episode)


def playback(actions):
    return Actor((), lambda memory, observation, action: (memory, action), actions)


def as_double(tree):
    return jax.tree.map(lambda x: x.astype(float) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree)


@pytest.mark.parametrize("cars", [2, 3])
def test_cars_far_from_each_other_drive_as_if_alone(cars):
    poses, speeds = [[20.0 + 160.0 * i, 0.1 * i, 0.0] for i in range(cars)], [8.0 + i for i in range(cars)]
    together, alone = Intersection(steps=8, road_users=4 - cars, controlled=cars), Intersection(steps=8, road_users=3)
    keys = random.split(random.key(0), cars)
    episode = together.episode(on_a_road(poses, speeds))
    apart = together.apart(jax.jit(lambda e: driven(together, e, keys))(episode))
    by_itself = jax.jit(lambda e, key: driven(alone, e, key))
    for car in range(cars):
        one = by_itself(alone.episode(on_a_road([poses[car]], [speeds[car]])), keys[car])
        assert np.allclose(apart.states.qpos[car], one.states.qpos, atol=1e-4)
        assert np.allclose(apart.observations[car], one.observations, atol=2e-3)
        assert np.allclose(apart.actions[car], one.actions, atol=1e-3)


def test_swapping_agents_swaps_their_trajectories():
    scene = Intersection(steps=10, road_users=2, controlled=2)
    episode, keys = scene.reset(random.key(4)), random.split(random.key(1))
    flip = [1, 0]
    start = cars_together(jax.tree.map(lambda x: x[jnp.array(flip)], cars_apart(episode.start, 2)), 2)
    own = {name: jax.tree.map(lambda x: x[jnp.array(flip)], getattr(episode.context, name)) for name in episode.context.own}
    swapped = dataclasses.replace(episode, start=start, context=dataclasses.replace(episode.context, **own))
    run = jax.jit(lambda e, keys: driven(scene, e, keys))
    here, there = scene.apart(run(episode, keys)), scene.apart(run(swapped, keys[jnp.array(flip)]))
    assert np.abs(np.diff(here.states.qpos[:, -1, :2], axis=0)).max() > 10
    for one, other in zip(jax.tree.leaves((here.states.qpos, here.observations, here.actions)),
                          jax.tree.leaves((there.states.qpos, there.observations, there.actions)), strict=True):  # fmt: skip
        assert np.allclose(one, other[jnp.array(flip)], atol=2e-3)


def test_cars_sent_at_each_other_collide_and_the_gradient_goes_through(x64):
    """Both count the collision; what one does moves the other, by as much as central differences say."""
    scene = Intersection(steps=6, road_users=2, controlled=2)
    episode = as_double(scene.episode(on_a_road([[20.0, 0.0, 0.0], [38.0, 0.4, np.pi + 0.1]], [9.0, 7.0])))
    actions = jnp.tile(jnp.array([[1.0, 0.01], [0.5, -0.01]]), (scene.steps, 1, 1))

    @jax.jit
    def run(actions):
        return rollout(scene, playback(actions), episode)

    track = run(actions)
    features = jax.jit(scene.features)(Demonstration(episode, track, ()), track)
    assert features["collision"].tolist() == [True, True] and features["overlap"].tolist() == [True, True]
    ends = scene.apart(track).states.qpos[:, -1]
    assert ends[0, 0] < 30 and ends[1, 0] > ends[0, 0] + 1.9  # nobody went on through the other

    def end(actions):
        return jnp.sum(scene.apart(rollout(scene, playback(actions), episode)).states.qpos[0, -1, :3] * jnp.array([1.0, 2.0, 3.0]))

    slope = jax.jit(jax.grad(end))(actions)
    value = jax.jit(end)
    assert np.all(np.isfinite(slope)) and np.abs(slope[:2, 1]).max() > 1e-3
    for step, car, control in ((0, 0, 0), (0, 1, 0), (1, 1, 1)):
        nudge = jnp.zeros_like(actions).at[step, car, control].set(1e-6)
        difference = (value(actions + nudge) - value(actions - nudge)) / 2e-6
        assert np.isclose(slope[step, car, control], difference, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", [name for name in GENERATED if SCENES[name].room > 1])
def test_cars_start_on_ways_of_their_own_clear_of_everybody(name):
    scene = SCENES[name](controlled=SCENES[name].room)

    def room(log):
        """The lane of each car, where it starts, and the least gap between two of all that are there at t = 0."""
        pose, there = log.pose[:, 0], log.valid[:, 0] & (log.kind > 0)
        gap = jax.vmap(lambda mine, size: capsule_gap(mine, size, pose, log.size))(pose, log.size)
        two = there[:, None] & there & ~jnp.eye(len(pose), dtype=bool)
        start = pose[log.controlled]
        return jax.vmap(lambda p: nearest_lane(log.road, p))(start), start, jnp.min(jnp.where(two, gap, jnp.inf))

    lanes, start, gap = jax.jit(jax.vmap(lambda key: room(scene.log(key))))(random.split(random.key(0), 256))
    assert np.min(gap) > 1.0 and all(len(set(row)) == scene.agents for row in lanes.tolist())
    assert np.std(start, axis=0)[:, :2].max(axis=1).min() > 1  # each starts in different places


def test_each_car_sees_the_others_after_the_road_users():
    scene = Intersection(road_users=2, controlled=3)

    @jax.jit
    def look(log):
        episode = scene.episode(log)
        return tuple(f(episode, jnp.array(0), episode.start) for f in (scene.observe, scene.reward))

    seen, reward = look(on_a_road([[20.0, 0.0, 0.0], [32.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [5.0, 6.0, 7.0]))
    users = seen[:, -4 * 14 :].reshape(3, 4, 14)
    assert np.all(users[:, :2] == 0) and np.all(users[:, 2:, 0] == 1)
    assert np.allclose(users[0, 2:, 1], [12.0, -20.0]) and np.allclose(users[1, 2:, 1], [-12.0, -32.0])
    assert np.allclose(users[2, 2:, 5], [5.0, 6.0]) and np.allclose(users[0, 2, 7:9], CAR)
    assert np.allclose(reward, [5.0, 6.0, 7.0])


def test_rows_are_agents_and_go_back():
    scene = Intersection(controlled=3)
    rows = jnp.arange(12.0).reshape(6, 2)
    assert parted(scene, rows).shape == (2, 3, 2) and np.array_equal(merged(scene, parted(scene, rows)), rows)
    alone = Intersection()
    assert parted(alone, rows) is rows and merged(alone, rows) is rows and alone.apart(rows) is rows and alone.views(rows) is rows


def settings(folder, **changes):
    base = Config(
        scene=Intersection(steps=5, road_users=2, controlled=2), method="rtc_c", updates=2, batch=4, run=folder, model=SMALL,
        optimiser=OptimiserOptions(gradient="dynamics_only"), experts=Experts(train=16, test=4), every=Intervals(log=1, test=2, save=1),
    )  # fmt: skip
    return dataclasses.replace(base, **changes)


def test_a_training_of_two_cars_goes_on_to_the_same_numbers_and_is_tested_and_filmed(tmp_path):
    held = settings(tmp_path / "run")
    run, scene = Run.create(held), held.scene
    expert = dataset.demonstrations(scene, held.experts.train, dataset.TRAIN)
    learner, data = held.learner(dataset.statistics(scene, expert)), dataset.without_truth(expert)
    chunk = compiled_chunk(learner, 1)
    once, told = chunk(start_all(learner, held.all_seeds), data)
    assert all(np.all(np.isfinite(x)) for x in told.values()) and told["trajectories_dropped"] == 0
    run.save(1, once, 0.0)
    twice, _ = chunk(once, data)
    _, restored, _ = run.restore(start_shapes(learner, held.all_seeds))
    again, _ = chunk(restored, data)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(twice), jax.tree.leaves(again), strict=True))
    test = jax.tree.map(lambda x: x[:4], data)
    features = evaluate.roller(learner, 3)(twice.networks, test, {}, random.key(0))
    assert features["prior"]["ade"].shape == (1, 3, 4, 2)
    theirs = {name: x[None] for name, x in reference.expert_features(scene, test).items()}
    scores = evaluate.score(held, features, theirs)["prior"]
    assert 0 < scores["min_ade"][0] < np.mean(features["prior"]["ade"]) and 0 <= scores["collision_rate"][0] <= 1
    tracks = jax.tree.map(lambda x: np.asarray(x)[:1, None], expert.trajectory)
    first, *_, last = render.pictures(run, expert, tracks, "car0/top", (64, 64))
    assert last.shape == (64, 2 * 64, 3) and np.any(first != last)
    assert len({render.colour(actor, agent, 2) for actor in (1, 2) for agent in (0, 1)}) == 4


@pytest.mark.parametrize("method", ["symphony", "info_mgail_c", "gail", "bc"])
def test_every_kind_of_method_takes_several_agents(method):
    """Traced, not run: shapes fit, and every agent has a type."""
    held = settings(None, method=method)
    keys = random.split(random.key(0), held.batch)
    expert = jax.eval_shape(jax.vmap(lambda key: dataset.driven(held.scene, held.scene.reset(key), key)), keys)
    features = expert.trajectory.observations.shape[-1]
    zeros, ones = jnp.zeros(features), jnp.ones(features)
    learner = held.learner(dataset.Statistics(zeros, ones, jnp.zeros(2), jnp.ones(2)))
    state = jax.eval_shape(lambda: start(learner, jnp.array(0)))
    changed, report = jax.eval_shape(lambda n, b: gradients(learner, n, b, random.key(0), jnp.array(0)), state.networks, expert)
    assert jax.tree.structure(changed) == jax.tree.structure(state.networks) and all(x.shape == () for x in report.values())
    assert METHODS[method].branches[0].closed_loop is (method != "bc" and method != "info_mgail_c")


def test_several_experts_arrive_without_accident():
    """As one expert does; they take the routes that they have in mind, each its own, and Symphony's labels say so."""
    scene = Intersection(road_users=2, controlled=2)
    held = dataset.demonstrations(scene, 256, 5)
    features = reference.expert_features(scene, held)
    assert features["collision"].shape == (256, 2)
    assert np.mean(features["collision"]) <= 0.02 and np.mean(features["offroad"]) < 0.01 and np.mean(features["ran_red"]) < 0.02
    assert np.all(np.mean(features["progress"], axis=0) > 15)
    rows = merged(scene, jax.vmap(scene.views)(held))
    label = np.asarray(jax.jit(jax.vmap(scene.label))(rows))
    assert np.mean(np.take_along_axis(label, np.asarray(rows.truth["route"])[:, None], 1) > 0) > 0.97
    assert 0.2 < np.mean(held.truth["route"][:, 0] == held.truth["route"][:, 1]) < 0.5  # minds of their own


def test_min_ade_is_each_agents_own_best_sample():
    scene = Intersection(controlled=2)
    expert = {name: np.zeros((2, 2)) for name in ("collision", "overlap", "offroad", "ade", "progress", "turned", "ran_red")}
    expert |= {"curvature": np.zeros((2, 2, 3)), "branching": np.zeros((2, 2, 3), bool), "may_leave_road": np.ones((2, 2), bool)}
    one = {name: x[None] for name, x in expert.items()}
    two = {name: np.stack([x, x]) for name, x in expert.items()} | {"ade": np.array([[[1.0, 4.0], [2.0, 3.0]], [[3.0, 2.0], [1.0, 5.0]]])}
    assert scene.metrics(two, expert)["min_ade"] == pytest.approx((1 + 2 + 1 + 3) / 4) and scene.metrics(one, one)["min_ade"] == 0


@pytest.mark.parametrize(
    ("scene", "cars", "why"),
    [
        ("intersection", 0, "from 1 to 4"),
        ("intersection", 99, "from 1 to 4"),
        ("roundabout", 5, "from 1 to 4"),
        ("merge", 2, "one car is driven"),
        ("womd", 2, "one car is driven, everybody else is replayed"),
    ],
)
def test_numbers_of_cars_without_room_are_refused(scene, cars, why):
    with pytest.raises(UsageError, match=rf"--scene\.controlled {cars}.*{scene} {why}") as told:
        config.from_command_line(["--scene", scene, "--scene.controlled", str(cars), "--method", "bc"], "train")
    assert "\n" not in str(told.value)


def test_an_environment_of_two_cars_has_an_axis_of_agents():
    environment = Environment(Intersection(steps=3, road_users=2, controlled=2), seed=1)
    first = environment.reset()
    assert first.observation.shape == environment.observation_spec().shape and environment.action_spec().shape == (2, 2)
    steps = [environment.step(np.full((2, 2), 0.1)) for _ in range(3)]
    assert steps[-1].last() and steps[-1].reward.shape == environment.reward_spec().shape == (2,)
    environment.reset()
    with pytest.raises(UsageError, match=r"shape \(4,\)"):
        environment.step(np.zeros(4))
