"""What a driver sees, in its own frame: itself and the room it has, the routes ahead, and those around it, replayed or driven by others."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rtc_mjx.extrema import at, least
from rtc_mjx.geometry import capsule_gap, closest_approach, corners, off_road, pose_at, project, rotate, wrapped
from rtc_mjx.logs import AMBER, GREEN, PEDESTRIAN, RED, VEHICLE, RoadGraph
from rtc_mjx.physics import PhysicsState
from rtc_mjx.physics.car import CAR
from rtc_mjx.pytree import pytree
from rtc_mjx.scenes.routes import BEHIND, SPACING, Routes
from rtc_mjx.scenes.several import the_others

AHEAD = (2.0, 5.0, 8.0, 12.0, 16.0, 20.0, 25.0, 30.0, 40.0, 50.0)  # m along a route, where it is looked at
OWN, ROUTE, USER = 9, 15 + 3 * len(AHEAD), 14  # numbers that are told of the car itself, of a route, and of somebody around
FAR = 60.0  # m, beyond which nothing is told apart
NEAR, SOON = 15.0, 5.0  # m and s, up to which it is told how close somebody is or will be
GAP = 11  # which of the numbers of somebody around is the room in between
FINE = 2.0  # m, the scale of `finely`
CLEAR = 3.0  # m, beyond which a road edge is not seen
CRAWL = 0.5  # m/s, the least speed at which a car is taken to go on
REACH = 2.5  # m around a point of a route, within which somebody is in the way
OFF_ROUTE = 5.0  # m to the side, beyond which a route is no longer one's own


def finely(metres: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """A distance that tells little but whether it is near zero: there its slope is one, and beyond twice FINE it hardly changes.

    Networks see standardised numbers, and a smooth one cannot tell a touch from a metre of room by a number that goes from 0 to 60 m.
    """
    return FINE * jnp.tanh(metres / FINE)


@pytree
class Others:
    """Those around an agent at one time.

    Attributes:
        pose: x in m, y in m, heading in rad.
        size: length and width, m.
        velocity: m/s.
        yaw_rate: rad/s.
        kind: as in `logs`; 0 for none.
        present: who is there.
    """

    pose: Float[Array, "*batch others 3"]
    size: Float[Array, "*batch others 2"]
    velocity: Float[Array, "*batch others 2"]
    yaw_rate: Float[Array, "*batch others"]
    kind: Int[Array, "*batch others"]
    present: Bool[Array, "*batch others"]


def past_edges(pose: Float[Array, "3"], road: RoadGraph) -> Float[Array, "4"]:
    """How far each corner of the car is past the nearest road edge, m; negative on the road."""
    return jax.vmap(lambda corner: off_road(corner, road.edges, road.edge_valid))(corners(pose, jnp.array(CAR)))


def see_itself(qpos: Float[Array, "4"], qvel: Float[Array, "4"], road: RoadGraph, users: Float[Array, "others 14"]) -> Float[Array, "9"]:
    """The car itself: its velocity forwards and to the left, yaw rate, steering angle, then the room that it has, in m.

    That is, from each corner to the road edge (negative off the road, CLEAR at most either way; always CLEAR where a map has no road
    edges), and to the nearest of those around (`finely`), as `see_users` tells of them.
    """
    room = jnp.clip(-past_edges(qpos[:3], road), -CLEAR, CLEAR)
    gap = least(jnp.where(users[:, 0] > 0, users[:, GAP], NEAR), axis=0)
    return jnp.concatenate([rotate(qvel[:2], -qpos[2]), qvel[2:3], qpos[3:4], room, finely(gap)[None]])


def see_routes(
    routes: Routes, signals: Int[Array, "routes"], pose: Float[Array, "3"], speed: Float[Array, ""], others: Others
) -> Float[Array, "routes 45"]:
    """Each route from a pose, at a speed forwards in m/s.

    Per route: 1 (there), m to its left, cosine and sine of the heading error, m to the stop line, red, amber, green, m to the
    give-way line, and to whom it gives way (0, 1, 2), curvature 10 m ahead, then x and y of the points AHEAD in the car's frame, the s
    until somebody is there (`taken`), m from the car's nose to both lines (`finely`), and how narrowly the car would miss somebody, and
    when (`near_miss`). A route too far to the side is not there, unless it is the nearest.
    """

    def see(path: Array, signal: Array, stop: Array, give_way: Array, whom: Array) -> tuple[Array, Array]:
        station, aside, heading = project(path, SPACING, pose[:2])
        points = jax.vmap(lambda ahead: pose_at(path, SPACING, station + ahead))(jnp.array(AHEAD))
        seen = rotate(points[:, :2] - pose[:2], jnp.broadcast_to(-pose[2], len(AHEAD)))
        off = pose[2] - heading
        bend = wrapped(points[4, 2] - points[1, 2]) / (AHEAD[4] - AHEAD[1])
        to_stop, to_give = jnp.clip(jnp.stack([stop, give_way]) - station, -BEHIND, FAR)
        told = jnp.stack([
            aside, jnp.cos(off), jnp.sin(off), to_stop, 1.0 * (signal == RED), 1.0 * (signal == AMBER), 1.0 * (signal == GREEN),
            to_give, 1.0 * whom, bend,
        ])  # fmt: skip
        close = finely(jnp.stack([to_stop, to_give]) - CAR[0] / 2)
        when = taken(points[:, :2], others)
        return jnp.concatenate([told, seen.reshape(-1), when, close, near_miss(speed, when)]), jnp.abs(aside)

    told, aside = jax.vmap(see)(routes.paths, signals, routes.stop, routes.give_way, routes.gives_way_to)
    aside = lax.stop_gradient(jnp.where(routes.valid, aside, jnp.inf))
    there = routes.valid & ((aside < OFF_ROUTE) | (jnp.arange(len(aside)) == jnp.argmin(aside)))
    told = jnp.where(there[:, None], told, 0.0)
    return jnp.concatenate([there[:, None].astype(told.dtype), told], axis=1)


def taken(points: Float[Array, "points 2"], others: Others) -> Float[Array, "points"]:
    """In how many s the first of those around who go straight on will be at each point; SOON if nobody.

    One who passes at more than REACH counts as later by 1 s a metre, so that the number does not jump.
    """
    away = tuple(others.pose[:, i] - points[:, i, None] for i in (0, 1))  # by coordinate: (points, others)
    soon, closest = closest_approach(away, tuple(others.velocity.T), SOON)
    when = jnp.where(others.present, soon + jnp.maximum(0.0, closest - REACH), SOON)
    return jnp.minimum(least(when, axis=1), SOON)


def near_miss(speed: Float[Array, ""], when: Float[Array, "points"]) -> Float[Array, "2"]:
    """At the point of a route where the car, going on as fast as it does, would miss somebody most narrowly: by how much, and when, in s.

    The one is the time between the car and the earliest of the others there, whichever of the two is earlier (what traffic safety calls
    post-encroachment time, as expected), the other the time until the car is there. Both are at most SOON, and SOON where nobody comes
    near. Somebody is told of from the moment on when he is less than SOON away from a point: the numbers jump there. Who comes second to
    a point is not told of.
    """
    mine = jnp.array(AHEAD) / jnp.maximum(speed, CRAWL)
    between = jnp.where(when < SOON, jnp.minimum(jnp.abs(mine - when), SOON), SOON)
    narrowest = jnp.argmin(lax.stop_gradient(between), keepdims=True)
    margin, reached = (at(x, narrowest, axis=0) for x in (between, mine))
    return jnp.stack([margin, jnp.where(margin < SOON, jnp.minimum(reached, SOON), SOON)])


def see_users(others: Others, pose: Float[Array, "3"], own_velocity: Float[Array, "2"]) -> Float[Array, "others 14"]:
    """Each of those around a pose.

    Per user: 1 (there), x, y, cosine and sine of its heading, velocity, length, width, whether it walks, yaw rate, then what a driver
    sees at a glance: m between both bodies, and, if both went straight on, in how many s they would be closest and how far apart then.
    """
    turned = jnp.broadcast_to(-pose[2], len(others.present))
    place = rotate(others.pose[:, :2] - pose[:2], turned)
    heading = others.pose[:, 2] - pose[2]
    there = others.present & (lax.stop_gradient(jnp.max(jnp.abs(place), axis=1)) < FAR)
    gap = jnp.minimum(capsule_gap(pose, jnp.array(CAR), others.pose, others.size), NEAR)
    soon, closest = closest_approach(tuple(place.T), tuple(rotate(others.velocity - own_velocity, turned).T), SOON)
    told = jnp.concatenate([
        place, jnp.cos(heading)[:, None], jnp.sin(heading)[:, None], rotate(others.velocity, turned), others.size,
        1.0 * (others.kind == PEDESTRIAN)[:, None], others.yaw_rate[:, None], jnp.stack([gap, soon, jnp.minimum(closest, NEAR)], axis=1),
    ], axis=1)  # fmt: skip
    return jnp.concatenate([there[:, None].astype(told.dtype), jnp.where(there[:, None], told, 0.0)], axis=1)


def around_each(replayed: Others, cars: PhysicsState, count: int) -> Others:
    """For each of so many cars the road users, and after them the other cars."""
    if count == 1:
        return replayed
    index = the_others(count)
    shape = index.shape
    driven = Others(
        pose=cars.qpos[index, :3],
        size=jnp.broadcast_to(jnp.array(CAR), (*shape, 2)),
        velocity=cars.qvel[index, :2],
        yaw_rate=cars.qvel[index, 2],
        kind=jnp.full(shape, VEHICLE),
        present=jnp.ones(shape, bool),
    )
    return jax.tree.map(lambda x, y: jnp.concatenate([jnp.broadcast_to(x, (count, *x.shape)), y], axis=1), replayed, driven)
