"""What a driver sees, in its own frame: the routes ahead, and those around it, replayed or driven by others."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rtc_mjx.geometry import capsule_gap, closest_approach, pose_at, project, rotate, wrapped
from rtc_mjx.logs import AMBER, GREEN, PEDESTRIAN, RED, VEHICLE
from rtc_mjx.physics import PhysicsState
from rtc_mjx.physics.car import CAR
from rtc_mjx.pytree import pytree
from rtc_mjx.scenes.routes import BEHIND, SPACING, Routes
from rtc_mjx.scenes.several import the_others

AHEAD = (2.0, 5.0, 8.0, 12.0, 16.0, 20.0, 25.0, 30.0, 40.0, 50.0)  # m along a route, where it is looked at
ROUTE, USER = 11 + 3 * len(AHEAD), 14  # numbers that are told of a route, and of somebody around
FAR = 60.0  # m, beyond which nothing is told apart
NEAR, SOON = 15.0, 5.0  # m and s, up to which it is told how close somebody is or will be
REACH = 2.5  # m around a point of a route, within which somebody is in the way
OFF_ROUTE = 5.0  # m to the side, beyond which a route is no longer one's own


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


def see_routes(routes: Routes, signals: Int[Array, "routes"], pose: Float[Array, "3"], others: Others) -> Float[Array, "routes 41"]:
    """Each route from a pose.

    Per route: 1 (there), m to its left, cosine and sine of the heading error, m to the stop line, red, amber, green, m to the
    give-way line, and to whom it gives way (0, 1, 2), curvature 10 m ahead, then x and y of the points AHEAD in the car's frame, and
    the s until somebody is there (`taken`). A route too far to the side is not there, unless it is the nearest.
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
        return jnp.concatenate([told, seen.reshape(-1), taken(points[:, :2], others)]), jnp.abs(aside)

    told, aside = jax.vmap(see)(routes.paths, signals, routes.stop, routes.give_way, routes.gives_way_to)
    aside = lax.stop_gradient(jnp.where(routes.valid, aside, jnp.inf))
    there = routes.valid & ((aside < OFF_ROUTE) | (jnp.arange(len(aside)) == jnp.argmin(aside)))
    told = jnp.where(there[:, None], told, 0.0)
    return jnp.concatenate([there[:, None].astype(told.dtype), told], axis=1)


def taken(points: Float[Array, "points 2"], others: Others) -> Float[Array, "points"]:
    """In how many s the first of those around who go straight on will be at each point; SOON if nobody.

    One who passes at more than REACH counts as later by 1 s a metre, so that the number does not jump.
    """
    soon, closest = jax.vmap(lambda point: closest_approach(others.pose[:, :2] - point, others.velocity, SOON))(points)
    when = jnp.where(others.present, soon + jnp.maximum(0.0, closest - REACH), SOON)
    return jnp.minimum(jnp.min(when, axis=1, initial=SOON), SOON)


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
    soon, closest = closest_approach(place, rotate(others.velocity - own_velocity, turned), SOON)
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
