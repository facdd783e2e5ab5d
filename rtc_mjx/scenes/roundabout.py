"""A roundabout of four arms, generated: the agent comes from the south, gives way, and leaves by one of three exits.

Where more cars are driven, they come from the east, the north and the west; some are in the ring already.

External, xi: who circulates and how fast. Internal to the expert: the exit, its speed, the gap it takes.
"""

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import random
from jaxtyping import Array, Bool, Float, Int

from rtc_mjx.geometry import resample, rotate
from rtc_mjx.logs import NO_SIGNAL, RED, VEHICLE, LoggedScene, RoadGraph
from rtc_mjx.physics.car import CAR
from rtc_mjx.scenes.base import compiled
from rtc_mjx.scenes.generated import Generated, Traffic, assemble, moving
from rtc_mjx.scenes.joining import Joint
from rtc_mjx.scenes.roads import arc, as_segments, beside, bezier, straight, thinned
from rtc_mjx.scenes.routes import RouteOptions
from rtc_mjx.scenes.traffic import Drivers, drive, nothing_to_stop_for

WIDTH = 4.2  # m, of a lane
RING = (12.0, 15.0)  # m, radius of the ring's centre line
FLARE = 0.5  # rad, of the ring, between the middle of an arm and where its entry joins or its exit leaves
MOUTH = 11.0  # m, from the ring's centre line outwards, where an arm begins to bend
ARM = 100.0  # m
KERB = 40  # pieces of a kerb between two arms
BACK = (2.0, 16.0)  # m, the agent's nose from the give-way line at t = 0
SPEED = (7.0, 11.0)  # m/s, what the agent's driver wants on a free road
CIRCLING = (4.6, 5.6)  # m/s, what the others want: not faster than one who has just joined
IN, ENTRY, SHORT, LONG, EXIT, OUT = range(6)  # lanes of an arm: in, onto the ring, to the next exit, past it to the next entry, off, out
FROM = (3, 3, 3, 1, 2)  # arms that traffic comes from: nobody's way crosses another's
JOINED = 14.0  # m past a give-way line, where the way onto the ring has become the ring
HASTE = 8.0  # m/s, than which nobody who is driven is faster here
SLOWLY = 4.2  # m/s, how fast the others take the bend onto the ring at least
BEFORE = 1.5  # s by which they join before somebody who is driven could be there
LATE = 3.0  # m from nose to give-way line, from where nobody stops before it
PRESENT = (0.75, 0.65, 0.5, 0.6, 0.6)
LAST = (3, 4, 2)  # in the traffic: the last that comes from the east, the north, the west


@dataclass(frozen=True)
class Roundabout(Generated):
    """Settings of the roundabout.

    Attributes:
        steps: T, the number of control steps of 0.3 s in an episode.
        road_users: bodies for replayed road users; the nearest are kept.
        controlled: cars that are driven, each by an agent with a type of its own; the road users are replayed.
    """

    name: ClassVar[str] = "roundabout"
    room: ClassVar[int] = 1 + len(LAST)
    speeds: ClassVar[tuple[float, float]] = SPEED
    joint: ClassVar[Joint | None] = Joint(taken=8.0, joined=JOINED)
    settings: ClassVar[str] = "intersection"
    route_options: ClassVar[RouteOptions] = RouteOptions(lanes=9)

    @compiled
    def log(self, key: jax.Array) -> LoggedScene:
        """Road and traffic; the agent itself at t = 0 only."""
        shape, who, place, pace = random.split(key, 4)
        times = self.logged_times
        radius = random.uniform(shape, minval=RING[0], maxval=RING[1])
        road = ring(radius)
        back = random.uniform(place, minval=BACK[0], maxval=BACK[1])
        speed = random.uniform(pace, minval=0.5) * jnp.minimum(8.0, jnp.sqrt(2 * 2.0 * back))
        pose = jnp.stack([jnp.array(WIDTH / 2), -radius - MOUTH - back - CAR[0] / 2, jnp.array(jnp.pi / 2)])
        signals = jnp.full((times, road.lanes.shape[0]), NO_SIGNAL)
        taken = jnp.array(LAST[: self.controlled - 1], int)
        return assemble(road, signals, pose, speed, traffic(who, road, radius, back + CAR[0] / 2, taken, times), taken, times)


