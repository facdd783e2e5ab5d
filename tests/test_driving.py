"""Laws of every generated driving scene, of the road graph and the routes found in it, and of driving's metrics."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax import random
from made import demonstrated, made

from rtc_mjx import dataset
from rtc_mjx.errors import UsageError
from rtc_mjx.geometry import project
from rtc_mjx.logs import AMBER, GREEN, NO_SIGNAL, RED, VEHICLE, LoggedScene, RoadGraph, checked
from rtc_mjx.physics import PhysicsState, specialised_step, substates
from rtc_mjx.rollout import rollout
from rtc_mjx.scenes import SCENES, Actor, split_items
from rtc_mjx.scenes.conduct import crossings, ran_red
from rtc_mjx.scenes.driving import AWAY, CAR, nearest_users
from rtc_mjx.scenes.generated import Generated
from rtc_mjx.scenes.intersection import cycle
from rtc_mjx.scenes.routes import BEHIND, NOWHERE, SPACING, RouteOptions, find_routes
from rtc_mjx.scenes.sight import CLEAR, FINE, OWN, SOON, Others, near_miss, see_itself, see_routes, see_users, taken
from rtc_mjx.scenes.traffic import Drivers, Walkers, drive, follow_the_leader, must_stop, slow_for_bends, walk
from rtc_mjx.trajectory import Demonstration, Trajectory

GENERATED = tuple(name for name, scene in SCENES.items() if issubclass(scene, Generated))


@pytest.fixture(params=(*GENERATED, "womd"))
def driving(request):
    """Every driving scene: generated ones, and that of recordings."""
    return made(request.param)


@pytest.fixture(params=GENERATED)
def scene(request):
    return made(request.param)


def straight_road(count=1, users=3, times=91):
    """A lane of 100 m along x that goes on in `count` lanes, with no users but the agent at 20 m and what tests put there."""
    first = jnp.stack([jnp.linspace(0, 100, 24), jnp.zeros(24)], axis=1)
    ways = [jnp.stack([jnp.linspace(100, 200, 24), k * jnp.linspace(0, 30, 24)], axis=1) for k in range(count)]
    graph = RoadGraph(
        lanes=jnp.stack([first, *ways]),
        successors=jnp.full((count + 1, max(1, count)), -1).at[0, :count].set(jnp.arange(1, count + 1)),
        gives_way=jnp.zeros(count + 1, int), edges=jnp.array([[[-50.0, -2.0], [300.0, -2.0]]]), edge_valid=jnp.ones(1, bool),
        crosswalks=jnp.zeros((1, 4, 2)),
    )  # fmt: skip
    pose = jnp.zeros((users, times, 3)).at[0, :, 0].set(20.0)
    return LoggedScene(
        road=graph, signals=jnp.zeros((times, count + 1), int), pose=pose, velocity=jnp.zeros((users, times, 2)),
        size=jnp.full((users, 2), 2.0).at[:, 0].set(4.0), kind=jnp.zeros(users, int).at[0].set(VEHICLE),
        valid=jnp.zeros((users, times), bool).at[0].set(True), controlled=jnp.array(0),
    )  # fmt: skip


@jax.jit
def coast(episode):
    """The intersection's agent with its hands off."""
    scene = made("intersection")
    return rollout(scene, Actor((), lambda m, o, a: (m, a), jnp.zeros((scene.steps, 2))), episode)


@pytest.mark.parametrize(
    ("off", "loss"),
    [((0.0, 0.0, 0.0), 0.0), ((0.6, 0.0, 0.0), 0.18), ((0.0, -3.0, 0.0), 2.5), ((0.0, 0.0, np.pi), np.hypot(*CAR) - 0.5)],
)
def test_reconstruction_is_the_huber_distance_of_the_corners(off, loss):
    """Of a car that is off by so much from the first step on; where it starts does not count."""
    still = jnp.tile(jnp.array([5.0, 2.0, 0.3, 0.0]), (6, 1))
    moved = still.at[1:, :3].add(jnp.array(off))
    expert, agent = (SimpleNamespace(states=SimpleNamespace(qpos=q)) for q in (still, moved.at[0].add(100.0)))
    found = made("intersection").discrepancy(SimpleNamespace(trajectory=expert), agent)
    assert found == pytest.approx(loss, abs=1e-5)


