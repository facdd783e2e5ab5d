"""The expert of generated driving scenes: a driver with a mind of its own, who knows no more than an observation tells.

    observation -> the way ahead on its route -> steering (pure pursuit)
                -> obstacles: bends, who is ahead, the stop line, who goes first -> the hardest braking that any of them asks for

Internal to the driver, and drawn anew for each episode: route, speed, headway, the gap it takes, how late it sees a signal change,
whether it still goes at amber, where in the lane it keeps. Where ways join, `rtc_mjx.scenes.joining` has the pedals.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from jax import random
from jax.tree_util import Partial
from jaxtyping import Array, Float

from rtc_mjx.physics.car import CAR, WHEELBASE
from rtc_mjx.scenes.base import Actor, split_items
from rtc_mjx.scenes.routes import Routes
from rtc_mjx.scenes.sight import AHEAD, OWN
from rtc_mjx.scenes.traffic import COMFORT, GRIP, follow_the_leader

if TYPE_CHECKING:
    from rtc_mjx.scenes.driving import Driving

REAR = -CAR[0] / 2 + 0.9  # m, the rear axle from the car's centre
GRID = tuple(1.5 * i for i in range(28))  # m along the route, where others are looked for
AFTER = tuple(0.4 * i for i in range(13))  # s ahead, to which others are expected to go straight on
WITHIN = {"vehicle": 2.1, "walker": 1.9}  # m from the middle of the way: ahead of me
CROSSES = {"vehicle": 3.0, "walker": 2.4}  # m from the middle of the way: will be in it
CANNOT_STOP = 7.5  # m/s^2: a line that takes harder braking is passed
LATEST = 4  # control steps by which a driver may see a signal change late
ROUTES = (0.9, 1.1, 0.9)  # how often each is taken, where there are three

Pedals = Callable[[Array, Array, Array, Array, dict[str, Array]], Array]  # own, route, signal, users, truth -> m/s^2


def expert_driver(
    key: jax.Array, scene: "Driving", routes: Routes, speeds: tuple[float, float], pedals: Pedals | None = None
) -> tuple[Actor, Any]:
    """A driver who has these routes to choose from, and its internal truth; by default it minds signals and crossings."""
    pedals = pedals or mind_signals_and_crossings
    keys = iter(random.split(key, 10))
    valid = routes.valid
    weight = jnp.where(valid, jnp.resize(jnp.array(ROUTES), valid.shape), 0.0)
    inattentive, ignores = random.bernoulli(next(keys), 0.15), random.bernoulli(next(keys), 0.12)
    truth = {
        "route": random.choice(next(keys), len(valid), p=weight / jnp.sum(weight)),
        "speed": random.uniform(next(keys), minval=speeds[0], maxval=speeds[1]),
        "headway": random.uniform(next(keys), minval=0.9, maxval=1.9),
        "gap": random.uniform(next(keys), minval=1.0, maxval=2.6),
        "late": jnp.where(inattentive, 3, random.randint(next(keys), (), 0, 2)),
        "amber_limit": jnp.where(ignores, -1.0, random.uniform(next(keys), minval=2.0, maxval=4.5)),
        "aside": 0.15 * random.normal(next(keys)),
    }
    tremor = random.normal(next(keys), (scene.steps, 2)) * jnp.array([0.12, 0.006])

    def act(truth: dict[str, Array], memory: Array, observation: Array, noise: Array) -> tuple[Array, Array]:
        own, (routes, users) = split_items(scene.sets, OWN, observation)
        route = routes[truth["route"]]
        seen = jnp.where(jnp.all(memory < 0), route[5:8], memory)  # at t = 0 nothing was seen before
        memory = jnp.concatenate([route[None, 5:8], seen[:-1]])
        pull = pedals(own, route, memory[truth["late"]], users, truth)
        return memory, jnp.stack([pull, steering(own, route, truth["aside"])]) + noise

    return Actor(jnp.full((LATEST, 3), -1.0), Partial(act, truth), tremor), truth


def way_ahead(route: Float[Array, "numbers"]) -> tuple[Float[Array, "points"], Float[Array, "points 2"]]:
    """Stations in m ahead, and the points of the route there, in the car's frame; the first is beside the car."""
    beside = -route[1] * jnp.stack([route[3], route[2]])  # aside of the route, seen from the car: (sin, cos) of the heading error
    points = jnp.concatenate([beside[None], route[11 : 11 + 2 * len(AHEAD)].reshape(-1, 2)])
    return jnp.array([0.0, *AHEAD]), points


