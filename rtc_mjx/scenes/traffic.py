"""The other road users of generated scenes: xi. They follow their paths, each other, signals and chance, but never the agent.

That the agent cannot move them is what a log is like, and what makes an agent's own choice and its surroundings independent: the
same xi can be driven by many experts. So nobody drives where it would have to give way to the agent.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from rtc_mjx.geometry import curvature, pose_at
from rtc_mjx.logs import AMBER, NO_SIGNAL, RATE, RED
from rtc_mjx.pytree import pytree

TICK = 1 / RATE  # s
GRIP = 2.5  # m/s^2, sideways, that drivers allow themselves in a bend
COMFORT = 2.0  # m/s^2, braking that drivers aim at
AMBER_LIMIT = 3.0  # m/s^2, braking above which a driver goes on at amber
HARDEST = 7.0  # m/s^2, the strongest braking of a replayed driver
STANDSTILL = 2.0  # m between bumpers in a queue


@pytree
class Drivers:
    """Vehicles along paths.

    Attributes:
        paths: points `spacing` m apart.
        station: of the vehicle's centre at t = 0, m.
        speed: at t = 0, m/s.
        desired: speed on a free straight road, m/s.
        headway: to the vehicle in front, s.
        length: of the vehicle, m.
        leader: the vehicle that it follows at first, -1 for none ...
        until: ... up to this station of its own, where their ways part, m.
        stop: station of its stop line, m.
        signals: at each time, of its approach.
        brakes: the time at which it brakes hard for no visible reason, s; beyond the log for never.
        brakes_for: how long, s.
    """

    paths: Float[Array, "*n points 2"]
    station: Float[Array, "*n"]
    speed: Float[Array, "*n"]
    desired: Float[Array, "*n"]
    headway: Float[Array, "*n"]
    length: Float[Array, "*n"]
    leader: Int[Array, "*n"]
    until: Float[Array, "*n"]
    stop: Float[Array, "*n"]
    signals: Int[Array, "times *n"]
    brakes: Float[Array, "*n"]
    brakes_for: Float[Array, "*n"]


def nothing_to_stop_for(count: int, times: int) -> dict[str, Array]:
    """The part of `Drivers` that says when they stop, where there are no signals and nobody brakes without a reason."""
    return {
        "stop": jnp.full(count, 1e4),
        "signals": jnp.full((times, count), NO_SIGNAL),
        "brakes": jnp.full(count, 1e3),
        "brakes_for": jnp.zeros(count),
    }


@pytree
class Walkers:
    """People who cross, straight from one kerb to the other.

    Attributes:
        start: where, m.
        goal: whereto, m.
        speed: m/s.
        ready: when they arrive at the kerb, s; they may have set out before t = 0.
        may_go: at each time, whether they may step onto the road.
    """

    start: Float[Array, "*n 2"]
    goal: Float[Array, "*n 2"]
    speed: Float[Array, "*n"]
    ready: Float[Array, "*n"]
    may_go: Array


def follow_the_leader(
    speed: Array, wanted: Array, gap: Array, closing: Array, *, headway: Array, most: float | Array = 1.8, comfort: float | Array = COMFORT
) -> Float[Array, ""]:
    """Acceleration in m/s^2 of the intelligent driver model (Treiber et al. 2000): free road, and one thing ahead.

    Args:
        speed: own, m/s.
        wanted: on a free road, m/s.
        gap: bumper to bumper, m.
        closing: own speed minus that of what is ahead, m/s.
        headway: wanted, s.
        most: acceleration, m/s^2.
        comfort: braking, m/s^2.
    """
    free = most * (1 - jnp.where(speed <= wanted, (speed / jnp.maximum(wanted, 0.1)) ** 4, 1.0))
    too_fast = -comfort * jnp.clip((speed - wanted) / 1.0, 0, 2)
    distance = STANDSTILL + jnp.maximum(0, speed * headway + speed * closing / (2 * jnp.sqrt(most * comfort)))
    return free + too_fast - most * (distance / jnp.maximum(gap, 0.3)) ** 2


def slow_for_bends(path: Float[Array, "points 2"], spacing: float, desired: Array) -> Float[Array, "points"]:
    """The speed in m/s that a driver allows itself at each point: bends at GRIP, and braking for them at COMFORT."""
    bend = jnp.minimum(desired, jnp.sqrt(GRIP / jnp.maximum(jnp.abs(curvature(path, spacing)), 1e-4)))

    def back(ahead: Array, here: Array) -> tuple[Array, Array]:
        allowed = jnp.minimum(here, jnp.sqrt(ahead**2 + 2 * COMFORT * spacing))
        return allowed, allowed

    return lax.scan(back, bend[-1], bend, reverse=True)[1]


def must_stop(speed: Array, distance: Array, signal: Array, limit: float | Array = AMBER_LIMIT) -> Array:
    """Whether a driver stops for a signal `distance` m ahead: at red, and at amber if the braking it takes is below a limit."""
    needed = speed**2 / (2 * jnp.maximum(distance, 0.1))
    return (distance > -0.5) & ((signal == RED) | ((signal == AMBER) & (needed < limit)))


def drive(drivers: Drivers, spacing: float, times: int) -> tuple[Float[Array, "times n 3"], Float[Array, "times n"]]:
    """Poses and speeds of all vehicles at `RATE`."""
    limits = jax.vmap(lambda path, desired: slow_for_bends(path, spacing, desired))(drivers.paths, drivers.desired)

    def tick(carry: tuple[Array, Array], now: tuple[Array, Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        (station, speed), (time, signals) = carry, now
        wanted = jax.vmap(lambda limit, s: jnp.interp(s + 1.0, spacing * jnp.arange(limit.shape[0]), limit))(limits, station)
        ahead = drivers.leader
        follows = (ahead >= 0) & (station < drivers.until)
        gap = jnp.where(follows, station[ahead] - station - 0.5 * (drivers.length + drivers.length[ahead]), 1e3)
        closing = jnp.where(follows, speed - speed[ahead], 0.0)
        model = jax.vmap(lambda *x: follow_the_leader(x[0], x[1], x[2], x[3], headway=x[4]))
        pull = model(speed, wanted, gap, closing, drivers.headway)
        line = drivers.stop - station - 0.5 * drivers.length
        at_line = model(speed, wanted, line + 1.0, speed, drivers.headway)
        pull = jnp.where(jax.vmap(must_stop)(speed, line, signals), jnp.minimum(pull, at_line), pull)
        braking = (time >= drivers.brakes) & (time < drivers.brakes + drivers.brakes_for)
        pull = jnp.clip(jnp.where(braking, -5.0, pull), -HARDEST, 2.5)
        after = jnp.maximum(0.0, speed + TICK * pull)
        return (station + TICK * 0.5 * (speed + after), after), (station, speed)

    clock = TICK * jnp.arange(times)
    _, (station, speed) = lax.scan(tick, (drivers.station, drivers.speed), (clock, drivers.signals))
    poses = jax.vmap(lambda path, s: jax.vmap(lambda one: pose_at(path, spacing, one))(s), in_axes=(0, 1), out_axes=1)(
        drivers.paths, station
    )
    return poses, speed


def walk(walkers: Walkers, times: int) -> tuple[Float[Array, "times n 3"], Float[Array, "times n"]]:
    """Poses and speeds of all walkers at `RATE`: they wait at the kerb until they may go, then walk across."""
    way = walkers.goal - walkers.start
    far = jnp.sqrt(jnp.sum(way**2, axis=-1))
    early = jnp.clip(-walkers.ready * walkers.speed, 0, far)

    def tick(gone: Array, now: tuple[Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        time, may_go = now
        walks = ((gone > 0) | ((time >= walkers.ready) & may_go)) & (gone < far)
        speed = jnp.where(walks, walkers.speed, 0.0)
        return jnp.minimum(far, gone + TICK * speed), (gone, speed)

    _, (gone, speed) = lax.scan(tick, early, (TICK * jnp.arange(times), walkers.may_go))
    place = walkers.start + (gone / far)[..., None] * way
    heading = jnp.broadcast_to(jnp.arctan2(way[:, 1], way[:, 0]), gone.shape)
    return jnp.concatenate([place, heading[..., None]], axis=-1), speed