def around(place, velocity, present=True):
    return Others(
        pose=jnp.array([[*place, 0.0]]), size=jnp.array([[4.0, 2.0]]), velocity=jnp.array([velocity], float), yaw_rate=jnp.zeros(1),
        kind=jnp.array([VEHICLE]), present=jnp.array([present]),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("place", "velocity", "present", "when"),
    [
        ((20.0, 10.0), (0.0, -5.0), True, 2.0),  # crosses there in two seconds
        ((20.0, 10.0), (0.0, 5.0), True, SOON),  # drives away
        ((20.0, 10.0), (0.0, -5.0), False, SOON),
        ((20.5, 0.0), (0.0, 0.0), True, 0.0),  # stands there
        ((24.0, 10.0), (0.0, -5.0), True, 3.5),  # passes at 4 m, 1.5 m more than counts
        ((20.0, 40.0), (0.0, -5.0), True, SOON),  # is too far away
    ],
)
def test_a_point_of_a_route_is_taken_from_when_somebody_will_be_there(place, velocity, present, when):
    found = taken(jnp.array([[20.0, 0.0], [200.0, 0.0]]), around(place, velocity, present))
    assert np.allclose(found, [when, SOON], atol=0.02)
    slope = jax.grad(lambda x: taken(jnp.array([[20.0, 0.0]]) + x, around(place, velocity, present))[0])(jnp.zeros(2))
    assert np.all(np.isfinite(slope))


@pytest.mark.parametrize(
    ("pose", "right", "left"),
    [
        ((20.0, 0.0, 0.0), 2.0 - CAR[1] / 2, 2.0 + CAR[1] / 2),  # along the edge at y = -2
        ((20.0, -2.0, 0.0), -CAR[1] / 2, CAR[1] / 2),  # half of it past the edge
        ((20.0, 0.0, np.pi), 2.0 + CAR[1] / 2, 2.0 - CAR[1] / 2),  # the other way round: the edge is to its left
        ((20.0, 9.0, 0.0), CLEAR, CLEAR),
    ],
)
def test_room_to_the_edge(pose, right, left):
    """Corners in the order front left, front right, rear right, rear left."""
    road, alone = straight_road().road, jnp.zeros((1, 14))
    told = see_itself(jnp.array([*pose, 0.0]), jnp.zeros(4), road, alone)
    assert told.shape == (OWN,)
    assert np.allclose(told[4:8], np.minimum([left, right, right, left], CLEAR), atol=1e-5)
    open_land = dataclasses.replace(road, edge_valid=jnp.zeros(1, bool))
    assert np.allclose(see_itself(jnp.array([*pose, 0.0]), jnp.zeros(4), open_land, alone)[4:8], CLEAR)


@pytest.mark.parametrize(
    ("place", "gap"), [((8.0, 0.0), 8.0 - 0.5 * (CAR[0] + 4.0)), ((4.0, 0.0), 4.0 - 0.5 * (CAR[0] + 4.0)), ((50.0, 0.0), 99.0)]
)
def test_room_to_the_nearest_of_those_around(place, gap):
    pose, still = jnp.zeros(3), jnp.zeros(2)
    users = see_users(around(place, (0.0, 0.0)), pose, still)
    told = see_itself(jnp.zeros(4), jnp.zeros(4), straight_road().road, users)
    assert told[8] == pytest.approx(FINE * np.tanh(gap / FINE), abs=1e-4)
    nobody = see_users(around(place, (0.0, 0.0), present=False), pose, still)
    assert see_itself(jnp.zeros(4), jnp.zeros(4), straight_road().road, nobody)[8] == pytest.approx(FINE, abs=1e-4)


@pytest.mark.parametrize(
    ("speed", "when", "margin", "at"),
    [
        (5.0, {}, SOON, SOON),  # nobody comes near
        (5.0, {4: 2.2}, 1.0, 3.2),  # somebody is at 16 m a second before the car
        (5.0, {4: 4.2}, 1.0, 3.2),  # or a second after it
        (5.0, {2: 1.1, 4: 4.2}, 0.5, 1.6),  # the narrower of two
        (0.0, {0: 0.5}, 3.5, 4.0),  # who stands is taken to crawl
        (0.0, {4: 0.5}, SOON, SOON),  # but not that far
        (50.0, {9: 1.0}, 0.0, 1.0),
    ],
)
def test_how_narrowly_somebody_is_missed_and_when(speed, when, margin, at):
    taken_from = jnp.full(10, SOON).at[jnp.array(list(when), int)].set(jnp.array(list(when.values())))
    assert np.allclose(near_miss(jnp.array(speed), taken_from), [margin, at], atol=1e-5)
    slope = jax.jacrev(near_miss, argnums=(0, 1))(jnp.array(speed), taken_from)
    assert all(np.all(np.isfinite(x)) for x in slope)


