"""A signalised four-way intersection, generated: one lane each way, signals, traffic, people on the crosswalks.

External, xi: when the light changes, who comes from where, whether a car in front brakes hard, who crosses. Internal to the expert:
its route, speed, headway, how large a gap it takes and how late it looks (`rtc_mjx.scenes.driver`). The agent comes from the south; where
more cars are driven, they come from the north, the east and the west.
"""

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Float, Int

from rtc_mjx.geometry import resample, rotate
from rtc_mjx.logs import AMBER, GREEN, NO_SIGNAL, PEDESTRIAN, RATE, RED, VEHICLE, LoggedScene, RoadGraph
from rtc_mjx.physics.car import CAR
from rtc_mjx.scenes.base import compiled
from rtc_mjx.scenes.generated import Generated, Traffic, assemble, moving
from rtc_mjx.scenes.roads import POINTS, arc, ring_edges, straight, thinned
from rtc_mjx.scenes.traffic import Drivers, Walkers, drive, walk
from rtc_mjx.trajectory import Episode

LANE_WIDTH = (3.3, 3.8)  # m
CORNER = (7.0, 11.0)  # m, radius of a kerb
ARM = 120.0  # m, from the junction's mouth outwards
SETBACK = 5.5  # m, from the end of the kerb's bend to the stop line: the crosswalk lies between
GREEN_FOR = (8.0, 16.0)  # s
AMBER_FOR, ALL_RED = 3.0, 2.0  # s
BACK = (4.0, 40.0)  # m, the agent's nose from its stop line at t = 0
SPEED = (7.0, 13.0)  # m/s, what drivers want on a free road
SOUTH, EAST, NORTH, WEST = 0, 1, 2, 3
LEFT, STRAIGHT, RIGHT = 0, 1, 2
PRESENT = (0.45, 0.25, 0.75, 0.6, 0.7, 0.7)  # of two in front of the agent, two oncoming, two crossing
WALKING = (0.4, 0.4)
BRAKES_HARD = 0.2  # of the cars in front of the agent
LAST = (3, 4, 5)  # in the traffic: the last that comes from the north, the east, the west


@dataclass(frozen=True)
class Intersection(Generated):
    """Settings of the intersection.

    Attributes:
        steps: T, the number of control steps of 0.3 s in an episode.
        road_users: bodies for replayed road users; the nearest are kept.
        controlled: cars that are driven, each by an agent with a type of its own; the road users are replayed.
    """

    name: ClassVar[str] = "intersection"
    room: ClassVar[int] = 1 + len(LAST)
    speeds: ClassVar[tuple[float, float]] = SPEED

    def flipped(self, episode: Episode) -> Episode:
        """Red lights are green, green and amber ones are red."""

        def turned(signals: Array) -> Array:
            return jnp.where(signals == RED, GREEN, jnp.where((signals == GREEN) | (signals == AMBER), RED, signals))

        road = episode.context
        routes = dataclasses.replace(road.routes, signals=turned(road.routes.signals))
        return dataclasses.replace(episode, context=dataclasses.replace(road, signals=turned(road.signals), routes=routes))

    @compiled
    def log(self, key: jax.Array) -> LoggedScene:
        """Road, signals, traffic; the agent itself at t = 0 only."""
        shape, lights, who, own = random.split(key, 4)
        one, two = random.split(shape)
        width = random.uniform(one, minval=LANE_WIDTH[0], maxval=LANE_WIDTH[1])
        corner = random.uniform(two, minval=CORNER[0], maxval=CORNER[1])
        times = self.logged_times
        road = four_way(width, corner)
        ahead, across = cycle(lights, times)
        pose, speed = approach(own, width, corner, ahead[0])
        others = traffic(who, road, width, corner, ahead, across, pose, speed, times)
        taken = jnp.array(LAST[: self.controlled - 1], int)
        return assemble(road, lane_signals(ahead, across), pose, speed, others, taken, times)


def mouth(width: Array, corner: Array) -> Array:
    """From the centre to a stop line, m."""
    return width + corner + SETBACK


