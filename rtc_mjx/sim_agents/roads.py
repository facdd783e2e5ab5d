"""How an agent stands to the road at one time (Waymo Open Sim Agents: map and traffic light features)."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rtc_mjx.geometry import corners, off_road, point_to_segment
from rtc_mjx.sim_agents.inputs import RoadEdges, StopLines

STRETCH = 3.0  # of heights when the nearest edge is looked for


def distance_to_road_edge(pose: Float[Array, "4"], size: Float[Array, "3"], edges: RoadEdges) -> Float[Array, ""]:
    """How far the worst of the four lower corners of a box is past the nearest road edge, m; negative on the road.

    Distances are in the plane. The road lies to the left of its edge, and edges of another level are far away: heights count threefold.
    """
    plane = corners(pose[jnp.array([0, 1, 3])], size[:2])
    low = jnp.full((4, 1), pose[2] - 0.5 * size[2])
    points = jnp.concatenate([plane, low], axis=1)
    return jnp.max(jax.vmap(lambda point: off_road(point, edges.segments, edges.valid, stretch=STRETCH))(points))


def runs_red(
    before: Float[Array, "agents 2"], after: Float[Array, "agents 2"], lines: StopLines, red: Bool[Array, "lanes"]
) -> Bool[Array, "agents"]:
    """Whose centre crosses the stop line of the lane it is then on, while its signal is red.

    The stop line is at right angles to the lane's segment nearest to the stop; the lane one is on is the nearest in the plane. Its
    search is skipped at times when nobody crosses any red line.
    """
    way = _way_at(lines)
    behind = jnp.sum((before[:, None] - lines.stop) * way, axis=-1) < 0
    beyond = jnp.sum((after[:, None] - lines.stop) * way, axis=-1) > 0
    crossed = behind & beyond & red
    return lax.cond(jnp.any(crossed), lambda: jnp.any(crossed & _on_lane(after, lines), axis=1), lambda: jnp.zeros(len(after), bool))


def _distances(point: Float[Array, "2"], lanes: Float[Array, "lanes points 2"]) -> Float[Array, "lanes legs"]:
    """Of a point from the legs of lanes, m."""
    a, b = lanes[:, :-1], lanes[:, 1:]
    return point_to_segment(jnp.broadcast_to(point, a.shape), a, b)


def _on_lane(points: Float[Array, "agents 2"], lines: StopLines) -> Bool[Array, "agents lanes"]:
    there = jnp.any(lines.lanes != lines.lanes[:, :1], axis=(1, 2))
    nearest = jax.vmap(lambda point: jnp.argmin(jnp.where(there, jnp.min(_distances(point, lines.lanes), axis=1), jnp.inf)))(points)
    return jnp.arange(len(there)) == nearest[:, None]


def _way_at(lines: StopLines) -> Float[Array, "lanes 2"]:
    """Along each lane's leg nearest to its stop, its length included."""

    def one(lane: Array, stop: Array) -> Array:
        legs = jnp.diff(lane, axis=0)
        real = jnp.any(legs != 0, axis=1)
        return legs[jnp.argmin(jnp.where(real, _distances(stop, lane[None])[0], jnp.inf))]

    return jax.vmap(one)(lines.lanes, lines.stop)