def test_a_route_tells_of_its_lines_finely_and_of_near_misses():
    """A car at 20 m and 5 m/s; its stop line 10 m ahead, the give-way line 4 m, and somebody who crosses at 16 m in 4.2 s."""
    scene, log = made("intersection"), straight_road()
    routes = scene.episode(log).context.routes
    station = project(routes.paths[0], SPACING, jnp.array([20.0, 0.0]))[0]
    routes = dataclasses.replace(routes, stop=routes.stop.at[0].set(station + 10.0), give_way=routes.give_way.at[0].set(station + 4.0))
    signals, who = routes.signals[0], around((36.0, -21.0), (0.0, 5.0))
    told = see_routes(routes, signals, jnp.array([20.0, 0.0, 0.0]), jnp.array(5.0), who)[0]
    nose = CAR[0] / 2
    assert np.allclose(told[-4:], [FINE * np.tanh((10 - nose) / FINE), FINE * np.tanh((4 - nose) / FINE), 1.0, 3.2], atol=0.03)


# Every driving scene


def test_the_world_has_its_named_parts_and_two_cameras(driving):
    names = [driving.world.mj.camera(i).name for i in range(driving.world.mj.ncam)]
    assert {"car0/top", "car0/chase"} <= set(names)
    assert driving.world.control_names == ("car0/drive", "car0/steer")
    assert len(driving.world.users) == driving.road_users


def test_experts_arrive_without_accident(scene):
    """Rates like those of the paper's data: collisions below 1.5 %, off the road below 1 % of the time."""
    held, features = demonstrated(scene.name)
    assert np.mean(features["collision"]) < 0.015
    assert np.mean(features["offroad"]) < 0.01
    assert np.mean(features["ran_red"]) < 0.02
    assert np.mean(features["progress"]) > 15 and np.max(features["progress"]) > 50


def test_experts_take_the_route_they_have_in_mind(scene):
    held, _ = demonstrated(scene.name)
    label = jax.vmap(scene.label)(held)
    assert np.allclose(np.sum(label, axis=1), 1)
    assert np.mean(np.take_along_axis(np.asarray(label), held.truth["route"][:, None], 1) > 0) > 0.97
    kinds, count = np.unique(np.round(label, 2), axis=0, return_counts=True)
    assert np.sum(count > 0.05 * len(label)) > 1  # in 9 s not all routes part, but some do


def test_surroundings_do_not_depend_on_the_expert(scene):
    """xi is drawn without the expert: two experts of one episode meet the same surroundings and drive differently."""
    episode = scene.reset(random.key(3))

    def one(key):
        actor, truth = scene.expert(key, episode)
        return rollout(scene, actor, episode).states.qpos[-1], truth["speed"]

    ends, speeds = jax.jit(jax.vmap(one))(random.split(random.key(1), 16))
    assert np.std(speeds) > 0.3 and np.std(ends[:, :2], axis=0).max() > 0.05


def test_road_users_that_are_not_there_are_far_away_and_unseen(driving):
    held, _ = demonstrated(driving.name)
    gone = ~held.episode.context.present
    assert np.all(np.abs(held.episode.surroundings.pose[gone][:, :2]).max(axis=1) >= AWAY)
    _, (_, users) = split_items(driving.sets, OWN, held.trajectory.observations)
    assert np.all(users[gone] == 0)


def test_observations_do_not_depend_on_where_and_which_way_the_world_lies(scene):
    """The same scene turned and moved looks the same from the car."""
    log = scene.log(random.key(2))
    turn, shift = 0.7, jnp.array([30.0, -12.0])

    def points(x):
        cos, sin = jnp.cos(turn), jnp.sin(turn)
        return jnp.stack([cos * x[..., 0] - sin * x[..., 1], sin * x[..., 0] + cos * x[..., 1]], axis=-1)

    road = dataclasses.replace(log.road, lanes=points(log.road.lanes) + shift, edges=points(log.road.edges) + shift)
    pose = jnp.concatenate([points(log.pose[..., :2]) + shift, log.pose[..., 2:] + turn], axis=-1)
    moved = dataclasses.replace(log, road=road, pose=pose, velocity=points(log.velocity))
    here, there = scene.episode(log), scene.episode(moved)
    seen = [scene.observe(e, jnp.array(0), e.start) for e in (here, there)]
    assert np.allclose(*seen, atol=2e-2)