def ring(radius: Array) -> RoadGraph:
    """The road graph; arm 0 is the south, and arms follow each other the way that traffic circulates."""
    half, mouth, quarter = WIDTH / 2, radius + MOUTH, jnp.pi / 2

    def on_ring(bearing: Array) -> Array:
        return radius * jnp.stack([jnp.cos(bearing), jnp.sin(bearing)])

    south = -quarter
    joins, leaves = jnp.array(south + FLARE), jnp.array(south - FLARE)
    lanes = [
        straight(jnp.stack([jnp.array(half), -mouth - ARM]), jnp.stack([jnp.array(half), -mouth])),
        bezier(jnp.stack([jnp.array(half), -mouth]), jnp.array(quarter), on_ring(joins), joins + quarter, 0.45 * MOUTH),
        arc(jnp.zeros(2), radius, south + FLARE, quarter - 2 * FLARE),
        arc(jnp.zeros(2), radius, south - FLARE, 2 * FLARE),
        bezier(on_ring(leaves), leaves + quarter, jnp.stack([jnp.array(-half), -mouth]), jnp.array(-quarter), 0.45 * MOUTH),
        straight(jnp.stack([jnp.array(-half), -mouth]), jnp.stack([jnp.array(-half), -mouth - ARM])),
    ]
    arm = jnp.stack(lanes)
    every = jnp.concatenate([rotate(arm, jnp.array(k * quarter)) for k in range(4)])
    successors = jnp.full((24, 2), -1)
    for k in range(4):
        after = 6 * ((k + 1) % 4)
        links = {
            IN: [6 * k + ENTRY],
            ENTRY: [6 * k + SHORT],
            SHORT: [after + EXIT, after + LONG],
            LONG: [6 * k + SHORT],
            EXIT: [6 * k + OUT],
        }
        for lane, ways in links.items():
            for slot, way in enumerate(ways):
                successors = successors.at[6 * k + lane, slot].set(way)
    gives_way = jnp.tile(jnp.array([0, 2, 0, 0, 0, 0]), 4)
    outside = jnp.concatenate([arm[IN], arm[ENTRY][1:], arm[SHORT][1:], *(rotate(arm[x], jnp.array(quarter))[1:] for x in (EXIT, OUT))])
    kerb = beside(outside, jnp.array(-half))
    kerb = as_segments(jnp.concatenate([kerb[:1], thinned(kerb[len(arm[IN]) - 1 : -len(arm[OUT]) + 1], KERB - 1), kerb[-1:]]))
    bearing = jnp.linspace(2 * jnp.pi, 0, 33)  # clockwise: the road is outside the island
    island = as_segments((radius - half - 0.6) * jnp.stack([jnp.cos(bearing), jnp.sin(bearing)], axis=1))
    edges = jnp.concatenate([*(rotate(kerb, jnp.array(k * quarter)) for k in range(4)), island])
    return RoadGraph(every, successors, gives_way, edges, jnp.ones(len(edges), bool), jnp.zeros((1, 4, 2)))


def gives_way(
    driven: Float[Array, "cars"], whence: Int[Array, "cars"], others: Float[Array, "users"], arms: Int[Array, "users"], radius: Array
) -> Bool[Array, "users"]:
    """Whether others do not join the ring before somebody who is driven and may pass their arm could be there.

    Args:
        driven: m to the give-way line of each car that is driven.
        whence: their arms.
        others: m to their own give-way lines.
        arms: their arms.
        radius: of the ring, m.
    """
    turns = (arms - whence[:, None]) % 4
    soonest = (driven[:, None] + JOINED + turns * radius * jnp.pi / 2) / HASTE
    passes = (turns == 1) | (turns == 2)  # at the third arm everybody has left
    return jnp.any(passes & ((others + JOINED) / SLOWLY + BEFORE > soonest), axis=0)


def traffic(key: jax.Array, road: RoadGraph, radius: Array, back: Array, taken: Int[Array, "more"], times: int) -> Traffic:
    """Poses, velocities, sizes and kinds of those who circulate: from the west past the agent's entry, and elsewhere.

    The agent's middle is `back` m from its give-way line; those that are taken are driven too.
    """
    keys = iter(random.split(key, 6))
    count, arms = len(FROM), jnp.array(FROM)

    def way(arm: Array, longer: Array) -> Array:
        """From an arm to the next exit, or to the one after."""
        after, second = (arm + 1) % 4, (arm + 2) % 4
        near = [6 * arm + IN, 6 * arm + ENTRY, 6 * arm + SHORT, 6 * after + EXIT, 6 * after + OUT]
        far = [6 * arm + IN, 6 * arm + ENTRY, 6 * arm + SHORT, 6 * after + LONG, 6 * after + SHORT, 6 * second + EXIT, 6 * second + OUT]
        short, long = (resample(jnp.concatenate([road.lanes[i] for i in x]), 2.0 * jnp.arange(140)) for x in (near, far))
        return jnp.where(longer, long, short)

    paths = jax.vmap(way)(arms, arms == 3)
    length = random.uniform(next(keys), (count,), minval=4.0, maxval=5.2)
    desired = random.uniform(next(keys), (count,), minval=CIRCLING[0], maxval=CIRCLING[1])
    first = ARM + random.uniform(next(keys), (count,), minval=-30.0, maxval=30.0)
    gaps = random.uniform(next(keys), (count,), minval=10.0, maxval=30.0)
    station = first.at[1].set(first[0] - gaps[1]).at[2].set(first[0] - gaps[1] - gaps[2])
    waits = gives_way(jnp.append(back, ARM - station[taken]), jnp.append(0, arms[taken]), ARM - station, arms, radius)
    free = nothing_to_stop_for(count, times)
    signals = jnp.where(waits, RED, free["signals"])  # nobody in the ring reacts to them, so they wait until the end
    drivers = Drivers(
        paths=paths, station=station, speed=desired, desired=desired,
        headway=random.uniform(next(keys), (count,), minval=1.0, maxval=1.8), length=length, leader=jnp.array([-1, 0, 1, -1, -1]),
        until=jnp.full(count, 1e3), **{**free, "stop": jnp.full(count, ARM), "signals": signals},
    )  # fmt: skip
    late = waits & (ARM - station < length / 2 + LATE)
    present = random.bernoulli(next(keys), jnp.array(PRESENT)) & ~late  # nobody is where it can neither wait nor go
    poses, speeds = drive(drivers, 2.0, times)
    sizes = jnp.stack([length, jnp.full(count, 1.9)], axis=1)
    return moving(poses, speeds, sizes, jnp.where(present, VEHICLE, 0))
