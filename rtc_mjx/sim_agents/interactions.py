"""How one agent stands to the others at one time (Waymo Open Sim Agents: interaction features). Heights do not count here."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rtc_mjx.geometry import box_gap, rotate, shadow, wrapped

ROUNDING = 0.7  # of half the smaller side: the radius of a box's corners; 1 would be a capsule
SAME_WAY = math.radians(75.0)  # beyond it, whoever is ahead is not followed
SAME_WAY_AT_THE_EDGE = math.radians(10.0)  # instead, where the two overlap sideways by less than EDGE
EDGE = 0.5  # m
LONGEST = 5.0  # s; also the time to collision of who follows nobody or does not close in


def nearest_gap(
    agent: Int[Array, ""], pose: Float[Array, "agents 3"], size: Float[Array, "agents 2"], valid: Bool[Array, "agents"]
) -> Float[Array, ""]:
    """Signed distance in m to the nearest other box, corners rounded; negative in a collision, infinite where nobody else is valid."""
    radius = 0.5 * ROUNDING * jnp.min(size, axis=-1)
    core = size - 2 * radius[:, None]
    gap = box_gap(pose[agent], core[agent], pose, core) - radius - radius[agent]
    return jnp.min(jnp.where(valid & (jnp.arange(len(valid)) != agent), gap, jnp.inf))


def time_to_collision(
    agent: Int[Array, ""],
    pose: Float[Array, "agents 3"],
    size: Float[Array, "agents 2"],
    speed: Float[Array, "agents"],
    valid: Bool[Array, "agents"],
    moving: Bool[Array, "agents"],
) -> Float[Array, ""]:
    """Seconds until the front of an agent reaches the rear of whom it follows, both keeping their speeds; at most LONGEST.

    It follows the nearest box that begins ahead of its own front, overlaps the strip it is about to sweep, and points the same way:
    within 75 degrees, or within 10 where they overlap by less than 0.5 m. The difference of headings is wrapped; the public code does not.

    Args:
        agent: whose time it is.
        pose: x, y, heading.
        size: length and width in m.
        speed: in the plane, m/s.
        valid: who is there.
        moving: whose speed is known.
    """
    ahead, overlap = _ahead(pose[agent], size[agent], pose, size)
    turned = jnp.abs(wrapped(pose[:, 2] - pose[agent, 2]))
    same_way = (turned <= SAME_WAY) & ((overlap > EDGE) | (turned <= SAME_WAY_AT_THE_EDGE))
    gap = jnp.where(valid & (ahead > 0) & (overlap > 0) & same_way, ahead, jnp.inf)
    leader = jnp.argmin(gap)
    closing = speed[agent] - speed[leader]
    known = jnp.isfinite(gap[leader]) & (closing > 0) & moving[agent] & moving[leader]
    return jnp.minimum(LONGEST, jnp.where(known, ahead[leader], LONGEST) / jnp.where(known, closing, 1.0))


def _ahead(pose: Float[Array, "3"], size: Float[Array, "2"], others: Array, sizes: Array) -> tuple[Array, Array]:
    """How far the rearmost corners of boxes are ahead of one's front, and by how much they overlap the strip ahead, m."""
    turned = others[:, 2] - pose[2]
    place = rotate(others[:, :2] - pose[:2], jnp.broadcast_to(-pose[2], turned.shape))
    reach = 0.5 * size + shadow(sizes, turned)
    return place[:, 0] - reach[:, 0], reach[:, 1] - jnp.abs(place[:, 1])