def test_gradients_are_finite_and_right_through_a_collision(driving, x64):
    """The car runs into somebody who stands ahead: dx_T / da_t against central differences."""
    episode = jax.tree.map(lambda x: jnp.asarray(x[0], float if x.dtype.kind == "f" else None), demonstrated(driving.name)[0].episode)
    heading = episode.start.qpos[2]
    ahead = episode.start.qpos[:2] + 12 * jnp.stack([jnp.cos(heading), jnp.sin(heading)]) + jnp.array([0.3, 0.2])
    pose = episode.surroundings.pose.at[:, 0].set(jnp.concatenate([ahead, heading[None] + 0.3]))
    size = episode.surroundings.size.at[:, 0].set(jnp.array([4.5, 1.9]))
    episode = dataclasses.replace(episode, surroundings=type(episode.surroundings)(pose, size))
    actions = jnp.tile(jnp.array([3.0, 0.01]), (driving.steps, 1))

    @jax.jit
    def states(actions):
        return rollout(driving, Actor((), lambda m, o, a: (m, a), actions), episode).states.qpos

    def end(actions):
        return jnp.sum(states(actions)[20, :2])

    gap = jax.vmap(lambda q: jnp.min(scene_gap(q, episode)))(states(actions))
    assert np.min(gap) < 0.05  # they did touch
    slope = jax.jit(jax.grad(end))(actions)
    assert np.all(np.isfinite(slope))
    for step, control in ((0, 0), (0, 1), (4, 1)):
        nudge = jnp.zeros_like(actions).at[step, control].set(1e-7)  # what a touch leads to bends within 1e-5
        difference = (end(actions + nudge) - end(actions - nudge)) / 2e-7
        assert np.isclose(slope[step, control], difference, rtol=1e-4, atol=1e-6)


def scene_gap(qpos, episode):
    from rtc_mjx.geometry import capsule_gap

    return capsule_gap(qpos[:3], jnp.array(CAR), episode.surroundings.pose[0], episode.surroundings.size[0])


def test_a_dressed_world_compiles_and_shows_signals(scene):
    episode = jax.tree.map(np.asarray, scene.reset(random.key(1)))
    spec = scene.world.spec.copy()
    scene.dress(spec, episode)
    model = spec.compile()
    scene.paint(model, episode, 0)
    assert model.ngeom > scene.world.mj.ngeom + 40
    assert sum(model.geom(i).name.startswith("signal") for i in range(model.ngeom)) == (12 if scene.name == "intersection" else 0)
    mujoco.mj_forward(model, mujoco.MjData(model))


# Routes


def test_routes_of_the_intersection_lead_left_on_and_right():
    log = made("intersection").log(random.key(0))
    routes = find_routes(log, log.pose[0, 0], RouteOptions())
    assert np.all(routes.valid) and routes.dropped == 0
    way = routes.paths[:, 60] - routes.paths[:, 59]
    assert np.array_equal(np.round(way / 2), [[-1, 0], [0, 1], [1, 0]])
    assert np.allclose(routes.stop, routes.stop[0]) and BEHIND < routes.stop[0] < 70
    assert np.array_equal(routes.gives_way_to, [1, 0, 0])
    assert np.allclose(np.linalg.norm(np.diff(routes.paths, axis=1), axis=-1), 2.0, atol=0.05)
    start = log.pose[0, 0, :2]
    assert np.min(np.linalg.norm(routes.paths[:, 5] - start, axis=1)) < 0.6  # the sixth point is beside the car


def test_a_road_that_ends_goes_straight_on_and_has_no_lines():
    log = straight_road(count=0)
    routes = find_routes(log, log.pose[0, 0], RouteOptions(count=2))
    assert list(routes.valid) == [True, False] and routes.stop[0] == NOWHERE and np.all(routes.signals == NO_SIGNAL)
    assert np.allclose(routes.paths[0, :, 0], 10 + 2.0 * np.arange(80), atol=1e-3) and routes.end[0] == pytest.approx(90.0)


def test_routes_beyond_those_that_fit_are_counted():
    log = straight_road(count=5)
    routes = find_routes(log, log.pose[0, 0], RouteOptions(count=3))
    assert np.all(routes.valid) and routes.dropped == 2
    assert np.array_equal(routes.lanes[:, 1], [1, 2, 3])
    assert not routes.branching[0, 20] and routes.branching[0, 60]  # lanes branch after 100 m


# The logged scene becomes an episode


def crowded(distances):
    """A road with users at distances ahead of the agent."""
    log = straight_road(users=len(distances) + 1)
    pose = log.pose.at[1:, :, 0].set(20.0 + jnp.array(distances)[:, None])
    return dataclasses.replace(log, pose=pose, kind=jnp.full(len(distances) + 1, VEHICLE), valid=jnp.ones_like(log.valid))


