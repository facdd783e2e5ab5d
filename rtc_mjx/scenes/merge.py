"""A ramp that joins a road, generated: the agent comes down the ramp, finds a gap, and later stays on the road or leaves it.

External, xi: who drives on the road, how fast and how far apart. Internal to the expert: its speed, its gap, whether it leaves. One
car is driven: no expert on the road would make way for another one that joins.
"""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array

from rtc_mjx.geometry import resample
from rtc_mjx.logs import NO_SIGNAL, VEHICLE, LoggedScene, RoadGraph
from rtc_mjx.physics.car import CAR
from rtc_mjx.scenes.base import compiled
from rtc_mjx.scenes.generated import Generated, Traffic, assemble, moving
from rtc_mjx.scenes.joining import Joint
from rtc_mjx.scenes.roads import POINTS, as_segments, beside, bezier, straight, thinned
from rtc_mjx.scenes.routes import RouteOptions
from rtc_mjx.scenes.traffic import Drivers, drive, nothing_to_stop_for

WIDTH = 4.0  # m, of a lane
ANGLE = (0.2, 0.32)  # rad, between ramp and road
JOIN = 20.0  # m, length of the lane that joins
MIDDLE = 18.0  # m, from where the ramp has joined to where the exit leaves
RAMP, ROAD = 90.0, 160.0  # m
BACK = (6.0, 32.0)  # m, the agent's nose from the give-way line at t = 0
SPEED = (10.0, 13.0)  # m/s, what drivers want on a free road
FLOW = (7.5, 10.0)  # m/s, of the road
UPSTREAM, RAMP_LANE, JOINING, BETWEEN, ONWARD, LEAVING = range(6)


@dataclass(frozen=True)
class Merge(Generated):
    """Settings of the merge.

    Attributes:
        steps: T, the number of control steps of 0.3 s in an episode.
        road_users: bodies for replayed road users; the nearest are kept.
        controlled: one; everybody else is replayed.
    """

    name: ClassVar[str] = "merge"
    speeds: ClassVar[tuple[float, float]] = SPEED
    joint: ClassVar[Joint | None] = Joint(taken=-1.0, joined=JOIN)
    settings: ClassVar[str] = "intersection"
    route_options: ClassVar[RouteOptions] = RouteOptions(count=2, lanes=4)

    @compiled
    def log(self, key: jax.Array) -> LoggedScene:
        """Road and traffic; the agent itself at t = 0 only."""
        shape, who, place, pace = random.split(key, 4)
        times = self.logged_times
        angle = random.uniform(shape, minval=ANGLE[0], maxval=ANGLE[1])
        road = ramp(angle)
        back = random.uniform(place, minval=BACK[0], maxval=BACK[1]) + CAR[0] / 2
        speed = random.uniform(pace, minval=0.6) * jnp.minimum(10.0, jnp.sqrt(2 * 2.0 * back))
        end = road.lanes[RAMP_LANE, -1]
        pose = jnp.concatenate([end - back * jnp.stack([jnp.cos(angle), jnp.sin(angle)]), angle[None]])
        signals = jnp.full((times, road.lanes.shape[0]), NO_SIGNAL)
        return assemble(road, signals, pose, speed, traffic(who, road, times), jnp.zeros(0, int), times)


def ramp(angle: Array) -> RoadGraph:
    """The road runs along x; the ramp comes from the right and has joined at the origin, the exit leaves to the right after MIDDLE."""
    zero = jnp.zeros(())
    way = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    foot = -0.5 * JOIN * (way + jnp.array([1.0, 0.0]))
    fork, off = jnp.array([MIDDLE, 0.0]), jnp.array([MIDDLE, 0.0]) + 0.5 * JOIN * (jnp.array([1.0, 0.0]) + way * jnp.array([1.0, -1.0]))
    away = off + RAMP * way * jnp.array([1.0, -1.0])
    leaving = jnp.concatenate([bezier(fork, zero, off, -angle, JOIN / 3), straight(off, away)[1:]])
    lanes = jnp.stack([
        straight(jnp.array([-ROAD, 0.0]), jnp.zeros(2)),
        straight(foot - RAMP * way, foot),
        bezier(foot, angle, jnp.zeros(2), zero, JOIN / 3),
        straight(jnp.zeros(2), fork),
        straight(fork, fork + jnp.array([ROAD, 0.0])),
        thinned(leaving, POINTS),
    ])  # fmt: skip
    successors = jnp.array([[BETWEEN, -1], [JOINING, -1], [BETWEEN, -1], [ONWARD, LEAVING], [-1, -1], [-1, -1]])
    right = jnp.concatenate([lanes[RAMP_LANE], lanes[JOINING][1:], lanes[BETWEEN][1:], lanes[LEAVING][1:]])
    left = jnp.concatenate([lanes[UPSTREAM], lanes[BETWEEN][1:], lanes[ONWARD][1:]])[::-1]
    edges = jnp.concatenate([as_segments(thinned(beside(line, jnp.array(-WIDTH / 2)), 49)) for line in (right, left)])
    return RoadGraph(lanes, successors, jnp.array([0, 0, 2, 0, 0, 0]), edges, jnp.ones(len(edges), bool), jnp.zeros((1, 4, 2)))


def traffic(key: jax.Array, road: RoadGraph, times: int) -> Traffic:
    """Poses, velocities, sizes and kinds of a line of vehicles on the road."""
    keys = iter(random.split(key, 7))
    count = 6
    line = jnp.concatenate([road.lanes[UPSTREAM], road.lanes[BETWEEN][1:], road.lanes[ONWARD][1:]])
    off = jnp.concatenate([road.lanes[UPSTREAM], road.lanes[BETWEEN][1:], road.lanes[LEAVING][1:]])
    leaves = random.bernoulli(next(keys), 0.3, (count,))
    paths = jax.vmap(lambda leave: resample(jnp.where(leave, off, line), 2.0 * jnp.arange(160)))(leaves)
    gaps = random.uniform(next(keys), (count,), minval=16.0, maxval=60.0)
    flow = random.uniform(next(keys), minval=FLOW[0], maxval=FLOW[1])
    ahead = ROAD + random.uniform(next(keys), minval=0.0, maxval=60.0)
    drivers = Drivers(
        paths=paths, station=ahead - jnp.cumsum(gaps), speed=jnp.full(count, flow),
        desired=flow * random.uniform(next(keys), (count,), minval=0.9, maxval=1.05), headway=jnp.full(count, 1.2),
        length=random.uniform(next(keys), (count,), minval=4.0, maxval=5.2), leader=jnp.arange(count) - 1,
        until=jnp.full(count, ROAD + MIDDLE), **nothing_to_stop_for(count, times),
    )  # fmt: skip
    present = random.bernoulli(next(keys), 0.8, (count,))
    poses, speeds = drive(drivers, 2.0, times)
    sizes = jnp.stack([drivers.length, jnp.full(count, 1.9)], axis=1)
    return moving(poses, speeds, sizes, jnp.where(present, VEHICLE, 0))
