"""All features of one trajectory of a scene, logged or simulated: of each scored agent at each time after the current one.

They follow the public definitions of the Waymo Open Sim Agents Challenge (waymo_open_dataset, sim_agents_metrics; Montali et al. 2023,
arXiv 2305.12032, with the features of 2025), written anew.
"""

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from rtc_mjx.sim_agents.inputs import RoadEdges, StopLines
from rtc_mjx.sim_agents.interactions import nearest_gap, time_to_collision
from rtc_mjx.sim_agents.kinematics import differenced, kinematics, plane_speed
from rtc_mjx.sim_agents.roads import distance_to_road_edge, runs_red


def features(
    pose: Float[Array, "agents times 4"],
    valid: Bool[Array, "agents times"],
    size: Float[Array, "agents 3"],
    scored: Int[Array, "scored"],
    edges: RoadEdges,
    lines: StopLines | None,
    *,
    future: int,
) -> dict[str, Array]:
    """Per scored agent and future time: motion, distances, time to collision; whether it collides, is off-road, runs a red.

    Where there are no stop lines, nobody runs a red.

    Args:
        pose: x, y, z, heading of all agents over history and future; any number where they are not valid.
        valid: who is there.
        size: length, width, height in m.
        scored: indices of the agents that are scored.
        edges: of the road.
        lines: stop lines and their signals.
        future: how many of the times come after the current one.
    """
    pose = jnp.where(valid[..., None], pose, 0.0)
    motion = {name: values[:, -future:] for name, values in kinematics(pose[scored]).items()}
    around = _around(pose, valid, size[:, :2], scored, future)
    edge = distance_to_road_edge(pose[scored, -future:], size[scored], edges)
    present = valid[scored, -future:]
    red = (
        jnp.zeros((len(scored), future), bool)
        if lines is None
        else runs_red(pose[scored, -future - 1 :, :2], lines, lines.red[-future - 1 :])[:, 1:]
    )
    return {
        **motion,
        **around,
        "distance_to_road_edge": edge,
        "collision": (around["distance_to_nearest_object"] < 0) & present,
        "offroad": (edge > 0) & present,
        "traffic_light_violation": red & present & valid[scored, -future - 1 : -1],
    }


def _around(pose: Array, valid: Array, size: Array, scored: Array, future: int) -> dict[str, Array]:
    """How agents stand to the others. One time is looked at after the other: memory does not grow with their number."""

    def at(moment: tuple[Array, Array, Array, Array]) -> dict[str, Array]:
        plane, speed, valid, moving = moment

        def one(agent: Array) -> dict[str, Array]:
            return {
                "distance_to_nearest_object": nearest_gap(agent, plane, size, valid),
                "time_to_collision": time_to_collision(agent, plane, size, speed, valid, moving),
            }

        return jax.vmap(one)(scored)

    moments = (pose[..., jnp.array([0, 1, 3])], plane_speed(pose), valid, differenced(valid))
    found = lax.map(at, jax.tree.map(lambda x: x[:, -future:].swapaxes(0, 1), moments))
    return {name: values.T for name, values in found.items()}