def test_the_nearest_road_users_are_kept_and_the_others_counted():
    kept, dropped = nearest_users(crowded([50.0, 10.0, 30.0, 20.0, 40.0]), 3)
    assert list(kept) == [2, 4, 3] and dropped == 2
    assert made("intersection").episode(crowded([float(10 + 7 * i) for i in range(11)])).context.dropped == 3


def test_the_agent_is_not_among_its_own_surroundings():
    episode = made("intersection").episode(straight_road())
    assert not np.any(episode.context.present)


def test_a_road_user_that_overlaps_the_agent_at_first_does_not_count_as_its_collision():
    scene = made("intersection")
    episode = scene.episode(crowded([2.0, 30.0]))
    track = coast(episode)
    assert list(episode.context.ghosts[:2]) == [True, False]
    assert not scene.features(Demonstration(episode, track, ()), track)["collision"]


def test_boxes_that_overlap_at_first_are_masked_apart_from_bodies_that_touch():
    """At 3.9 m ahead and 1.9 m aside boxes of 4 by 2 m meet at a corner; the round ends of their capsules do not."""
    scene, log = made("intersection"), crowded([4.2])
    log = dataclasses.replace(log, pose=log.pose.at[1, :, 1].set(1.9))
    episode = scene.episode(log)
    track = jax.tree.map(lambda x: x, coast(episode))
    features = scene.features(Demonstration(episode, track, ()), track)
    assert bool(episode.context.overlapped[0]) and not bool(episode.context.ghosts[0])
    assert not features["overlap"] and not features["collision"]


def as_numpy(log, **changes):
    return dataclasses.replace(jax.tree.map(np.array, log), **changes)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"controlled": 7}, "agent 7 is not among its 3"),
        ({"valid": np.zeros((3, 91), bool)}, "not there at t = 0"),
        ({"pose": np.full((3, 91, 3), np.nan)}, "not finite at t = 0"),
        ({"size": np.zeros((3, 2))}, r"box of \[0.0, 0.0\] m"),
        ({"road": "no lanes"}, "no lanes"),
        ({"road": "infinite"}, "NaN or infinity"),
    ],
)
def test_a_scene_of_which_nothing_can_be_made_is_refused(changes, why):
    log = as_numpy(straight_road())
    road = log.road
    if changes.get("road") == "no lanes":
        changes = {"road": dataclasses.replace(road, lanes=np.zeros_like(road.lanes))}
    elif changes.get("road") == "infinite":
        changes = {"road": dataclasses.replace(road, edges=np.full_like(road.edges, np.inf))}
    with pytest.raises(UsageError, match=f"scene odd: .*{why}"):
        checked(dataclasses.replace(log, **changes), "odd")


def test_what_can_be_repaired_is_repaired_and_counted():
    log = as_numpy(crowded([10.0, 20.0, 30.0]))
    log.pose[2, 5:9, 0], log.size[3] = np.nan, 0.0
    repaired, counts = checked(log, "odd")
    assert list(counts.values()) == [4, 1]
    assert np.all(np.isfinite(repaired.pose)) and not np.any(repaired.valid[2, 5:9]) and np.all(repaired.valid[2, 9:])
    assert repaired.kind[3] == 0 and not np.any(repaired.valid[3])
    episode = made("intersection").episode(jax.tree.map(jnp.asarray, repaired))
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(episode) if x.dtype == jnp.float32)
    assert checked(as_numpy(straight_road()), "sound")[1] == {}


def test_what_metrics_leave_out_is_told():
    scene = made("intersection")
    episodes = jax.tree.map(lambda *x: np.stack(x), *(scene.episode(log) for log in (crowded([2.0, 30.0]), crowded([30.0, 60.0]))))
    notes = scene.notes(episodes)
    assert notes["agents that touch somebody at t = 0 (not counted as collisions)"] == 1 and notes["road users without a body"] == 0


def test_an_agent_that_the_log_has_off_the_road_is_masked():
    scene, log = made("intersection"), straight_road()
    off = dataclasses.replace(log, pose=log.pose.at[0, :, 1].set(-6.0))
    assert scene.episode(off).context.starts_off_road and not scene.episode(log).context.starts_off_road

    still = coast(scene.episode(log))
    features = [scene.features(Demonstration(scene.episode(one), still, ()), still) for one in (log, off)]
    assert [bool(f["may_leave_road"]) for f in features] == [True, False]


# Metrics by hand


