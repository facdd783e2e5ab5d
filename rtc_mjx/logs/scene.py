"""A logged scene: what a recording or a generator knows, and all that world, observation, metrics and pictures read of it.

Arrays have fixed lengths and masks, so that scenes stack. Metres, seconds, radians; x and y in the plane, heading from x to the
left. Times are at `RATE`.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rtc_mjx.pytree import pytree

RATE = 10.0  # Hz
NO_SIGNAL, RED, AMBER, GREEN = 0, 1, 2, 3
VEHICLE, PEDESTRIAN, CYCLIST = 1, 2, 3  # 0: no such road user


@pytree
class RoadGraph:
    """Where one may drive.

    Attributes:
        lanes: centre lines in m; after its last point a lane repeats it. A lane that is not there has all points alike.
        successors: for each lane, the lanes that go on from its end; -1 where there are fewer.
        gives_way: whether who drives along this lane must let others pass: 0 no, 1 those who come towards it, 2 everybody.
        edges: segments of road edges, the road to their left.
        edge_valid: which of them are there.
        crosswalks: corners of each in m; one that is not there has all corners alike.
    """

    lanes: Float[Array, "*batch lanes points 2"]
    successors: Int[Array, "*batch lanes next"]
    gives_way: Int[Array, "*batch lanes"]
    edges: Float[Array, "*batch edges 2 2"]
    edge_valid: Bool[Array, "*batch edges"]
    crosswalks: Float[Array, "*batch crosswalks 4 2"]


@pytree
class LoggedScene:
    """A scene as it was logged.

    Attributes:
        road: the road graph.
        signals: RED, AMBER, GREEN or NO_SIGNAL of each lane at each time; who has not yet entered the lane stops before its start.
        pose: x in m, y in m, heading in rad of each road user.
        velocity: in m/s, in the plane.
        size: length and width in m.
        kind: VEHICLE, PEDESTRIAN, CYCLIST, or 0 for none.
        valid: when each road user is there.
        controlled: which of them the agent drives.
    """

    road: RoadGraph
    signals: Int[Array, "*batch times lanes"]
    pose: Float[Array, "*batch users times 3"]
    velocity: Float[Array, "*batch users times 2"]
    size: Float[Array, "*batch users 2"]
    kind: Int[Array, "*batch users"]
    valid: Bool[Array, "*batch users times"]
    controlled: Int[Array, "*batch"]


def lane_exists(road: RoadGraph) -> Bool[Array, "*batch lanes"]:
    """Which lanes have a length."""
    return jnp.any(road.lanes != road.lanes[..., :1, :], axis=(-2, -1))