def at(stations: Array, points: Array, wanted: Array) -> Float[Array, "*wanted 2"]:
    """Points of the way ahead at stations."""
    return jnp.stack([jnp.interp(wanted, stations, points[:, axis]) for axis in (0, 1)], axis=-1)


def steering(own: Array, route: Array, aside: Array) -> Float[Array, ""]:
    """Steering angle in rad that leads the rear axle to the route (pure pursuit), a little to one side of it."""
    reach = jnp.clip(3.0 + 0.55 * own[0], 4.5, 12.0)
    stations, points = way_ahead(route)
    target = at(stations, points, reach) + jnp.array([-REAR, 0.0]) + jnp.array([0.0, 1.0]) * aside
    far = jnp.sqrt(jnp.sum(target**2) + 1e-6)
    return jnp.clip(jnp.arctan(2 * WHEELBASE * target[1] / far**2), -0.6, 0.6)


def mind_signals_and_crossings(
    own: Array, route: Array, signal: Float[Array, "3"], users: Float[Array, "users 14"], truth: dict[str, Array]
) -> Float[Array, ""]:
    """Acceleration in m/s^2."""
    speed = jnp.maximum(own[0], 0.0)
    stations, points = way_ahead(route)
    wanted = speed_for_bends(stations, points, truth["speed"])
    asked = [follow_the_leader(speed, wanted, jnp.array(1e3), jnp.array(0.0), headway=truth["headway"])]
    line = route[4] - CAR[0] / 2
    needed = speed**2 / (2 * jnp.maximum(line, 0.1))
    stops = (line > -1.0) & (((signal[0] > 0) & (needed < CANNOT_STOP)) | ((signal[1] > 0) & (needed < truth["amber_limit"])))
    asked.append(jnp.where(stops, follow_the_leader(speed, wanted, line + 1.2, speed, headway=truth["headway"] / 2), 9.0))
    way, tangent, grid = looked_at(stations, points)
    gap, closing = ahead_of_me(way, tangent, grid, users, speed)
    asked.append(jnp.min(follow_the_leader(speed, wanted, gap, closing, headway=truth["headway"])))
    clash = first_clash(way, grid, users, speed, route, truth["gap"])
    room = clash - CAR[0] / 2 - 1.5
    asked.append(jnp.where(room > speed**2 / (2 * 6.0), follow_the_leader(speed, wanted, room, speed, headway=jnp.array(0.3)), 9.0))
    return jnp.clip(jnp.min(jnp.stack(asked)), -8.0, 2.5)


def looked_at(stations: Array, points: Array) -> tuple[Float[Array, "grid 2"], Float[Array, "grid 2"], Float[Array, "grid"]]:
    """Points of the way ahead, its direction there, and their stations, as far as others are looked for."""
    grid = jnp.array(GRID)
    way = at(stations, points, grid)
    step = jnp.diff(way, axis=0)
    tangent = jnp.concatenate([step, step[-1:]])
    return way, tangent / jnp.sqrt(jnp.sum(tangent**2, axis=1, keepdims=True) + 1e-9), grid


def speed_for_bends(stations: Array, points: Array, desired: Array) -> Float[Array, ""]:
    """The speed from which all bends ahead can still be taken at GRIP after braking at COMFORT."""
    bend = bends(points)
    allowed = jnp.sqrt(GRIP / jnp.maximum(bend, 1e-3) + 2 * COMFORT * jnp.maximum(0, stations[1:-1] - 2.0))
    return jnp.minimum(desired, jnp.min(allowed))