def by_hand(**given):
    """Features of a sample of four agents who did nothing, but for what is given."""
    nothing = {name: np.zeros((1, 4)) for name in ("collision", "overlap", "offroad", "ade", "progress", "turned", "ran_red")}
    nothing |= {"may_leave_road": np.ones((1, 4), bool), "curvature": np.zeros((1, 4, 3)), "branching": np.zeros((1, 4, 3), bool)}
    return nothing | {name: np.array(x)[None] for name, x in given.items()}


def test_who_starts_off_the_road_is_not_among_those_whose_time_off_it_counts():
    held = by_hand(offroad=[0.5, 0.0, 1.0, 0.0], may_leave_road=[True, True, False, True])
    assert made("intersection").metrics(held, held)["offroad_time"] == pytest.approx(0.5 / 3)


def test_divergences_of_progress_and_of_curvature_where_lanes_branch():
    """Half of the agents go where no expert goes: p = (1, 0), q = (1/2, 1/2), whose divergence is 0.311 bit; and none: 1 bit."""
    there = by_hand(progress=[0.0, 10.0, 0.0, 10.0], curvature=[[0.0, 0.1, 9.0]] * 4, branching=[[True, True, False]] * 4)
    near = by_hand(progress=[0.0, 0.0, 0.0, 0.0], curvature=[[0.1, 0.1, 0.0]] * 4, branching=[[True, True, False]] * 4)
    expected = 0.5 * (np.log2(1 / 0.75) + 0.5 * np.log2(0.5 / 0.75) + 0.5 * np.log2(0.5 / 0.25))
    found = made("intersection").metrics(near, there)
    assert found["progress_jsd"] == pytest.approx(expected) and found["curvature_jsd"] == pytest.approx(expected)
    assert made("intersection").metrics(by_hand(progress=[5.0] * 4), there)["progress_jsd"] == pytest.approx(1)


def test_divergence_of_manoeuvres_is_that_of_left_right_and_neither():
    """Experts turn left, right, and twice not at all; who never turns diverges from p = (1/4, 1/2, 1/4) by q = (0, 1, 0)."""
    there, never = by_hand(turned=[1.5, -1.5, 0.1, -0.2]), by_hand(turned=[0.2, -0.3, 0.0, 0.34])
    expected = 0.5 * (2 * 0.25 * np.log2(0.25 / 0.125) + 0.5 * np.log2(0.5 / 0.75) + np.log2(1 / 0.75))
    metrics = made("intersection").metrics
    assert metrics(never, there)["manoeuvre_jsd"] == pytest.approx(expected)
    assert metrics(by_hand(turned=[0.4, -3.0, 0.0, 0.0]), there)["manoeuvre_jsd"] == 0.0


def test_a_lane_branches_off_where_another_goes_on_from_the_same_lane():
    """Also for who starts on it; curvature is a mean over neighbouring points, so that a corner of a line does not count for all."""
    log = straight_road(count=2)
    beyond = dataclasses.replace(log, pose=log.pose.at[0, :, 0].set(130.0))
    routes = find_routes(beyond, beyond.pose[0, 0], RouteOptions())
    assert routes.valid[0] and np.all(routes.branching[0, :20])
    alone = straight_road(count=1)
    assert not np.any(find_routes(alone, beyond.pose[0, 0], RouteOptions()).branching)
    corner = find_routes(log, log.pose[0, 0], RouteOptions())
    turn = np.arctan2(30.0, 100.0)
    assert np.sum(corner.curvature[1]) * 2.0 == pytest.approx(turn, rel=0.01) and np.max(corner.curvature[1]) < 0.4 * turn / 2.0


def played(scene, episode, positions):
    """A trajectory through given (x, y, heading), observations left out."""
    qpos = jnp.zeros((scene.steps + 1, 4)).at[:, :3].set(positions)
    warm = jnp.broadcast_to(episode.start.warmstart, (scene.steps + 1, *episode.start.warmstart.shape))
    return Trajectory(PhysicsState(qpos, jnp.zeros_like(qpos), warm), jnp.zeros((scene.steps + 1, 1)), jnp.zeros((scene.steps, 2)))


def line(scene, start, end):
    share = jnp.linspace(0, 1, scene.steps + 1)[:, None]
    return jnp.concatenate([jnp.array(start) + share * (jnp.array(end) - jnp.array(start)), jnp.zeros((scene.steps + 1, 1))], axis=1)


