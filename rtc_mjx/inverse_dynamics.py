"""Expert actions of logged cars: the controls under which the MJX car follows what was logged, found through the simulator itself.

    logged poses -> feedforward guess + a driver who corrects what is off -> rollout -> how far off -> through physics -> better guess

The driver in the loop makes late errors depend on late controls only, so that the problem is well conditioned; what is kept are the
controls it put out, which replayed without it give the same motion. Nobody else is in the world: contacts are not part of the log.
"""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Float

from rtc_mjx.geometry import rotate, wrapped
from rtc_mjx.physics import PhysicsState, World, control_step, load, rest_state, rest_surroundings, specialised_step
from rtc_mjx.physics.car import CONTROL_UNIT, WHEELBASE
from rtc_mjx.pytree import pytree

CATCH_UP, MATCH = 1.0, 1.6  # 1/s^2 and 1/s: how the driver makes up for distance, and for speed
AHEAD, NEAREST = 0.9, 4.0  # s and m, how far ahead it looks for its way back to the path
HEADING_ARM = 1.5  # m by which an error in heading counts like one in position
SLOWEST = 1.0  # m/s, below which a path has no curvature
AT_ONCE = 256  # cars whose controls are looked for together


@dataclass(frozen=True)
class FitOptions:
    """How controls are looked for.

    Attributes:
        updates: of the guess.
        learning_rate: Adam's, in units of the controls; falls to a hundredth along a cosine.
        smoothness: weight of the changes from step to step, in units of the controls, beside squared metres.
    """

    updates: int = 150
    learning_rate: float = 0.1
    smoothness: float = 1e-4


@pytree
class Fit:
    """What was found for one car.

    Attributes:
        actions: drive in m/s^2 and steer in rad at each control step.
        position_error: m from the logged place at each time.
        heading_error: rad from the logged heading, unsigned.
    """

    actions: Float[Array, "*batch steps 2"]
    position_error: Float[Array, "*batch times"]
    heading_error: Float[Array, "*batch times"]


def start_of(poses: Float[Array, "times 3"], velocity: Float[Array, "2"], step: float) -> PhysicsState:
    """The car where, as fast and turning as it was logged first; its front wheels stand as the path bends."""
    turn = wrapped(poses[1, 2] - poses[0, 2]) / step
    speed = jnp.sum(velocity * jnp.stack([jnp.cos(poses[0, 2]), jnp.sin(poses[0, 2])]))
    steer = jnp.where(jnp.abs(speed) > SLOWEST, jnp.arctan(WHEELBASE * turn / jnp.where(jnp.abs(speed) > SLOWEST, speed, 1.0)), 0.0)
    rest = rest_state(alone())
    return PhysicsState(
        jnp.concatenate([poses[0], jnp.clip(steer, -0.5, 0.5)[None]]),
        jnp.concatenate([velocity, turn[None], jnp.zeros(1)]),
        rest.warmstart,
    )


def fit(start: PhysicsState, poses: Float[Array, "times 3"], substeps: int, options: FitOptions = FitOptions()) -> Fit:
    """The controls under which the car follows a logged path, from a given start.

    Args:
        start: of the car.
        poses: x in m, y in m, heading in rad at each control step, T+1 of them.
        substeps: physics steps of a control step.
        options: of the search.
    """
    step = substeps * alone().timestep
    drive = functools.partial(follow, start, poses, substeps)
    schedule = optax.cosine_decay_schedule(options.learning_rate, options.updates, alpha=0.01)
    adam = optax.adam(schedule, b1=0.8, b2=0.95)

    def loss(guess: Array) -> Array:
        reached, actions = drive(guess)
        rough = jnp.diff(actions / jnp.array(CONTROL_UNIT), axis=0)
        return jnp.mean(_off(reached, poses)) + options.smoothness * jnp.mean(jnp.sum(rough**2, axis=1))

    def update(carry: tuple[Array, optax.OptState, Array, Array], _: None) -> tuple[tuple[Array, optax.OptState, Array, Array], None]:
        guess, moments, best, least = carry
        value, slope = jax.value_and_grad(loss)(guess)
        better = value < least  # false for NaN
        best, least = jnp.where(better, guess, best), jnp.where(better, value, least)
        move, moments = adam.update(jnp.where(jnp.isfinite(slope), slope, 0.0), moments)
        return (guess + move, moments, best, least), None

    first = first_guess(poses, step) / jnp.array(CONTROL_UNIT)
    (_, _, best, _), _ = lax.scan(update, (first, adam.init(first), first, jnp.array(jnp.inf)), length=options.updates)
    reached, actions = drive(best)
    return Fit(actions, jnp.sqrt(jnp.sum((reached - poses)[:, :2] ** 2, axis=1)), jnp.abs(wrapped(reached[:, 2] - poses[:, 2])))


