"""Routes: the ways that the road graph offers from where an agent is at t = 0, as paths with all that stands along them.

controlled pose -> its lane -> successors, a few lanes deep -> one polyline a route -> points every 2 m, signals, give-way lines
"""

import dataclasses
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rtc_mjx.geometry import Pose, curvature, polyline_length, project, resample, wrapped
from rtc_mjx.logs import NO_SIGNAL, LoggedScene, RoadGraph
from rtc_mjx.pytree import pytree

SPACING = 2.0  # m between two points of a route
BEHIND = 10.0  # m of a route behind the agent's start
SEARCHED = 400  # points of a route among which the agent's start is looked for
NOWHERE = 1e3  # m, the station of a line that is not there


@dataclass(frozen=True)
class RouteOptions:
    """How far routes are followed.

    Attributes:
        count: routes kept; where the graph offers more, those that come last in the order of successors are dropped.
        lanes: lanes of a route, the agent's own included.
        points: of a route.
    """

    count: int = 3
    lanes: int = 3
    points: int = 80


@pytree
class Routes:
    """The routes of one agent.

    Attributes:
        paths: points every SPACING m in m; the first lies BEHIND m behind the agent's start.
        valid: which routes there are.
        lanes: the lanes of each, in order; -1 after the last.
        stop: station in m of the line to stop at for a signal; NOWHERE where there is none.
        signals: state of that signal at each logged time.
        give_way: station in m of the line behind which others go first; NOWHERE where there is none.
        gives_way_to: 0 nobody, 1 those who come towards the agent, 2 everybody.
        branching: whether a point lies on a lane that is one of several ways on.
        curvature: at each point, 1/m, positive to the left.
        end: station in m at which the graph ends; beyond it a path goes straight on.
        dropped: routes that the graph offers beyond these.
    """

    paths: Float[Array, "*batch routes points 2"]
    valid: Bool[Array, "*batch routes"]
    lanes: Int[Array, "*batch routes depth"]
    stop: Float[Array, "*batch routes"]
    signals: Int[Array, "*batch times routes"]
    give_way: Float[Array, "*batch routes"]
    gives_way_to: Int[Array, "*batch routes"]
    branching: Bool[Array, "*batch routes points"]
    curvature: Float[Array, "*batch routes points"]
    end: Float[Array, "*batch routes"]
    dropped: Int[Array, "*batch"]


def find_routes(scene: LoggedScene, start: Pose, options: RouteOptions) -> Routes:
    """The routes from a pose."""
    road = scene.road
    sequences, dropped = follow(road, nearest_lane(road, start), options)
    valid = sequences[:, 0] >= 0
    drawn = jnp.where(valid[:, None], sequences, sequences[0])  # one that is not there has a length all the same: it is differentiated by
    routes = jax.vmap(lambda lanes: _one_route(scene, lanes, start, options), out_axes=_AXES)(drawn)
    return dataclasses.replace(routes, lanes=sequences, valid=valid, dropped=dropped)


def nearest_lane(road: RoadGraph, start: Pose) -> Int[Array, ""]:
    """The lane that runs nearest to a pose, of those that run its way (within 60 degrees); the nearest at all if none does."""
    ways = jnp.diff(road.lanes, axis=1)
    heading = jnp.arctan2(ways[..., 1], ways[..., 0])
    share = jnp.sum((start[:2] - road.lanes[:, :-1]) * ways, axis=-1) / jnp.maximum(jnp.sum(ways**2, axis=-1), 1e-9)
    point = road.lanes[:, :-1] + jnp.clip(share, 0, 1)[..., None] * ways
    distance = jnp.sum((point - start[:2]) ** 2, axis=-1) + 1e4 * (jnp.abs(wrapped(heading - start[2])) > jnp.pi / 3)
    real = jnp.any(ways != 0, axis=-1)
    return jnp.argmin(jnp.min(jnp.where(real, distance, jnp.inf), axis=1))