def four_way(width: Array, corner: Array) -> RoadGraph:
    """The road graph: for each arm (south, east, north, west) the lane in, the lane out, and the lanes left, straight and right on."""
    bend, far = width + corner, mouth(width, corner)
    half = width / 2
    lane_in = straight(jnp.array([half, -far - ARM]), jnp.array([half, -far]))
    lane_out = straight(jnp.array([-half, -far]), jnp.array([-half, -far - ARM]))
    enter, leave = jnp.array([[half, -far]]), jnp.array([[-far, half]])
    left = jnp.concatenate([enter, arc(jnp.array([-bend, -bend]), bend + half, 0.0, jnp.pi / 2), leave])
    right = jnp.concatenate([enter, arc(jnp.array([bend, -bend]), bend - half, jnp.pi, -jnp.pi / 2), jnp.array([[far, -half]])])
    on = straight(jnp.array([half, -far]), jnp.array([half, far]))
    one_arm = jnp.stack([lane_in, lane_out, *(thinned(x, POINTS) for x in (left, on, right))])
    lanes = jnp.concatenate([rotate(one_arm, jnp.array(arm * jnp.pi / 2)) for arm in range(4)])
    successors = jnp.full((20, 3), -1)
    for arm in range(4):
        successors = successors.at[5 * arm].set(jnp.array([5 * arm + 2, 5 * arm + 3, 5 * arm + 4]))
        for way, goal in ((LEFT, arm - 1), (STRAIGHT, arm + 2), (RIGHT, arm + 1)):
            successors = successors.at[5 * arm + 2 + way, 0].set(5 * (goal % 4) + 1)
    gives_way = jnp.tile(jnp.array([0, 0, 1, 0, 0]), 4)
    edges = ring_edges(width, corner, ARM + SETBACK)
    strip = jnp.array([[-width, -bend - 1.0], [width, -bend - 1.0], [width, -bend - 4.0], [-width, -bend - 4.0]])
    crosswalks = jnp.stack([rotate(strip, jnp.full(4, arm * jnp.pi / 2)) for arm in range(4)])
    return RoadGraph(lanes, successors, gives_way, edges, jnp.ones(len(edges), bool), crosswalks)


def cycle(key: jax.Array, times: int) -> tuple[Int[Array, "times"], Int[Array, "times"]]:
    """What the agent's arm and the arms across see, at each logged time: green, amber, all red, the others' green, and so on."""
    first, second, offset = random.split(key, 3)
    greens = [random.uniform(k, minval=GREEN_FOR[0], maxval=GREEN_FOR[1]) for k in (first, second)]
    whole = greens[0] + greens[1] + 2 * (AMBER_FOR + ALL_RED)
    clock = (random.uniform(offset) * whole + jnp.arange(times) / RATE) % whole

    def state(since: Array, green: Array) -> Array:
        return jnp.where(since < green, GREEN, jnp.where(since < green + AMBER_FOR, AMBER, RED))

    return state(clock, greens[0]), state((clock - greens[0] - AMBER_FOR - ALL_RED) % whole, greens[1])


def lane_signals(ahead: Int[Array, "times"], across: Int[Array, "times"]) -> Int[Array, "times lanes"]:
    """Signals stand at the start of the lanes across the junction."""
    nothing = jnp.full_like(ahead, NO_SIGNAL)
    return jnp.stack([x for arm in range(4) for x in (nothing, nothing, *[ahead if arm % 2 == 0 else across] * 3)], axis=1)


def approach(key: jax.Array, width: Array, corner: Array, signal: Array) -> tuple[Float[Array, "3"], Array]:
    """Where the agent is at t = 0 and how fast: never faster than it can stop for a red light."""
    place, pace, aside = random.split(key, 3)
    back = random.uniform(place, minval=BACK[0], maxval=BACK[1])
    fastest = jnp.where(signal == GREEN, SPEED[1], jnp.sqrt(2 * 2.0 * jnp.maximum(0, back - 2)))
    speed = random.uniform(pace, minval=0.5) * jnp.minimum(fastest, 11.0)
    x = width / 2 + 0.15 * random.normal(aside)
    return jnp.stack([x, -mouth(width, corner) - back - CAR[0] / 2, jnp.array(jnp.pi / 2)]), speed


