"""Plane geometry against numbers worked out by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtc_mjx import geometry

SIZE = jnp.array([4.0, 2.0])


def one(pose):
    return jnp.array([pose], float), SIZE[None]


def test_lengths_in_the_plane_and_in_space():
    assert np.allclose(geometry.length(jnp.array([[3.0, 4.0], [0.0, 0.0]])), [5, 1e-6])
    assert geometry.length(jnp.array([3.0, 4.0, 12.0])) == pytest.approx(13)
    assert np.all(np.isfinite(jax.grad(geometry.length)(jnp.zeros(3))))


@pytest.mark.parametrize(
    ("place", "velocity", "soon", "close"),
    [
        ((-10.0, 3.0), (5.0, 0.0), 50 / 25.1, 3.0),  # passes 3 m to the side; the 0.1 in the denominator is for those who stand
        ((-100.0, 0.0), (5.0, 0.0), 4.0, 80.0),  # not within the horizon
        ((3.0, 4.0), (1.0, 1.0), 0.0, 5.0),  # goes away
        ((3.0, 4.0), (0.0, 0.0), 0.0, 5.0),
    ],
)
def test_closest_approach_of_who_goes_straight_on(place, velocity, soon, close):
    when, how = geometry.closest_approach(place, velocity, 4.0)
    assert when == pytest.approx(soon, abs=1e-5) and how == pytest.approx(close, abs=0.01)


def test_a_polyline_is_resampled_by_its_arc_length():
    bent = jnp.array([[0.0, 0.0], [3.0, 0.0], [3.0, 0.0], [3.0, 4.0], [3.0, 4.0]])  # a point twice, as padding has it
    out = geometry.resample(bent, jnp.array([-1.0, 0.0, 2.0, 3.0, 5.0, 7.0, 9.0]))
    assert np.allclose(out, [[-1, 0], [0, 0], [2, 0], [3, 0], [3, 2], [3, 4], [3, 6]], atol=1e-6)
    assert float(geometry.polyline_length(bent)) == pytest.approx(7.0)


@pytest.mark.parametrize(("point", "station", "aside"), [((3.2, 1.0), 3.2, 1.0), ((5.0, -2.0), 5.0, -2.0), ((-1.0, 0.5), -1.0, 0.5)])
def test_projection_on_a_straight_path(point, station, aside):
    path = jnp.stack([2.0 * jnp.arange(8), jnp.zeros(8)], axis=1)
    found = geometry.project(path, 2.0, jnp.array(point))
    assert np.allclose(found, (station, aside, 0.0), atol=1e-5)


def test_projection_and_pose_are_inverse_on_a_bend():
    bearing = jnp.arange(12) * 2.0 / 20.0  # a circle of radius 20 about (0, 20), a point every 2 m of arc
    path = 20 * jnp.stack([jnp.sin(bearing), 1 - jnp.cos(bearing)], axis=1)
    for wanted in (0.7, 6.3, 15.9):
        pose = geometry.pose_at(path, 2.0, jnp.array(wanted))
        station, aside, heading = geometry.project(path, 2.0, pose[:2])
        assert abs(station - wanted) < 0.02 and abs(aside) < 0.01 and abs(heading - pose[2]) < 0.11
    assert np.allclose(geometry.curvature(path, 2.0), 1 / 20, rtol=0.01)


def test_projection_can_be_differentiated_and_says_how_far_ahead_one_gets():
    path = jnp.stack([2.0 * jnp.arange(8), jnp.zeros(8)], axis=1)
    slope = jax.jacrev(lambda p: jnp.stack(geometry.project(path, 2.0, p)[:2]))(jnp.array([3.2, 1.0]))
    assert np.allclose(slope, np.eye(2), atol=1e-5)


@pytest.mark.parametrize(
    ("pose", "gap"),
    [
        ((10.0, 0.0, 0.0), 6.0),  # nose to tail: 10 - 2 - 2
        ((0.0, 5.0, 0.0), 3.0),  # side by side: 5 - 1 - 1
        ((0.0, 5.0, np.pi / 2), 2.0),  # it points at my side: 5 - 2 - 1
        ((0.0, 0.5, np.pi / 2), -2.0),  # axes cross: both radii deep
    ],
)
def test_gap_between_capsules(pose, gap):
    assert np.allclose(geometry.capsule_gap(jnp.zeros(3), SIZE, *one(pose)), gap, atol=1e-5)


def test_a_person_is_a_circle():
    person = (jnp.array([[0.0, 3.0, 0.4]]), jnp.array([[0.6, 0.6]]))
    assert np.allclose(geometry.capsule_gap(jnp.zeros(3), SIZE, *person), 3.0 - 1.0 - 0.3, atol=1e-5)


@pytest.mark.parametrize(
    ("pose", "overlap"),
    [
        ((3.9, 1.9, 0.0), True),  # corners meet: the boxes do, the capsules do not
        ((4.1, 0.0, 0.0), False),
        ((3.2, 0.0, np.pi / 2), False),  # across my way: 3.2 > 2 + 1
        ((2.9, 0.0, np.pi / 2), True),
        ((3.5, 2.6, np.pi / 4), False),  # only a slanted direction separates: 6.1 / sqrt(2) = 4.31 m against 3 / sqrt(2) + 2 = 4.12
        ((3.3, 2.4, np.pi / 4), True),
    ],
)
def test_overlap_of_boxes(pose, overlap):
    assert bool(geometry.boxes_overlap(jnp.zeros(3), SIZE, *one(pose))[0]) is overlap
    assert bool(geometry.boxes_overlap(jnp.array(pose, float), SIZE, *one((0.0, 0.0, 0.0)))[0]) is overlap


def test_capsules_that_touch_are_boxes_that_overlap():
    key = jax.random.key(0)
    place = jax.random.uniform(key, (2000, 3), minval=jnp.array([-5.0, -4.0, -3.2]), maxval=jnp.array([5.0, 4.0, 3.2]))
    sizes = jnp.broadcast_to(SIZE, (2000, 2))
    touch = geometry.capsule_gap(jnp.zeros(3), SIZE, place, sizes) < 0
    overlap = geometry.boxes_overlap(jnp.zeros(3), SIZE, place, sizes)
    assert np.all(overlap[touch]) and np.sum(overlap & ~touch) > 0


def test_corners_go_round_the_box():
    assert np.allclose(geometry.corners(jnp.array([1.0, 2.0, np.pi / 2]), SIZE), [[0, 4], [2, 4], [2, 0], [0, 0]], atol=1e-5)


def test_the_road_lies_to_the_left_of_its_edge():
    edges = jnp.array([[[0.0, 0.0], [10.0, 0.0]], [[10.0, 5.0], [0.0, 5.0]], [[50.0, 0.0], [50.0, 1.0]]])  # a road along x, 5 m wide
    there = jnp.array([True, True, False])  # the last one is padding: it must not count
    found = [float(geometry.off_road(jnp.array(p), edges, there)) for p in ((5.0, 1.0), (5.0, -1.0), (5.0, 6.5), (49.0, 2.0))]
    assert found[:3] == pytest.approx([-1.0, 1.0, 1.5], abs=1e-5) and abs(found[3]) > 30
    assert float(geometry.off_road(jnp.array([0.0, 0.0]), edges, jnp.zeros(3, bool))) == -np.inf  # no edges: never off the road


def test_at_a_corner_of_the_kerb_the_side_is_right():
    """A kerb that turns right by 90 degrees round (0, 0), and one that turns left."""
    right = jnp.array([[[0.0, -5.0], [0.0, 0.0]], [[0.0, 0.0], [5.0, 0.0]]])
    left = jnp.array([[[0.0, -5.0], [0.0, 0.0]], [[0.0, 0.0], [-5.0, 0.0]]])
    there = jnp.ones(2, bool)
    assert geometry.off_road(jnp.array([-1.0, 1.0]), right, there) < 0 < geometry.off_road(jnp.array([0.5, -0.5]), right, there)
    assert geometry.off_road(jnp.array([-0.5, -0.5]), left, there) < 0 < geometry.off_road(jnp.array([1.0, 1.2]), left, there)


def test_derivatives_are_finite_where_norms_vanish():
    def everything(pose):
        others = jnp.zeros((1, 3))
        path = jnp.stack([2.0 * jnp.arange(8), jnp.zeros(8)], axis=1)
        return jnp.sum(geometry.capsule_gap(pose, SIZE, others, SIZE[None])) + sum(geometry.project(path, 2.0, pose[:2])[:2])

    assert np.all(np.isfinite(jax.grad(everything)(jnp.zeros(3))))