def test_features_of_a_trajectory_worked_out_by_hand():
    """The expert stands still; the agent glides 30 m along x and drifts 1.2 m to the right, past the edge at y = -2 with its corners."""
    scene = made("intersection")
    episode = scene.episode(straight_road())
    expert = Demonstration(episode, played(scene, episode, line(scene, [20.0, 0.0], [20.0, 0.0])), ())
    features = scene.features(expert, played(scene, episode, line(scene, [20.0, 0.0], [50.0, -1.2])))
    assert features["ade"] == pytest.approx(np.hypot(30, 1.2) / 2, rel=1e-4)
    assert features["progress"] == pytest.approx(np.hypot(30, 1.2), rel=1e-4)
    beyond = np.mean(np.linspace(0, 1.2, 31) > 2 - 1.9 / 2)
    assert features["offroad"] == pytest.approx(beyond) and not features["collision"]


def test_collisions_between_control_steps_are_seen():
    """A crossing car passes through the agent's place within one control step: no logged time shows them together."""
    scene, log = made("intersection"), crowded([0.0])
    times = jnp.arange(91)
    pose = log.pose.at[1].set(jnp.stack([jnp.full(91, 20.0), 6.0 - 12.0 * (times >= 45) - 0.0 * times, jnp.full(91, np.pi / 2)], axis=1))
    episode = scene.episode(dataclasses.replace(log, pose=pose))
    assert np.all(np.abs(episode.surroundings.pose[:, 0, 1]) == 6.0)
    still = coast(episode)
    features = scene.features(Demonstration(episode, still, ()), still)
    assert features["collision"] and features["overlap"]


def test_min_ade_is_the_best_of_the_samples():
    scene = made("intersection")
    _, features = demonstrated("intersection")
    expert = {k: v[:4] for k, v in features.items()}
    two = {k: np.stack([v, v]) for k, v in expert.items()} | {"ade": np.array([[1.0, 2.0, 3.0, 4.0], [3.0, 1.0, 3.0, 2.0]])}
    assert scene.metrics(two, expert)["min_ade"] == pytest.approx((1 + 1 + 3 + 2) / 4)


def test_running_a_red_light_is_crossing_its_line_while_it_is_red():
    log = straight_road(count=1)
    for state, expected in ((RED, True), (AMBER, False), (GREEN, False), (NO_SIGNAL, False)):
        signals = jnp.zeros((91, 2), int).at[:, 1].set(state)
        episode = made("intersection").episode(dataclasses.replace(log, signals=signals))
        qpos = played(made("intersection"), episode, line(made("intersection"), [70.0, 0.0], [130.0, 0.0])).states.qpos
        assert bool(ran_red(episode.context.routes, crossings(episode.context.routes, qpos))) is expected
        before = played(made("intersection"), episode, line(made("intersection"), [20.0, 0.0], [97.0, 0.0])).states.qpos
        assert not ran_red(episode.context.routes, crossings(episode.context.routes, before))


def test_a_red_arrow_beside_a_green_light_stops_only_who_follows_it():
    """Two ways share the path up to their stop lines: the car crosses both at once, and may, if one of them is open."""
    log = straight_road(count=2)
    for states, expected in (((RED, GREEN), False), ((GREEN, RED), False), ((RED, RED), True), ((RED, AMBER), False)):
        signals = jnp.zeros((91, 3), int).at[:, 1:].set(jnp.array(states))
        episode = made("intersection").episode(dataclasses.replace(log, signals=signals))
        qpos = played(made("intersection"), episode, line(made("intersection"), [70.0, 0.0], [130.0, 0.0])).states.qpos
        assert bool(ran_red(episode.context.routes, crossings(episode.context.routes, qpos))) is expected


