"""Sim Agents' features, likelihoods and meta-metric against cases worked out by hand."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtc_mjx import geometry, sim_agents
from rtc_mjx.errors import UsageError
from rtc_mjx.logs import GREEN, RED, LoggedScene, RoadGraph
from rtc_mjx.sim_agents import ESTIMATES, LoggedAgents, RoadEdges, StopLines, stop_lines
from rtc_mjx.sim_agents.interactions import nearest_gap, time_to_collision
from rtc_mjx.sim_agents.kinematics import differenced, kinematics
from rtc_mjx.sim_agents.likelihood import Histogram, indicator, likelihood, log_likelihood
from rtc_mjx.sim_agents.roads import distance_to_road_edge, runs_red

TIME = np.arange(30) / 10
HISTORY, FUTURE = 4, 12
CAR = jnp.array([4.0, 2.0, 1.5])
compiled = jax.jit(sim_agents.realism)


def poses(x, y=0.0, z=0.0, heading=0.0):
    return jnp.asarray(np.stack(np.broadcast_arrays(x, y, z, heading), axis=-1), jnp.float32)


# Kinematics ----------------------------------------------------------------------------------------------------------


def test_constant_velocity_has_its_speed_and_no_acceleration():
    """3 m/s forward, 4 m/s sideways and 12 m/s up: 13 m/s in space."""
    found = kinematics(poses(3 * TIME, 4 * TIME, 12 * TIME, 0.5)[None])
    assert np.allclose(found["linear_speed"][0, 1:-1], 13, atol=1e-3)
    for name in ("linear_acceleration", "angular_speed", "angular_acceleration"):
        assert np.allclose(found[name][0, 2:-2], 0, atol=1e-2), name


def test_braking_is_a_negative_acceleration():
    found = kinematics(poses(10 * TIME - 0.5 * 3 * TIME**2)[None])  # the central difference of a parabola is exact
    assert np.allclose(found["linear_acceleration"][0, 2:-2], -3, atol=1e-2)


def test_constant_turn_has_its_rate_across_the_wrap():
    heading = (3.0 + 0.4 * TIME + np.pi) % (2 * np.pi) - np.pi  # passes from pi to -pi
    assert heading[0] > 0 > heading[-1]
    found = kinematics(poses(0.0, heading=heading)[None])
    assert np.allclose(found["angular_speed"][0, 1:-1], 0.4, atol=1e-4)
    assert np.allclose(found["angular_acceleration"][0, 2:-2], 0, atol=1e-2)


def test_a_growing_turn_has_its_acceleration():
    found = kinematics(poses(0.0, heading=0.5 * 0.2 * TIME**2)[None])
    assert np.allclose(found["angular_acceleration"][0, 2:-2], 0.2, atol=1e-3)


def test_a_difference_needs_both_neighbours_and_not_the_time_itself():
    valid = jnp.array([[True, True, False, True, True, True]])
    assert np.array_equal(differenced(valid)[0], [False, False, True, False, True, False])


# Interactions --------------------------------------------------------------------------------------------------------


def gap(other, size=(4.0, 2.0), other_size=(4.0, 2.0)):
    return float(nearest_gap(0, jnp.array([[0.0, 0, 0], other]), jnp.array([size, other_size]), jnp.ones(2, bool)))


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ((10.0, 0.0, 0.0), 6.0),  # nose to tail, 6 m of room
        ((0.0, 3.5, 0.0), 1.5),  # side by side
        ((10.0, 0.0, np.pi / 2), 7.0),  # across: half of 2 m reaches towards the first
        ((3.5, 0.0, 0.0), -0.5),  # 0.5 m into each other
        ((0.0, 1.0, 0.0), -1.0),
    ],
)
def test_gap_of_boxes_facing_each_other(other, expected):
    assert gap(other) == pytest.approx(expected, abs=1e-5)


def test_corners_are_rounded_by_seven_tenths_of_half_the_smaller_side():
    """Corner to corner at (3, 4): cores of radius 0.7 are 3 + 1.4 and 4 + 1.4 apart, so rounded corners are sqrt(4.4^2 + 5.4^2) - 1.4."""
    assert gap((7.0, 6.0, 0.0)) == pytest.approx(np.hypot(4.4, 5.4) - 1.4, abs=1e-5)
    assert gap((7.0, 6.0, 0.0)) > np.hypot(3.0, 4.0)


def test_boxes_that_overlap_at_their_sharp_corners_do_not_collide():
    other = (3.8, 1.8, 0.0)  # by 0.2 m each way; the rounded corners are sqrt(1.2^2 + 1.2^2) - 1.4 > 0 apart
    assert gap(other) == pytest.approx(np.hypot(1.2, 1.2) - 1.4, abs=1e-5) and gap(other) > 0
    boxes = jnp.array([other]), jnp.array([[4.0, 2.0]])
    assert geometry.boxes_overlap(jnp.zeros(3), jnp.array([4.0, 2.0]), *boxes)[0]
    assert geometry.box_gap(jnp.zeros(3), jnp.array([4.0, 2.0]), *boxes)[0] == pytest.approx(-0.2, abs=1e-5)


def test_box_gap_is_symmetric_and_its_sign_is_that_of_the_overlap():
    keys = jax.random.split(jax.random.key(0), 2)
    place = jax.random.uniform(keys[0], (500, 3), minval=jnp.array([-6.0, -5.0, -3.2]), maxval=jnp.array([6.0, 5.0, 3.2]))
    sizes = jax.random.uniform(keys[1], (500, 2), minval=0.5, maxval=6.0)
    mine = jnp.zeros(3), jnp.array([4.0, 2.0])
    there = geometry.box_gap(*mine, place, sizes)
    back = jax.vmap(lambda pose, size: geometry.box_gap(pose, size, mine[0][None], mine[1][None])[0])(place, sizes)
    assert np.allclose(there, back, atol=1e-4)
    assert np.array_equal(there < 0, geometry.boxes_overlap(*mine, place, sizes))


def test_box_gap_apart_is_the_distance_of_the_nearest_points_of_the_outlines():
    def outline(pose, size):
        ends = geometry.corners(pose, size)
        share = jnp.linspace(0, 1, 400)[:, None]
        return jnp.concatenate([ends[k] + share * (ends[(k + 1) % 4] - ends[k]) for k in range(4)])

    mine = jnp.zeros(3), jnp.array([4.0, 2.0])
    for pose in ((5.0, 3.0, 0.6), (-4.0, 2.5, 2.0), (0.5, -4.0, -0.3)):
        theirs = jnp.array(pose), jnp.array([3.0, 1.0])
        nearest = jnp.min(jnp.linalg.norm(outline(*mine)[:, None] - outline(*theirs)[None], axis=-1))
        assert float(geometry.box_gap(*mine, theirs[0][None], theirs[1][None])[0]) == pytest.approx(float(nearest), abs=0.01)


def test_nobody_there_is_infinitely_far():
    pose, size = jnp.array([[0.0, 0, 0], [5.0, 0, 0]]), jnp.full((2, 2), 2.0)
    assert nearest_gap(0, pose, size, jnp.array([True, False])) == np.inf


def closing(other, speeds=(10.0, 6.0), moving=(True, True), valid=(True, True), heading=0.0):
    pose, size = jnp.array([[0.0, 0, heading], other]), jnp.full((2, 2), 2.0) * jnp.array([2.0, 1.0])
    return float(time_to_collision(0, pose, size, jnp.array(speeds), jnp.array(valid), jnp.array(moving)))


def test_a_leader_is_reached_after_the_gap_over_the_closing_speed():
    assert closing((12.0, 0.0, 0.0)) == pytest.approx((12 - 4) / 4)
    assert closing((12.0, 1.4, 0.0)) == pytest.approx(2.0)  # overlapping by 0.6 m sideways


@pytest.mark.parametrize(
    ("case", "options"),
    [
        ("too far for 5 s", {"other": (25.0, 0.0, 0.0)}),
        ("opening", {"other": (12.0, 0.0, 0.0), "speeds": (6.0, 10.0)}),
        ("behind", {"other": (-12.0, 0.0, 0.0)}),
        ("beside the strip ahead", {"other": (12.0, 2.1, 0.0)}),
        ("across", {"other": (12.0, 0.0, np.deg2rad(76))}),
        ("turned, in a small overlap", {"other": (12.0, 2.4, np.deg2rad(11))}),
        ("not there", {"other": (12.0, 0.0, 0.0), "valid": (True, False)}),
        ("of unknown speed", {"other": (12.0, 0.0, 0.0), "moving": (True, False)}),
    ],
)
def test_who_follows_nobody_has_the_longest_time(case, options):
    assert closing(**options) == 5.0, case


def test_headings_of_leader_and_follower_may_lie_on_both_sides_of_pi():
    assert closing((-12.0, 0.0, -3.13), heading=3.13) < 5.0


def test_a_turned_leader_is_followed_where_the_overlap_is_large():
    """Turned by 11 degrees it is followed at 0.6 m of overlap, and at 0.4 m only by 9 degrees."""
    reach = {a: 1 + 2 * np.sin(np.deg2rad(a)) + np.cos(np.deg2rad(a)) for a in (9, 11)}
    assert closing((12.0, reach[11] - 0.6, np.deg2rad(11))) < 5 and closing((12.0, reach[11] - 0.4, np.deg2rad(11))) == 5
    assert closing((12.0, reach[9] - 0.4, np.deg2rad(9))) < 5


# The road ------------------------------------------------------------------------------------------------------------


def straight_edge(z=0.0, y=0.0, there=True):
    return RoadEdges(jnp.array([[[-50.0, y, z], [50.0, y, z]]]), jnp.array([there]))


def past(pose, edges, size=CAR):
    return float(distance_to_road_edge(jnp.asarray(pose, jnp.float32)[None, None], size[None], edges)[0, 0])


def test_the_worst_corner_counts_and_the_road_is_to_the_left():
    assert past((0.0, 3.0, 0.75, 0.0), straight_edge()) == pytest.approx(-2.0, abs=1e-5)
    assert past((0.0, -3.0, 0.75, 0.0), straight_edge()) == pytest.approx(4.0, abs=1e-5)
    assert past((0.0, 1.5, 0.75, np.pi / 2), straight_edge()) == pytest.approx(0.5, abs=1e-5)  # across: half of 4 m reaches over
    assert past((0.0, 3.0, 0.75, 0.0), straight_edge(there=False)) == -np.inf


def test_an_edge_overhead_is_ignored_unless_it_is_nearer_than_three_times_its_height():
    """On the road below, 8 m from its edge; the road above would have the car 1 m off it."""
    below, above = straight_edge(y=-9.0), straight_edge(y=2.0, z=5.0)
    both = jax.tree.map(lambda *x: jnp.concatenate(x), below, above)
    pose = (0.0, 0.0, 0.75, 0.0)
    assert past(pose, above) == pytest.approx(3.0, abs=1e-5)
    assert past(pose, both) == pytest.approx(-8.0, abs=1e-5)  # 3 x 5 m > 10 m
    low = jax.tree.map(lambda *x: jnp.concatenate(x), below, straight_edge(y=2.0, z=1.0))
    assert past(pose, low) == pytest.approx(3.0, abs=1e-5)  # hypot(3, 3 x 1) < 8


def test_many_points_find_the_same_edges_as_one():
    keys = jax.random.split(jax.random.key(3), 2)
    edges = 50 * jax.random.normal(keys[0], (70, 2, 3))
    points, valid = 50 * jax.random.normal(keys[1], (300, 3)), jnp.arange(70) % 5 > 0
    one = jax.vmap(lambda point: geometry.nearest_edge(point, edges, valid, stretch=3.0))(points)
    assert np.array_equal(geometry.nearest_edges(points, edges, valid, stretch=3.0), one)


def test_in_the_plane_and_in_space_at_one_height_an_edge_is_as_far():
    keys = jax.random.split(jax.random.key(4), 2)
    edges, points = 20 * jax.random.normal(keys[0], (30, 2, 2)), 20 * jax.random.normal(keys[1], (50, 2))
    lifted, high = jnp.pad(edges, [(0, 0), (0, 0), (0, 1)]), jnp.pad(points, [(0, 0), (0, 1)])
    there = jnp.ones(30, bool)
    flat = jax.vmap(lambda point: geometry.off_road(point, edges, there))(points)
    assert np.allclose(flat, jax.vmap(lambda point: geometry.off_road(point, lifted, there, stretch=3.0))(high))


LINES = StopLines(
    lanes=jnp.array([[[10.0, 0.0], [30.0, 0.0], [30.0, 0.0]], [[10.0, 4.0], [20.0, 4.0], [30.0, 4.0]], [[0.0, 0.0]] * 3]),
    stop=jnp.array([[10.0, 0.0], [10.0, 4.0], [0.0, 0.0]]),
    red=jnp.ones((3, 3), bool).at[:, 1].set(False),
)


def crosses(*x, y=0.0, red=LINES.red):
    return np.asarray(runs_red(jnp.stack([jnp.array(x), jnp.full(len(x), y)], axis=1)[None], LINES, red)[0]).tolist()


def test_crossing_the_stop_line_of_a_red_lane_is_a_violation_at_that_time():
    assert crosses(8.0, 9.0, 11.0) == [False, False, True]
    assert crosses(11.0, 12.0, 13.0) == [False, False, False]  # is past it already
    assert crosses(11.0, 9.0, 8.0) == [False, False, False]  # backwards
    assert crosses(9.0, 11.0, 12.0, red=LINES.red.at[1, 0].set(False)) == [False, False, False]  # green just then


def test_a_red_of_another_lane_is_not_ones_own():
    assert crosses(9.0, 11.0, 12.0, y=4.0) == [False, False, False]
    assert crosses(9.0, 11.0, 12.0, y=1.9) == [False, True, False]  # nearer to the red lane


def test_stop_lines_of_a_logged_scene_are_the_starts_of_its_lanes():
    road = RoadGraph(LINES.lanes, jnp.full((3, 1), -1), jnp.zeros(3, int), jnp.zeros((1, 2, 2)), jnp.zeros(1, bool), jnp.zeros((1, 4, 2)))
    signals = jnp.array([[RED, GREEN, 0]] * 3)
    users = jnp.zeros((1, 3, 3)), jnp.zeros((1, 3, 2)), jnp.ones((1, 2)), jnp.ones(1, int), jnp.ones((1, 3), bool)
    found = stop_lines(LoggedScene(road, signals, *users, jnp.array(0)))
    assert np.array_equal(found.stop[0], [10.0, 0.0]) and np.array_equal(found.red[0], [True, False, False])


# Likelihoods ---------------------------------------------------------------------------------------------------------


def test_log_likelihood_worked_out_by_hand():
    """Bins [0, 1), [1, 2), [2, 3], 0.1 added to each: of five known values two are in the first, three (one by clipping) in the last."""
    simulated = jnp.array([[0.0, 0.5, 2.5], [3.0, 7.0, 1.5]])
    known = jnp.array([[True, True, True], [True, True, False]])
    found = log_likelihood(Histogram(1.0, 0.0, 3.0, 3), jnp.array([-4.0, 1.0, 2.0, 3.0]), simulated, known)
    assert np.allclose(np.exp(found), np.array([2.1, 0.1, 3.1, 3.1]) / 5.3)


def test_an_indicator_is_a_bernoulli_variable():
    simulated = jnp.array([[0.0], [0.0], [0.0], [1.0]])
    found = log_likelihood(indicator(1.0), jnp.array([0.0, 1.0]), simulated, jnp.ones((4, 1), bool))
    assert np.allclose(np.exp(found), np.array([3.001, 1.001]) / 4.002)


def test_a_likelihood_is_the_geometric_mean_over_what_counts():
    estimate = Histogram(1.0, 0.0, 2.0, 2, smoothing=0.0)
    log, simulated = jnp.array([[0.5, 0.5, 1.5], [1.5, 1.5, 0.5]]), jnp.array([[[0.5, 0.5, 1.5, 1.5], [1.5] * 4]])
    counts = jnp.array([[True, True, False], [True, False, False]])
    found = likelihood(estimate, log, simulated, jnp.ones(simulated.shape, bool), counts)
    assert float(found) == pytest.approx((0.5 * 0.5 * 1.0) ** (1 / 3))
    assert np.isnan(likelihood(estimate, log, simulated, jnp.ones(simulated.shape, bool), jnp.zeros((2, 3), bool)))


def test_weights_of_the_meta_metric_sum_to_one():
    assert sum(estimate.weight for estimate in ESTIMATES.values()) == pytest.approx(1.0)


def realism(log, rollouts, scored, edges, lines, present=None, size=None):
    """Its figures; all scenes here have one shape, filled up with nobody, so that it is compiled once."""
    scored = jnp.concatenate([jnp.asarray(scored), jnp.full(3 - len(scored), -1)])
    present = jnp.ones((log.valid.shape[0], FUTURE), bool) if present is None else present
    return jax.device_get(compiled(log, rollouts, scored, edges, lines, present, log.size if size is None else size))


# Whole scenes --------------------------------------------------------------------------------------------------------


@functools.cache
def scene():
    """Five agents on a road 24 m wide along x; the last one, a pedestrian, is missing for some times, the fourth starts later."""
    random = np.random.default_rng(0)
    times = HISTORY + FUTURE
    clock = np.arange(times) / 10
    speed = np.array([8.0, 5.0, 12.0, 3.0, 1.2])[:, None]
    x = np.array([0.0, 9.0, -20.0, 30.0, 5.0])[:, None] + speed * clock + 0.3 * np.sin(3 * clock + np.arange(5)[:, None])
    y = np.array([-3.0, -3.2, 3.0, 0.0, 8.0])[:, None] + 0.02 * random.normal(size=(5, times)).cumsum(axis=1)
    valid = np.ones((5, times), bool)
    valid[4, 8:11], valid[3, :HISTORY] = False, False
    pose = np.stack([x, y, 0.75 + 0 * x, 0.05 * np.sin(2 * clock) + 0 * x], axis=-1)
    size = jnp.array([[4.5, 1.9, 1.5]] * 4 + [[0.7, 0.7, 1.8]])
    log = LoggedAgents(jnp.asarray(pose, jnp.float32), jnp.asarray(valid), size, jnp.arange(5) < 4)
    edges = RoadEdges(
        jnp.array([[[-100.0, -12.0, 0], [0.0, -12.0, 0]], [[0.0, -12.0, 0], [100.0, -12.0, 0]], [[100.0, 12.0, 0], [-100.0, 12.0, 0]]]),
        jnp.ones(3, bool),
    )
    noise = 0.4 * random.normal(size=(6, 5, FUTURE, 4)).cumsum(axis=2) * np.array([1, 0.3, 0, 0.05])
    lines = StopLines(
        jnp.array([[[4.0, -3.0], [60.0, -3.0]], [[4.0, 3.0], [60.0, 3.0]]]),
        jnp.array([[4.0, -3.0], [4.0, 3.0]]),
        jnp.ones((times, 2), bool),
    )
    rollouts = log.pose[None, :, HISTORY:] + jnp.asarray(noise, jnp.float32)
    return log, rollouts, jnp.array([0, 2, 4]), edges, lines


def test_log_replay_has_no_displacement_and_is_the_ceiling():
    log, rollouts, scored, edges, lines = scene()
    present = log.valid[:, HISTORY:]
    replay = realism(log, jnp.repeat(log.pose[None, :, HISTORY:], 6, axis=0), scored, edges, lines, present)
    other = realism(log, rollouts, scored, edges, lines, present)
    assert replay["average_displacement_error"] == replay["min_average_displacement_error"] == 0
    assert other["min_average_displacement_error"] > 0.1
    assert other["realism_meta_metric"] < replay["realism_meta_metric"] < 1
    for name in ESTIMATES:  # of all histograms, the log's own makes the log likeliest
        assert other[f"{name}_likelihood"] <= replay[f"{name}_likelihood"] + 0.01, name
    assert replay["simulated_traffic_light_violation_rate"] == pytest.approx(1 / 3)  # the first one; the second starts far behind


def test_the_meta_metric_is_the_weighted_mean_and_so_are_its_parts():
    found = {name: float(value) for name, value in realism(*scene()).items()}
    assert found["realism_meta_metric"] == pytest.approx(sum(e.weight * found[f"{n}_likelihood"] for n, e in ESTIMATES.items()))
    assert found["realism_meta_metric"] == pytest.approx(
        0.2 * found["kinematic"] + 0.45 * found["interactive"] + 0.35 * found["map_based"], abs=1e-5
    )
    assert found["map_based"] == pytest.approx(
        (
            0.05 * found["distance_to_road_edge_likelihood"]
            + 0.25 * found["offroad_likelihood"]
            + 0.05 * found["traffic_light_violation_likelihood"]
        )
        / 0.35
    )


def test_displacements_are_over_all_logged_times_and_the_smallest_is_of_a_whole_scene():
    """Half of the rollouts are 3 m off, half 1 m; the history counts with zeros: 12 of 16 times, 9 of 13 for who is missing thrice."""
    log, _, _, edges, lines = scene()
    off = jnp.array([3.0, 1.0, 3.0, 1.0, 3.0, 1.0])[:, None, None, None] * jnp.array([1.0, 0, 0, 0])
    found = realism(log, log.pose[None, :, HISTORY:] + off, jnp.array([0, 4]), edges, lines)
    share = (12 / 16 + 9 / 13) / 2
    assert float(found["average_displacement_error"]) == pytest.approx(2 * share, rel=1e-5)
    assert float(found["min_average_displacement_error"]) == pytest.approx(share, rel=1e-5)


def moved(pose, angle=0.7, shift=(100.0, -40.0, 7.0)):
    cos, sin = np.cos(angle), np.sin(angle)
    x, y, *rest = jnp.moveaxis(pose, -1, 0)
    out = [cos * x - sin * y + shift[0], sin * x + cos * y + shift[1]]
    return jnp.stack([*out, rest[0] + shift[2], *(h + angle for h in rest[1:])] if rest else out, axis=-1)


def test_moving_and_turning_everything_changes_nothing():
    log, rollouts, scored, edges, lines = scene()
    there = realism(
        dataclasses.replace(log, pose=moved(log.pose)), moved(rollouts), scored, dataclasses.replace(edges, segments=moved(edges.segments)),
        dataclasses.replace(lines, lanes=moved(lines.lanes), stop=moved(lines.stop)),
    )  # fmt: skip
    here = realism(*scene())
    for name in here:  # values at the limit of two bins may change bins by rounding
        assert float(there[name]) == pytest.approx(float(here[name]), abs=0.02), name


def test_the_order_of_agents_means_nothing():
    log, rollouts, scored, edges, lines = scene()
    order = jnp.array([3, 0, 4, 2, 1])
    place = jnp.argsort(order)
    there = realism(jax.tree.map(lambda x: x[order], log), rollouts[:, order], place[scored][::-1], edges, lines)
    for name, value in realism(*scene()).items():
        assert float(there[name]) == pytest.approx(float(value), rel=1e-5), name


def test_what_is_logged_of_who_is_not_there_means_nothing():
    log, rollouts, scored, edges, lines = scene()
    here = realism(*scene())
    for rubbish in (np.nan, -10000.0):
        torn = dataclasses.replace(log, pose=jnp.where(log.valid[..., None], log.pose, rubbish))
        for name, value in realism(torn, rollouts, scored, edges, lines).items():
            assert np.isfinite(value) and float(value) == float(here[name]), name


def test_who_is_not_there_at_the_current_time_is_neither_scored_nor_met():
    log, rollouts, _, edges, lines = scene()  # the fourth comes after the current time; put it onto the first
    onto = dataclasses.replace(log, pose=log.pose.at[3].set(log.pose[0])), rollouts.at[:, 3].set(rollouts[:, 0])
    expected = realism(log, rollouts, [0], edges, lines)
    for scored in ([0], [0, 3]):
        for name, value in realism(*onto, scored, edges, lines).items():
            assert float(value) == pytest.approx(float(expected[name]), rel=1e-5), (scored, name)


def test_what_cannot_be_scored_is_left_out_of_the_mean():
    log, rollouts, _, edges, _ = scene()
    found = realism(log, rollouts, [4], dataclasses.replace(edges, valid=jnp.zeros(3, bool)), None)  # a pedestrian without a road
    left = [name for name in ESTIMATES if not np.isnan(found[f"{name}_likelihood"])]
    assert set(ESTIMATES) - set(left) == {"time_to_collision", "distance_to_road_edge", "offroad", "traffic_light_violation"}
    weights = [ESTIMATES[name].weight for name in left]
    values = [float(found[f"{name}_likelihood"]) for name in left]
    assert float(found["realism_meta_metric"]) == pytest.approx(np.average(values, weights=weights))


def test_the_last_times_of_a_rollout_count_in_the_last_bin_of_speeds_and_accelerations():
    """At 3 m/s straight on, 6 rollouts like the log: of 12 times the last has no speed, and the last two have no acceleration."""
    log, _, _, edges, lines = scene()
    clock = jnp.arange(HISTORY + FUTURE) / 10
    straight = dataclasses.replace(log, pose=log.pose.at[0].set(poses(3 * clock, -3.0, 0.75)))
    found = realism(straight, jnp.repeat(straight.pose[None, :, HISTORY:], 6, axis=0), [0], edges, lines)
    assert float(found["linear_speed_likelihood"]) == pytest.approx((6 * 11 + 0.1) / (6 * 12 + 10 * 0.1), rel=1e-5)
    assert float(found["angular_speed_likelihood"]) == pytest.approx((6 * 11 + 0.1) / (6 * 12 + 11 * 0.1), rel=1e-5)
    for name in ("linear", "angular"):
        assert float(found[f"{name}_acceleration_likelihood"]) == pytest.approx((6 * 10 + 0.1) / (6 * 12 + 11 * 0.1), rel=1e-5)


def test_who_is_no_vehicle_counts_as_somebody_who_never_runs_a_red():
    """The first car runs a red in the log and stands in all 6 rollouts; the pedestrian counts as well."""
    log, _, _, edges, lines = scene()
    standing = jnp.tile(log.pose[None, :, HISTORY - 1 : HISTORY], (6, 1, FUTURE, 1))
    found = {len(scored): realism(log, standing, scored, edges, lines) for scored in ([0], [0, 4])}
    runs, never = 0.001 / 6.002, 6.001 / 6.002
    assert float(found[1]["traffic_light_violation_likelihood"]) == pytest.approx(runs, rel=1e-4)
    assert float(found[2]["traffic_light_violation_likelihood"]) == pytest.approx((runs * never) ** 0.5, rel=1e-4)


def test_who_is_scored_and_leaves_the_log_counts_as_somebody_whom_nothing_happens_to():
    """The second scored agent is gone after the current time; in one rollout of six the first one leaves the road."""
    log, _, _, edges, lines = scene()
    gone = dataclasses.replace(log, valid=log.valid.at[2, HISTORY:].set(False))
    rollouts = jnp.repeat(log.pose[None, :, HISTORY:], 6, axis=0).at[1, 0, 5, 1].set(-30.0)
    found = realism(gone, rollouts, [0, 2], edges, lines)
    stays, nothing = 5.001 / 6.002, 6.001 / 6.002
    assert float(found["offroad_likelihood"]) == pytest.approx((stays * nothing) ** 0.5, rel=1e-4)
    assert float(found["simulated_offroad_rate"]) == pytest.approx(1 / 12)


def test_what_drives_in_the_rollouts_may_have_another_size_than_in_the_log():
    log, _, _, edges, lines = scene()
    rollouts = jnp.repeat(log.pose[None, :, HISTORY:], 6, axis=0)
    long = realism(log, rollouts, [0], edges, lines, size=log.size.at[0, 0].set(40.0))
    assert float(long["simulated_collision_rate"]) == 1  # with who drives before it
    assert float(long["collision_likelihood"]) == pytest.approx(0.001 / 6.002, rel=1e-3)  # the log's car is as long as it was


def test_rates_are_over_rollouts_and_agents():
    log, _, _, edges, lines = scene()
    rollouts = jnp.repeat(log.pose[None, :, HISTORY:], 6, axis=0)
    rollouts = rollouts.at[1, 0, 5, 1].set(-30.0)  # in one rollout of six, one of two agents is off the road for one time
    found = realism(log, rollouts, jnp.array([0, 2]), edges, lines)
    assert float(found["simulated_offroad_rate"]) == pytest.approx(1 / 12)
    assert float(found["simulated_collision_rate"]) == 0


def test_arrays_that_do_not_belong_together_are_refused():
    log, rollouts, scored, edges, lines = scene()
    for wrong in (
        (log, rollouts[:, :4], scored, edges, lines),
        (log, jnp.tile(rollouts, (1, 1, 2, 1)), scored, edges, lines),
        (log, rollouts, scored, edges, dataclasses.replace(lines, red=lines.red[1:])),
    ):
        with pytest.raises(UsageError, match="need"):
            sim_agents.realism(*wrong)


def test_features_have_finite_derivatives():
    log, rollouts, scored, edges, _ = scene()
    torn = jnp.where(log.valid[..., None], log.pose, jnp.nan)

    def total(future):
        pose = jnp.concatenate([torn[:, :HISTORY], jnp.where(log.valid[:, HISTORY:, None], future, jnp.nan)], axis=1)
        found = sim_agents.features(pose, log.valid, log.size, scored, edges, None, future=FUTURE)
        return sum(jnp.sum(values) for name, values in found.items() if name not in sim_agents.score.INDICATORS)

    for future in (rollouts[0], jnp.zeros_like(rollouts[0])):  # also with everybody at one place
        slope = jax.jit(jax.grad(total))(future)
        assert np.all(np.isfinite(slope)) and np.any(slope != 0)
