"""Where an agent can go within a scene, told from how it starts alone: roads there are kept before those that are merely near.

A road counts as far as it is from the nearest place that the agent can reach along lanes, and as a share of the way to that place. So
an edge beside the lane that it is on, 200 m ahead, comes before a street three blocks away. Nothing of the logged path is looked at:
which roads are kept tells nothing of where the agent went.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from rtc_mjx.logs.levels import sampled, sampled_along, ways_on
from rtc_mjx.logs.road import Roads

SECONDS = 9.0  # of a scene
GAIN = 2.0  # m/s^2, by which an agent may become faster all the time
FARTHEST = 300.0  # m along lanes; who starts faster than 24 m/s may get farther
BESIDE = 6.0  # m to lanes that an agent may change to
DISCOUNT = 0.2  # m that a metre of the way to a place counts


def reachable(roads: Roads, start: Float[np.ndarray, "3"], heading: float, speed: float) -> Float[np.ndarray, "places 3"]:
    """Where an agent can get to along lanes, its start first: x and y in m, and what the way there counts, m.

    Args:
        roads: of the recording.
        start: where the agent is at t = 0, on the ground.
        heading: of the agent, rad.
        speed: of the agent, m/s.
    """
    reach = min(FARTHEST, SECONDS * speed + 0.5 * GAIN * SECONDS**2)
    begins = ways_on(roads, start, heading, reach, BESIDE)
    lanes = list(begins)
    held, along = sampled_along(roads.lanes[lanes])
    station = np.array(list(begins.values()))[held.owner] + along
    there = (station >= 0) & (station <= reach)
    places = np.column_stack([held.points[there, :2], DISCOUNT * station[there]])
    return np.concatenate([[[start[0], start[1], 0.0]], places])


def remoteness(shapes: Float[np.ndarray, "shapes points 3"], places: Float[np.ndarray, "places 3"]) -> Float[np.ndarray, "shapes"]:
    """Of lines or areas, how far each is from where an agent can get, m: what the way to a place counts is a third dimension."""
    held = sampled(shapes)
    corners = shapes[..., :2].reshape(-1, 2)  # as well as what lies between them: lanes that part at a point are equally far
    points, owner = np.concatenate([corners, held.points[:, :2]]), np.concatenate([np.arange(len(corners)) // shapes.shape[1], held.owner])
    away, _ = cKDTree(places).query(np.column_stack([points, np.zeros(len(points))]))
    out = np.full(len(shapes), np.inf)
    np.minimum.at(out, owner, away)
    return out
