"""How agents stand to the road (Waymo Open Sim Agents: map and traffic light features)."""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rtc_mjx.geometry import corners, nearest_edge, nearest_edges, past_edge
from rtc_mjx.sim_agents.inputs import RoadEdges, StopLines

STRETCH = 3.0  # of heights when the nearest edge is looked for


def distance_to_road_edge(
    pose: Float[Array, "agents times 4"], size: Float[Array, "agents 3"], edges: RoadEdges
) -> Float[Array, "agents times"]:
    """How far the worst of the four lower corners of a box is past the nearest road edge, m; negative on the road, -inf without edges.

    Distances are in the plane. The road lies to the left of its edge, and edges of another level are far away: heights count threefold.
    """
    plane = corners(pose[..., jnp.array([0, 1, 3])], jnp.broadcast_to(size[:, None, :2], (*pose.shape[:2], 2)))
    low = jnp.broadcast_to((pose[..., 2] - 0.5 * size[:, None, 2])[..., None, None], (*plane.shape[:-1], 1))
    points = jnp.concatenate([plane, low], axis=-1).reshape(-1, 3)
    nearest = nearest_edges(points, edges.segments, edges.valid, stretch=STRETCH)
    past = jax.vmap(past_edge)(points, edges.segments[nearest]).reshape(plane.shape[:-1])
    return jnp.where(jnp.any(edges.valid), jnp.max(past, axis=-1), -jnp.inf)


def runs_red(place: Float[Array, "agents times 2"], lines: StopLines, red: Bool[Array, "times lanes"]) -> Bool[Array, "agents times"]:
    """When an agent's centre has just crossed the stop line of the lane it is on, while that lane's signal is red; never at the first time.

    The stop line is at right angles to the lane's leg nearest to the stop; the lane one is on is the nearest in the plane. Which that is
    takes long to find, and is only looked for at times at which somebody crosses a red line.
    """
    legs = jnp.stack([lines.lanes[:, :-1], lines.lanes[:, 1:]], axis=2)
    real = jnp.any(legs[:, :, 0] != legs[:, :, 1], axis=-1)
    at_stop = legs[jnp.arange(len(legs)), jax.vmap(nearest_edge)(lines.stop, legs, real)]
    way = at_stop[:, 1] - at_stop[:, 0]
    along = jnp.sum((place[:, :, None] - lines.stop) * way, axis=-1)
    crossed = (along[:, :-1] < 0) & (along[:, 1:] > 0) & red[1:]

    def at(moment: tuple[Array, Array]) -> Array:
        here, crossed = moment

        def on_its_lane() -> Array:
            nearest = jax.vmap(lambda point: nearest_edge(point, legs.reshape(-1, 2, 2), real.reshape(-1)))(here) // legs.shape[1]
            return crossed[jnp.arange(len(here)), nearest]

        return lax.cond(jnp.any(crossed), on_its_lane, lambda: jnp.zeros(len(here), bool))

    found = lax.map(at, (place[:, 1:].swapaxes(0, 1), crossed.swapaxes(0, 1)))
    return jnp.concatenate([jnp.zeros((len(place), 1), bool), found.T], axis=1)
