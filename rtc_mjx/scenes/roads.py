"""Pieces of generated roads: straight and bent lanes, and the kerbs of a junction of four arms."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rtc_mjx.geometry import rotate

POINTS = 24  # of a lane
BEND = 8  # pieces of a kerb's bend


def straight(start: Float[Array, "2"], end: Float[Array, "2"]) -> Float[Array, "points 2"]:
    """A straight lane."""
    return start + jnp.linspace(0, 1, POINTS)[:, None] * (end - start)


def arc(centre: Float[Array, "2"], radius: Array, start: float, angle: float) -> Float[Array, "points 2"]:
    """A bend about a centre, from a bearing (rad) through an angle."""
    bearing = start + jnp.linspace(0, 1, POINTS) * angle
    return centre + radius * jnp.stack([jnp.cos(bearing), jnp.sin(bearing)], axis=1)


def ring_edges(width: Array, corner: Array, arm: float) -> Float[Array, "edges 2 2"]:
    """Kerbs of four arms of one lane each way: between two arms in, round the corner, out; the road to the left."""
    bend = width + corner
    bearing = jnp.pi - jnp.linspace(0, 1, BEND + 1) * jnp.pi / 2
    curve = jnp.array([1.0, -1.0]) * bend + corner * jnp.stack([jnp.cos(bearing), jnp.sin(bearing)], axis=1)
    first, last = jnp.stack([width, -bend - arm])[None], jnp.stack([bend + arm, -width])[None]
    line = jnp.concatenate([first, curve, last])
    one = jnp.stack([line[:-1], line[1:]], axis=1)
    return jnp.concatenate([rotate(one, jnp.array(k * jnp.pi / 2)) for k in range(4)])