def bends(points: Array) -> Float[Array, "points-2"]:
    """Curvature of the way at each point but the first and the last, 1/m."""
    legs = jnp.diff(points, axis=0)
    heading = jnp.arctan2(legs[:, 1], legs[:, 0])
    length = jnp.sqrt(jnp.sum(legs**2, axis=1) + 1e-6)
    return jnp.abs(jnp.diff(heading)) / (0.5 * (length[1:] + length[:-1]))


def ahead_of_me(way: Array, tangent: Array, grid: Array, users: Array, speed: Array) -> tuple[Float[Array, "users"], Float[Array, "users"]]:
    """Of each road user: m to it along the way (far if it is not in it), and how fast that gap closes."""

    def one(user: Array) -> tuple[Array, Array]:
        half = jnp.where(user[9] > 0, 0.0, 0.5 * user[7] - 0.5)
        spots = user[1:3] + jnp.array([-1.0, 0.0, 1.0])[:, None] * half * user[3:5]
        reach = jnp.where(user[9] > 0, WITHIN["walker"], WITHIN["vehicle"])
        inside = jnp.min(jnp.sqrt(jnp.sum((way[:, None] - spots) ** 2, axis=-1) + 1e-9), axis=1) < reach
        behind = (user[1] < 0) & (jnp.abs(user[2]) < 2.5)
        first = jnp.argmax(inside)
        there = (user[0] > 0) & jnp.any(inside) & ~behind
        gap = grid[first] + jnp.where(user[9] > 0, -0.5, 0.8) - CAR[0] / 2
        along = jnp.maximum(0.0, jnp.sum(user[5:7] * tangent[first]))
        return jnp.where(there, jnp.maximum(gap, 0.3), 1e3), jnp.where(there, speed - along, 0.0)

    return jax.vmap(one)(users)


def expected(velocity: Float[Array, "2"], yaw_rate: Array, after: Float[Array, "times"]) -> Float[Array, "times 2"]:
    """Where somebody who keeps its speed and its rate of turning will be, from where it is, m."""
    straight = jnp.abs(yaw_rate) < 0.02
    rate = jnp.where(straight, 1.0, yaw_rate)
    ahead, aside = jnp.sin(rate * after) / rate, (1 - jnp.cos(rate * after)) / rate
    ahead, aside = jnp.where(straight, after, ahead), jnp.where(straight, 0.0, aside)
    return ahead[:, None] * velocity + aside[:, None] * jnp.stack([-velocity[1], velocity[0]])


def first_clash(way: Array, grid: Array, users: Array, speed: Array, route: Array, margin: Array) -> Float[Array, ""]:
    """M along the way to where somebody who goes first would cross it about when I am there; far if nobody would.

    People on foot always go first. Vehicles do where the route gives way, until it is clear of them.
    """
    mine = (-speed + jnp.sqrt(speed**2 + 2 * 1.5 * grid)) / 1.5
    mine = jnp.maximum(mine, grid / 7.0)
    after = jnp.array(AFTER)

    def one(user: Array) -> Array:
        walks = user[9] > 0
        moving = jnp.sum(user[5:7] ** 2) > 0.25
        spots = user[1:3] + expected(user[5:7], user[10], after)
        reach = jnp.where(walks, CROSSES["walker"], CROSSES["vehicle"])
        meets = jnp.sqrt(jnp.sum((way[:, None] - spots) ** 2, axis=-1)) < reach  # (grid, after)
        early, late = jnp.where(walks, 1.2, margin), jnp.where(walks, 1.0, 0.8)
        when = (after > mine[:, None] - late - 0.4) & (after < mine[:, None] + early)
        same_way = jnp.sum(user[5:7] * jnp.array([1.0, 0.0])) > 0.8 * jnp.sqrt(jnp.sum(user[5:7] ** 2) + 1e-6)
        goes_first = walks | ((route[9] > 0.5) & ~same_way)
        clashes = jnp.any(meets & when, axis=1)
        return jnp.where((user[0] > 0) & moving & goes_first & jnp.any(clashes), grid[jnp.argmax(clashes)] - reach, 1e3)

    return jnp.min(jax.vmap(one)(users))