def first_guess(poses: Float[Array, "times 3"], step: float) -> Float[Array, "steps 2"]:
    """Feedforward: the change of speed along the heading, and the curvature of the path."""
    speed = _speeds(poses, step)
    turn = wrapped(jnp.diff(poses[:, 2])) / step
    moving = jnp.abs(speed) > SLOWEST
    steer = jnp.where(moving, jnp.arctan(WHEELBASE * turn / jnp.where(moving, speed, 1.0)), 0.0)
    pull = jnp.concatenate([jnp.diff(speed), jnp.zeros(1)]) / step
    return jnp.stack([pull, steer], axis=1)


def _speeds(poses: Float[Array, "times 3"], step: float) -> Float[Array, "steps"]:
    """Along the heading, m/s; negative backwards."""
    way = jnp.diff(poses[:, :2], axis=0)
    return jnp.sum(way * jnp.stack([jnp.cos(poses[:-1, 2]), jnp.sin(poses[:-1, 2])], axis=1), axis=1) / step


def follow(start: PhysicsState, poses: Array, substeps: int, guess: Float[Array, "steps 2"]) -> tuple[Array, Array]:
    """Drives by the guess, in units of the controls, and corrects what is off; returns poses reached (T+1) and controls put out (T)."""
    world = alone()
    advance = control_step(world, substeps, specialised_step(world))
    low, high = jnp.asarray(world.mj.actuator_ctrlrange[list(world.control_ids)]).T
    step = substeps * world.timestep

    def body(state: PhysicsState, given: tuple[Array, Array, Array]) -> tuple[PhysicsState, tuple[Array, Array]]:
        pushed, wanted, speed = given
        off = rotate(wanted[:2] - state.qpos[:2], -state.qpos[2])
        own = rotate(state.qvel[:2], -state.qpos[2])
        reach = jnp.maximum(NEAREST, AHEAD * jnp.abs(own[0]))
        back = 2 * WHEELBASE * (off[1] / reach**2 + wrapped(wanted[2] - state.qpos[2]) / reach)
        correction = jnp.stack([CATCH_UP * off[0] + MATCH * (speed - own[0]), jnp.sign(own[0]) * back])
        action = jnp.clip(pushed * jnp.array(CONTROL_UNIT) + correction, low, high)
        state = advance(state, action, rest_surroundings(world))
        return state, (state.qpos[:3], action)

    _, (reached, actions) = lax.scan(body, start, (guess, poses[:-1], _speeds(poses, step)))
    return jnp.concatenate([start.qpos[None, :3], reached]), actions


def _off(reached: Float[Array, "times 3"], poses: Float[Array, "times 3"]) -> Float[Array, "times"]:
    """Squared distance of two poses, m^2."""
    turned = 1 - jnp.cos(reached[:, 2] - poses[:, 2])
    return jnp.sum((reached - poses)[:, :2] ** 2, axis=1) + 2 * HEADING_ARM**2 * turned


@functools.lru_cache(maxsize=1)
def alone() -> World:
    """The driving world with nobody but the car."""
    return load("driving", road_users=0)