def traffic(
    key: jax.Array, road: RoadGraph, width: Array, corner: Array, ahead: Array, across: Array, pose: Array, speed: Array, times: int
) -> Traffic:
    """Poses (users, times, 3), velocities, sizes and kinds of all but the agent."""
    keys = iter(random.split(key, 12))
    arms = jnp.array([SOUTH, SOUTH, NORTH, NORTH, EAST, WEST])
    ways = jnp.where(random.bernoulli(next(keys), 0.7, (6,)), STRAIGHT, RIGHT)
    out = jnp.where(ways == STRAIGHT, (arms + 2) % 4, (arms + 1) % 4)
    lines = jnp.concatenate([road.lanes[5 * arms], road.lanes[5 * arms + 2 + ways][:, 1:], road.lanes[5 * out + 1][:, 1:]], axis=1)
    spacing = 2.0
    paths = jax.vmap(lambda line: resample(line, spacing * jnp.arange(150)))(lines)
    length = random.uniform(next(keys), (6,), minval=4.0, maxval=5.2)
    desired = random.uniform(next(keys), (6,), minval=SPEED[0], maxval=SPEED[1])
    nose = jnp.array(ARM)  # station of a stop line
    mine = nose + mouth(width, corner) + pose[1]
    gaps = random.uniform(next(keys), (6,), minval=7.0, maxval=28.0)
    first = mine + CAR[0] / 2 + gaps[0] + length[0] / 2
    second = first + length[0] / 2 + gaps[1] + length[1] / 2
    back = random.uniform(next(keys), (6,), minval=3.0, maxval=45.0)
    station = nose - back - length / 2
    station = station.at[0].set(first).at[1].set(second)
    station = station.at[3].set(station[2] - (length[2] + length[3]) / 2 - gaps[3])
    signals = jnp.stack([ahead, ahead, ahead, ahead, across, across], axis=1)
    room = jnp.maximum(nose - station - length / 2, 0)
    stops = (signals[0] != GREEN) & (station + length / 2 < nose + 0.5)
    start = desired * random.uniform(next(keys), (6,), minval=0.6, maxval=1.0)
    start = jnp.where(stops, jnp.minimum(start, jnp.sqrt(2 * 2.0 * jnp.maximum(room - 1, 0))), start)
    start = start.at[0].set(jnp.minimum(start[0], speed + 2)).at[3].set(jnp.minimum(start[3], start[2] + 1))
    slowest = jnp.sqrt(jnp.maximum(0.0, speed**2 - 2 * 2.5 * (gaps[0] - 3)))  # the agent can follow it without an emergency
    start = start.at[0].max(slowest)
    present, leaders = random.bernoulli(next(keys), jnp.array(PRESENT)), jnp.array([1, -1, -1, 2, -1, -1])
    hard = random.bernoulli(next(keys), BRAKES_HARD, (6,)) & (jnp.arange(6) < 2)
    drivers = Drivers(
        paths=paths, station=station, speed=start, desired=desired, headway=random.uniform(next(keys), (6,), minval=1.0, maxval=1.8),
        length=length, leader=jnp.where(present[leaders], leaders, -1),  # nobody follows a vehicle that is not there
        until=jnp.where((ways == ways[jnp.array([1, 0, 3, 2, 4, 5])]), 1e3, nose + 4.0),
        stop=jnp.full(6, nose), signals=signals,
        brakes=jnp.where(hard, random.uniform(next(keys), (6,), minval=0.5, maxval=6.0), 1e3),
        brakes_for=random.uniform(next(keys), (6,), minval=0.6, maxval=1.8),
    )  # fmt: skip
    poses, speeds = drive(drivers, spacing, times)
    people, pace, size, walking = _people(next(keys), width, corner, ahead, across, times)
    poses, speeds = jnp.concatenate([poses, people], axis=1), jnp.concatenate([speeds, pace], axis=1)
    sizes = jnp.concatenate([jnp.stack([length, jnp.full(6, 1.9)], axis=1), size])
    kinds = jnp.concatenate([jnp.where(present, VEHICLE, 0), jnp.where(walking, PEDESTRIAN, 0)])
    return moving(poses, speeds, sizes, kinds)


def _people(key: jax.Array, width: Array, corner: Array, ahead: Array, across: Array, times: int) -> tuple[Array, Array, Array, Array]:
    """One walker beside the agent's way (across the east or west arm, with its green), one across it (with the others' green)."""
    keys = iter(random.split(key, 7))
    arm = jnp.stack([jnp.where(random.bernoulli(next(keys)), EAST, WEST), jnp.where(random.bernoulli(next(keys)), SOUTH, NORTH)])
    near = -(width + corner) - random.uniform(next(keys), (2,), minval=1.6, maxval=3.4)
    side = random.rademacher(next(keys), (2,), float) * (width + 0.9)
    start, goal = (rotate(jnp.stack([s * side, near], axis=1), arm * jnp.pi / 2) for s in (1.0, -1.0))
    speed = random.uniform(next(keys), (2,), minval=1.1, maxval=1.7)
    ready = random.uniform(next(keys), (2,), minval=-3.0, maxval=7.0)
    may_go = jnp.stack([ahead == GREEN, across == GREEN], axis=1)
    ready = jnp.where(may_go[0], ready, jnp.maximum(ready, 0.0))
    poses, pace = walk(Walkers(start, goal, speed, ready, may_go), times)
    return poses, pace, jnp.full((2, 2), 0.6), random.bernoulli(next(keys), jnp.array(WALKING))
