"""Pieces of generated roads: straight and bent lanes, and the kerbs of a junction of four arms."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from rtc_mjx.geometry import polyline_length, resample, rotate

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
    one = as_segments(line)
    return jnp.concatenate([rotate(one, jnp.array(k * jnp.pi / 2)) for k in range(4)])


def bezier(start: Array, start_heading: Array, end: Array, end_heading: Array, reach: float) -> Float[Array, "points 2"]:
    """A lane that leaves one pose and arrives at another, smoothly (cubic Bezier with handles of `reach` m)."""

    def way(heading: Array) -> Array:
        return reach * jnp.stack([jnp.cos(heading), jnp.sin(heading)])

    share = jnp.linspace(0, 1, POINTS)[:, None]
    controls = (start, start + way(jnp.asarray(start_heading)), end - way(jnp.asarray(end_heading)), end)
    weights = ((1 - share) ** 3, 3 * (1 - share) ** 2 * share, 3 * (1 - share) * share**2, share**3)
    return sum((w * c for w, c in zip(weights, controls, strict=True)), jnp.zeros((POINTS, 2)))


def beside(line: Float[Array, "points 2"], offset: Array) -> Float[Array, "points 2"]:
    """A line to the left (right if negative) of another, m."""
    ways = jnp.diff(line, axis=0)
    ways = jnp.concatenate([ways, ways[-1:]])
    normal = jnp.stack([-ways[:, 1], ways[:, 0]], axis=1) / jnp.maximum(jnp.sqrt(jnp.sum(ways**2, axis=1, keepdims=True)), 1e-9)
    return line + offset * normal


def as_segments(line: Float[Array, "points 2"]) -> Float[Array, "pieces 2 2"]:
    """The pieces of a line."""
    return jnp.stack([line[:-1], line[1:]], axis=1)


def thinned(line: Float[Array, "points 2"], count: int) -> Float[Array, "count 2"]:
    """A line by fewer points, at equal distances."""
    return resample(line, jnp.linspace(0, polyline_length(line), count))
