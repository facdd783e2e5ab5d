"""How the expert joins those who go first: it looks for its place among them, and goes if the whole way there is safe.

    those around -> m along my way at which they are, as if their way had joined mine already
                 -> for each place (before all of them, behind one, behind the next ...): my way there, driven in mind
                 -> the first place with room enough in front and behind; none: the give-way line

Others are expected to keep their speed. What room is enough is the driver's own: its headway in front, its gap behind.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from rtc_mjx.geometry import wrapped
from rtc_mjx.physics.car import CAR
from rtc_mjx.pytree import pytree
from rtc_mjx.scenes.driver import ahead_of_me, at, bends, looked_at, way_ahead
from rtc_mjx.scenes.traffic import COMFORT, GRIP, follow_the_leader

NOSE = CAR[0] / 2  # m, from the car's middle
ALONG = tuple(1.5 * i for i in range(41))  # m along the way, where those who have joined it are looked for
BESIDE = 2.5  # m from the middle of the way, within which somebody is on it
TURNS, ASTRAY = 1.3, 1.3  # rad: who has to turn by more to get there, or would arrive there more askew, does not head for it
TICK, TICKS = 0.3, 25  # s, and how many of them a driver thinks ahead
POWER = (1.8, 2.5)  # m/s^2 of acceleration: as always, and where that makes a place safe
SHORT = 1.0  # m before the line, where a driver means to stop: who is past it cannot wait any more
GIVES_UP = 4.0  # m/s^2, the braking with which a driver still gives a place up
FRONT, BEHIND = 0.3, 0.5  # of its headway and of its gap, the time that it wants between bumpers where it joins
ROOM = 1.5  # m between bumpers, at least
CALM = 2.0  # m/s^2 of braking, beyond what is needed, by which a driver who is too close lets a gap grow
NOBODY = 1e3  # m or s


@dataclass(frozen=True)
class Joint:
    """Where a way joins that of those who go first, in m past its give-way line.

    Attributes:
        taken: where a car's nose begins to be in their way.
        joined: where both ways have become one.
    """

    taken: float
    joined: float


@pytree
class Stream:
    """Those who go first, on the way that they and I will share.

    Attributes:
        there: who is one of them.
        place: m along my way, from where I am to the middle of each.
        pace: m/s.
        apart: m between the middles of two bodies, mine and that of each, that touch.
    """

    there: Bool[Array, "*batch users"]
    place: Float[Array, "*batch users"]
    pace: Float[Array, "*batch users"]
    apart: Float[Array, "*batch users"]


@pytree
class Approach:
    """A driver on its way to where it joins.

    Attributes:
        speed: m/s.
        desired: on a free straight road, m/s.
        headway: s, to somebody ahead.
        gap: s, what it leaves to somebody behind.
        line: m to where its nose must not be before its place is free.
        stations: m ahead, where the way bends ...
        bends: ... by so much, 1/m.
    """

    speed: Float[Array, "*batch"]
    desired: Float[Array, "*batch"]
    headway: Float[Array, "*batch"]
    gap: Float[Array, "*batch"]
    line: Float[Array, "*batch"]
    stations: Float[Array, "*batch points"]
    bends: Float[Array, "*batch points"]


def join(joint: Joint, own: Array, route: Array, signal: Array, users: Float[Array, "users 14"], truth: dict[str, Array]) -> Array:
    """Acceleration in m/s^2 where routes give way to everybody at a joint and there are no signals."""
    stations, points = way_ahead(route)
    me = Approach(
        speed=jnp.maximum(own[0], 0.0), desired=truth["speed"], headway=truth["headway"], gap=truth["gap"],
        line=route[8] + joint.taken - NOSE, stations=stations[1:-1], bends=bends(points),
    )  # fmt: skip
    joined = route[8] + joint.joined
    joining = (route[9] > 1.5) & (joined > 0)
    pull, power = choose(me, stream(stations, points, joined, users))
    power = jnp.where(joining, power, POWER[0])
    gap, closing = ahead_of_me(*looked_at(stations, points), users, me.speed)
    wanted = allowed(me, jnp.array(0.0))
    behind = jnp.min(follow_calmly(me.speed, wanted, gap, closing, me.headway, power))
    return jnp.clip(jnp.where(joining, jnp.minimum(pull, behind), behind), -8.0, 2.5)


def stream(stations: Array, points: Array, joined: Array, users: Float[Array, "users 14"]) -> Stream:
    """Who goes first: those who are on my way past `joined` m, and those who head for there.

    The way of the latter is taken to be the arc that starts the way they head and ends there.
    """
    beyond = points[-1] + 3.0 * (points[-1] - points[-2])  # the way goes on as it ends
    stations, points = jnp.append(stations, stations[-1] + 3.0 * (stations[-1] - stations[-2])), jnp.concatenate([points, beyond[None]])
    before, here = at(stations, points, jnp.stack([joined - 1.0, joined]))
    onward = here - before
    bearing, along = jnp.arctan2(onward[1], onward[0]), jnp.array(ALONG)
    way = at(stations, points, along)

    def one(user: Array) -> tuple[Array, Array]:
        chord, heading = here - user[1:3], jnp.arctan2(user[4], user[3])
        turn = wrapped(jnp.arctan2(chord[1], chord[0]) - heading)
        far = jnp.sqrt(jnp.sum(chord**2) + 1e-6)
        arc = far / jnp.sinc(turn / jnp.pi)
        comes = (jnp.abs(turn) < TURNS) & (jnp.abs(wrapped(heading + 2 * turn - bearing)) < ASTRAY)
        off = jnp.sqrt(jnp.sum((way - user[1:3]) ** 2, axis=1) + 1e-9)
        station = along[jnp.argmin(off)]
        passed = jnp.sum(onward * chord) < 0.5
        on_it = (jnp.min(off) < BESIDE) & (station > joined - 3.0)
        return jnp.where(passed, on_it, comes), jnp.where(passed, station, joined - arc)

    there, place = jax.vmap(one)(users)
    there &= (users[:, 0] > 0) & (users[:, 9] < 0.5)
    return Stream(there, place, jnp.sqrt(jnp.sum(users[:, 5:7] ** 2, axis=1) + 1e-9), NOSE + 0.5 * users[:, 7])


def choose(me: Approach, others: Stream) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Acceleration on the way to the first safe place, and with what power; to the line, if no place is safe.

    Who cannot stop there any more takes the place that is nearest to safe.
    """
    ahead = jnp.append(jnp.where(others.there, others.place, -NOBODY), NOBODY)  # who is as far goes first: all of them ... nobody
    power = jnp.array(POWER)
    drive = jax.vmap(jax.vmap(lambda ahead, power: in_mind(me, others, ahead, power), (None, 0)), (0, None))
    pull, spare = drive(ahead, power)
    spare = jnp.where(jnp.append(others.there, True)[:, None], spare, -NOBODY)
    rank = jnp.where(spare > 0, ahead[:, None] - 0.01 * jnp.arange(len(POWER)), -2 * NOBODY)
    safe = jnp.any(spare > 0)
    choice = jnp.where(safe, jnp.argmax(rank), jnp.argmax(spare))
    waits = jnp.maximum(arrive(me.line, me.speed, jnp.array(NOBODY)), -GIVES_UP)
    waits = jnp.minimum(free_road(me, me.speed, jnp.array(0.0), power[0]), waits)
    stops = me.line > me.speed**2 / (2 * GIVES_UP)
    return jnp.where(stops & ~safe, waits, pull.reshape(-1)[choice]), power[choice % len(POWER)]