def test_flipped_signals_are_met_by_the_same_experts_with_the_same_minds(tmp_path, monkeypatch):
    """Red is green and green is red; experts who look at the light react, and one who drives again without a change does the same."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    scene = made("intersection")
    held = dataset.demonstrations(scene, 32, 9)
    again = dataset.redriven(scene, 32, 9, lambda episode: episode)
    assert np.allclose(again.trajectory.states.qpos, held.trajectory.states.qpos, atol=1e-3)
    flipped = dataset.redriven(scene, 32, 9, scene.flipped)
    before, after = held.episode.context.signals, np.asarray(flipped.episode.context.signals)
    assert np.array_equal(after == GREEN, before == RED) and np.array_equal(after == NO_SIGNAL, before == NO_SIGNAL)
    assert np.allclose(flipped.episode.start.qpos, held.episode.start.qpos)
    stopped, went = (np.asarray([one.trajectory.states.qpos[:, -1, 1] for one in (held, flipped)])) > -22
    assert np.mean(stopped != went) > 0.1


# Traffic


def test_signals_follow_green_amber_red_and_are_never_green_both_ways():
    ahead, across = jax.vmap(lambda key: cycle(key, 400))(random.split(random.key(0), 64))
    assert not np.any((ahead != RED) & (across != RED))
    for lights in (np.asarray(ahead), np.asarray(across)):
        changes = {(int(a), int(b)) for row in lights for a, b in zip(row[:-1], row[1:], strict=True) if a != b}
        assert changes == {(GREEN, AMBER), (AMBER, RED), (RED, GREEN)}


def test_a_driver_behind_another_settles_at_its_headway():
    speed, gap = jnp.array(10.0), jnp.array(30.0)
    for _ in range(600):  # 60 s behind somebody at 10 m/s
        pull = follow_the_leader(speed, jnp.array(15.0), gap, speed - 10.0, headway=jnp.array(1.5))
        gap, speed = gap + 0.1 * (10.0 - speed), speed + 0.1 * pull
    rest = (2.0 + 15.0) / np.sqrt(1 - (10 / 15) ** 4)  # Treiber et al. 2000, equilibrium gap
    assert abs(gap - rest) < 0.1 and abs(speed - 10) < 0.01


@pytest.mark.parametrize(
    ("speed", "distance", "signal", "stops"), [(10, 20, RED, True), (10, 20, AMBER, True), (10, 10, AMBER, False), (10, 20, GREEN, False)]
)
def test_who_stops_for_a_signal(speed, distance, signal, stops):
    assert bool(must_stop(jnp.array(float(speed)), jnp.array(float(distance)), jnp.array(signal))) is stops  # 10 m: 5 m/s^2


def test_bends_are_slowed_down_for_in_time():
    bearing = jnp.clip((jnp.arange(40) - 20) * 2.0 / 10.0, 0, 3)
    path = jnp.stack([2.0 * jnp.minimum(jnp.arange(40), 20) + 10 * jnp.sin(bearing), 10 * (1 - jnp.cos(bearing))], axis=1)
    allowed = slow_for_bends(path, 2.0, jnp.array(12.0))
    assert allowed[25] == pytest.approx(np.sqrt(2.5 * 10), rel=0.05) and allowed[0] == pytest.approx(12.0)
    assert np.all(np.diff(allowed[:20] ** 2) > -2 * 2.0 * 2.0 - 1e-3)  # never more than 2 m/s^2 of braking


def test_replayed_drivers_wait_at_red_and_people_walk_at_green():
    path = jnp.stack([2.0 * jnp.arange(60), jnp.zeros(60)], axis=1)
    lights = jnp.where(jnp.arange(200)[:, None] < 120, RED, GREEN) * jnp.ones((1, 1), int)
    one = {name: jnp.array([value]) for name, value in dict(
        station=10.0, speed=8.0, desired=10.0, headway=1.2, length=4.5, until=1e3, stop=60.0, brakes=1e3, brakes_for=0.0
    ).items()}  # fmt: skip
    pose, speed = drive(Drivers(paths=path[None], leader=jnp.array([-1]), signals=lights, **one), 2.0, 200)
    nose = pose[:, 0, 0] + 4.5 / 2
    assert np.max(nose[:120]) < 60 and np.max(speed[110:120]) < 0.3 and nose[-1] > 75
    people = Walkers(jnp.array([[0.0, 0.0]]), jnp.array([[0.0, 7.0]]), jnp.array([1.4]), jnp.array([2.0]), lights == GREEN)
    pose, speed = walk(people, 200)
    assert np.all(pose[:121, 0, 1] == 0) and pose[-1, 0, 1] == pytest.approx(7.0) and np.max(speed) == pytest.approx(1.4)


def test_substates_end_where_the_rollout_goes_on():
    scene = made("intersection")
    held, _ = demonstrated("intersection")
    one = jax.tree.map(lambda x: jnp.asarray(x[0]), dataset.without_truth(held))
    states = jax.tree.map(lambda x: x[3], one.trajectory.states)
    before, after = (jax.tree.map(lambda x, t=t: x[t], one.episode.surroundings) for t in (3, 4))
    step = specialised_step(scene.world)
    inner, around = jax.jit(substates(scene.world, scene.substeps, step))(states, one.trajectory.actions[3], before, after)
    assert np.allclose(inner.qpos[0], states.qpos)
    last = jax.jit(step)(jax.tree.map(lambda x: x[-1], inner), one.trajectory.actions[3], jax.tree.map(lambda x: x[-1], around))
    assert np.allclose(last.qpos, one.trajectory.states.qpos[4], atol=1e-4)
