"""Speeds and accelerations from poses, by central differences at 10 Hz (Waymo Open Sim Agents: trajectory features)."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rtc_mjx.geometry import length, wrapped
from rtc_mjx.logs import RATE


def kinematics(pose: Float[Array, "agents times 4"]) -> dict[str, Float[Array, "agents times"]]:
    """Linear (m/s, m/s^2, in space) and angular (rad/s, rad/s^2) speed and acceleration of x, y, z, heading.

    Linear acceleration is the change of the linear speed, so braking is negative. Differences of headings are wrapped over two steps, so
    turns up to half of pi a step are told apart. What has no neighbour on both sides is 0: see `differenced` for which that is.
    """
    speed = length(_central(pose[..., :3].swapaxes(-1, -2)).swapaxes(-1, -2)) * RATE
    turn = wrapped(2 * _central(pose[..., 3])) / 2  # rad a step
    return {
        "linear_speed": speed,
        "linear_acceleration": _central(speed) * RATE,
        "angular_speed": turn * RATE,
        "angular_acceleration": wrapped(2 * _central(turn)) / 2 * RATE**2,
    }


def plane_speed(pose: Float[Array, "agents times 4"]) -> Float[Array, "agents times"]:
    """Speed in the plane, m/s."""
    return length(_central(pose[..., :2].swapaxes(-1, -2)).swapaxes(-1, -2)) * RATE


def differenced(valid: Bool[Array, "agents times"]) -> Bool[Array, "agents times"]:
    """Where a central difference is known: both neighbours in time are valid, there being two. Twice for accelerations."""
    ends = jnp.zeros_like(valid[..., :1])
    return jnp.concatenate([ends, valid[..., 2:] & valid[..., :-2], ends], axis=-1)


def _central(values: Float[Array, "*batch times"]) -> Float[Array, "*batch times"]:
    """Half the difference between the neighbours in time; 0 at the ends."""
    ends = jnp.zeros_like(values[..., :1])
    return jnp.concatenate([ends, (values[..., 2:] - values[..., :-2]) / 2, ends], axis=-1)