def in_mind(me: Approach, others: Stream, ahead: Array, power: Array) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Of the place behind all who are `ahead` m away or more: the acceleration that leads there, and the room to spare all the way, m."""
    leads = others.there & (others.place >= ahead)

    def tick(carry: tuple[Array, Array], time: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        gone, speed = carry
        place, room = others.place + others.pace * time - gone, me.line - gone
        front, behind = ROOM + FRONT * me.headway * speed, ROOM + BEHIND * me.gap * others.pace
        clear = (room + front + others.apart - place) / jnp.maximum(others.pace, 0.5)  # s until they leave me room
        wanted, gap = allowed(me, gone), jnp.maximum(place - others.apart, 0.3)
        follows = follow_calmly(speed, wanted, gap, speed - others.pace, me.headway, power)
        pull = jnp.where(leads, jnp.where(room > 0, arrive(room, speed, clear), follows), NOBODY)
        pull = jnp.clip(jnp.minimum(free_road(me, speed, gone, power), jnp.min(pull, initial=NOBODY)), -GIVES_UP, 2.5)
        spare = jnp.where(leads, place - others.apart - front, -place - others.apart - behind)
        spare = jnp.min(jnp.where(others.there & (room < 0), spare, NOBODY), initial=NOBODY)
        then = jnp.maximum(0.0, speed + TICK * pull)
        return (gone + TICK * 0.5 * (speed + then), then), (pull, spare)

    _, (pull, spare) = lax.scan(tick, (jnp.zeros_like(me.speed), me.speed), TICK * jnp.arange(TICKS))
    return pull[0], jnp.min(spare)


def arrive(room: Array, speed: Array, when: Array) -> Float[Array, "*users"]:
    """Constant acceleration in m/s^2 by which `room` m are not gone before `when` s from now; who had to stop for it stops SHORT."""
    in_time = 2 * (room - speed * when) / jnp.maximum(when, 0.1) ** 2
    stop = -(speed**2) / (2 * jnp.maximum(room - SHORT, 0.1))
    return jnp.where(when > 0, jnp.where(2 * room > speed * when, in_time, stop), NOBODY)


def follow_calmly(speed: Array, wanted: Array, gap: Array, closing: Array, headway: Array, most: Array) -> Float[Array, "*users"]:
    """Acceleration in m/s^2 behind somebody, without panic about one who is near but not slower (Kesting, Treiber, Helbing 2010)."""
    pull = follow_the_leader(speed, wanted, gap, closing, headway=headway, most=most)
    needed = -(jnp.maximum(closing, 0.0) ** 2) / (2 * jnp.maximum(gap, 0.3))
    return jnp.where(pull < needed, needed + CALM * jnp.tanh((pull - needed) / CALM), pull)


def free_road(me: Approach, speed: Array, gone: Array, power: Array) -> Float[Array, ""]:
    """Acceleration in m/s^2 at a speed after `gone` m, with nobody ahead."""
    return follow_the_leader(speed, allowed(me, gone), jnp.array(NOBODY), jnp.array(0.0), headway=me.headway, most=power)


def allowed(me: Approach, gone: Array) -> Float[Array, ""]:
    """The speed in m/s from which all bends can still be taken at GRIP that are ahead after `gone` m."""
    limit = jnp.sqrt(GRIP / jnp.maximum(me.bends, 1e-3) + 2 * COMFORT * jnp.maximum(0, me.stations - gone - 2.0))
    return jnp.minimum(me.desired, jnp.min(jnp.where(me.stations > gone - 3.0, limit, NOBODY)))
