"""What is scored, and against what: agents as they were logged and as they were simulated, road edges, signals. SI units."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from rtc_mjx.logs import RED, LoggedScene
from rtc_mjx.pytree import pytree


@pytree
class LoggedAgents:
    """All agents of a scene over its history, up to and with the current time, and its future.

    Attributes:
        pose: x, y, z in m, of the centre, and heading in rad.
        valid: when each is there. Who is not there at the current time is not simulated and counts for nothing.
        size: length, width, height in m, at the current time.
        vehicle: which are vehicles: time to collision and red lights are scored for these only.
    """

    pose: Float[Array, "agents times 4"]
    valid: Bool[Array, "agents times"]
    size: Float[Array, "agents 3"]
    vehicle: Bool[Array, "agents"]


@pytree
class RoadEdges:
    """Segments of road edges, the road to their left.

    Attributes:
        segments: both ends of each in m, with heights.
        valid: which of them are there.
    """

    segments: Float[Array, "edges 2 3"]
    valid: Bool[Array, "edges"]


@pytree
class StopLines:
    """Lanes and the signals at their stop lines.

    Attributes:
        lanes: centre lines in m; after its last point a lane repeats it. A lane that is not there has all points alike.
        stop: where to stop for each lane's signal, m; any point where it has none.
        red: when each lane's signal says stop, at the times of the log. A lane without a signal is never red.
    """

    lanes: Float[Array, "lanes points 2"]
    stop: Float[Array, "lanes 2"]
    red: Bool[Array, "times lanes"]


def stop_lines(scene: LoggedScene) -> StopLines:
    """Those of a logged scene, which keeps no stop points: one stops before the start of a lane whose signal is red.

    Recordings of the Waymo Open Motion Dataset have their stop points there; `recorded.of_recording` takes them as logged.
    """
    return StopLines(scene.road.lanes, scene.road.lanes[:, 0], jnp.asarray(scene.signals == RED))