def follow(road: RoadGraph, first: Int[Array, ""], options: RouteOptions) -> tuple[Int[Array, "routes depth"], Int[Array, ""]]:
    """All ways on from a lane, as sequences of lanes (-1: none), breadth first; and how many were dropped."""
    nothing = jnp.full((options.count, options.lanes), -1)
    sequences, dropped = nothing.at[0, 0].set(first), jnp.zeros((), int)
    for depth in range(1, options.lanes):
        last = sequences[:, depth - 1]
        after = jnp.where((last >= 0)[:, None], road.successors[last], -1)  # (routes, next)
        ends = (after < 0).all(axis=1) & (sequences[:, 0] >= 0)
        after = after.at[:, 0].set(jnp.where(ends, -1, after[:, 0]))
        there = (after >= 0) | (ends[:, None] & (jnp.arange(after.shape[1]) == 0))
        longer = jnp.repeat(sequences, after.shape[1], axis=0).at[:, depth].set(after.reshape(-1))
        order = jnp.argsort(~there.reshape(-1), stable=True)[: options.count]
        dropped += jnp.maximum(0, jnp.sum(there) - options.count)
        sequences = jnp.where(there.reshape(-1)[order][:, None], longer[order], nothing)
    return sequences, dropped


def _one_route(scene: LoggedScene, lanes: Int[Array, "depth"], start: Pose, options: RouteOptions) -> Routes:
    """A sequence of lanes as a path, with what stands along it."""
    road = scene.road
    pieces = road.lanes[lanes]  # (depth, points, 2)
    for depth in range(1, len(lanes)):  # a lane that is not there stays where the one before ended
        pieces = pieces.at[depth].set(jnp.where(lanes[depth] >= 0, pieces[depth], pieces[depth - 1, -1]))
    line = pieces.reshape(-1, 2)
    starts = jnp.stack([polyline_length(line[: depth * pieces.shape[1] + 1]) for depth in range(len(lanes))])
    whole = resample(line, SPACING * jnp.arange(SEARCHED))
    origin = project(whole, SPACING, start[:2])[0] - BEHIND
    stations = SPACING * jnp.arange(options.points)
    path = resample(line, origin + stations)
    there = lanes >= 0
    signalled = there & jnp.any(scene.signals[:, lanes] != NO_SIGNAL, axis=0) & (starts > origin + BEHIND)
    giving = there & (road.gives_way[lanes] > 0) & (starts > origin + BEHIND)
    branch = there & jax.vmap(lambda lane: _one_of_several(road, lane))(lanes)
    index = jnp.clip(jnp.searchsorted(starts, origin + stations, side="right") - 1, 0, len(lanes) - 1)

    def first(mask: Array) -> tuple[Array, Array]:
        return jnp.argmax(mask), jnp.where(jnp.any(mask), starts[jnp.argmax(mask)] - origin, NOWHERE)

    signal, stop = first(signalled)
    yielding, give_way = first(giving)
    return Routes(
        paths=path,
        valid=there[0],
        lanes=lanes,
        stop=stop,
        signals=jnp.where(jnp.any(signalled), scene.signals[:, lanes[signal]], NO_SIGNAL),
        give_way=give_way,
        gives_way_to=jnp.where(jnp.any(giving), road.gives_way[lanes[yielding]], 0),
        branching=branch[index] & (origin + stations <= polyline_length(line)),
        curvature=_smoothed(curvature(path, SPACING)),
        end=polyline_length(line) - origin,
        dropped=jnp.zeros((), int),
    )


def _one_of_several(road: RoadGraph, lane: Int[Array, ""]) -> Bool[Array, ""]:
    """Whether some lane goes on in this one and in others too."""
    return jnp.any(jnp.any(road.successors == lane, axis=1) & (jnp.sum(road.successors >= 0, axis=1) > 1))


def _smoothed(values: Float[Array, "points"]) -> Float[Array, "points"]:
    """Means over a point and its neighbours: logged lines turn in corners, every few metres."""
    long = jnp.concatenate([values[:1], values, values[-1:]])
    return (long[:-2] + long[1:-1] + long[2:]) / 3


_AXES = Routes(**{field.name: 1 if field.name == "signals" else 0 for field in dataclasses.fields(Routes)})  # type: ignore[arg-type]  # axes, not arrays
