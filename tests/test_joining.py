"""Laws of how the expert joins those who go first, and of who joins the roundabout before it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import random

from rtc_mjx.logs import RATE
from rtc_mjx.physics.car import CAR
from rtc_mjx.scenes.joining import CALM, NOBODY, SHORT, Approach, Stream, arrive, choose, follow_calmly, stream
from rtc_mjx.scenes.roundabout import FROM, HASTE, JOINED, LAST, MOUTH, Roundabout
from rtc_mjx.scenes.traffic import follow_the_leader

STRAIGHT = jnp.array([0.0, 2.0, 5.0, 8.0, 12.0, 16.0, 20.0, 25.0, 30.0, 40.0, 50.0])


def seen(place, heading, *, there=1.0, walks=0.0):
    """A row of the observation: somebody at 5 m/s."""
    way = [np.cos(heading), np.sin(heading)]
    return jnp.array([[there, *place, *way, 5 * way[0], 5 * way[1], 4.5, 1.9, walks, 0.0, 0.0, 0.0, 0.0]])


def found(user, joined=10.0):
    """Who goes first, where my way is the x axis."""
    return stream(STRAIGHT, jnp.stack([STRAIGHT, 0 * STRAIGHT], axis=1), jnp.array(joined), user)


@pytest.mark.parametrize("joined", [10.0, 60.0])
@pytest.mark.parametrize("angle", [-1.5, -0.6, 0.0, 0.6, 2.0])
def test_who_comes_along_a_ring_is_as_far_from_the_joint_as_the_ring_is_long(angle, joined):
    radius, left = 12.0, np.sign(angle) or 1.0
    place = (joined - radius * np.sin(abs(angle)) - 4 * (angle == 0), left * radius * (1 - np.cos(angle)))
    others = found(seen(place, -angle), joined)
    assert others.there[0] and others.pace[0] == pytest.approx(5.0)
    assert others.place[0] == pytest.approx(joined - radius * abs(angle) - 4 * (angle == 0), abs=0.05)


def test_who_has_joined_is_where_it_is():
    others = found(seen((31.0, 0.8), 0.0))
    assert others.there[0] and others.place[0] == pytest.approx(31.0, abs=0.8)


@pytest.mark.parametrize(
    "user",
    [
        seen((-10.0, 3.0), np.pi),  # drives away
        seen((10.0, 12.0), -np.pi / 2),  # crosses
        seen((25.0, 3.5), np.pi),  # comes towards me
        seen((31.0, 6.0), 0.0),  # is past the joint on another way
        seen((0.0, 1.0), 0.0, there=0.0),
        seen((0.0, 1.0), 0.0, walks=1.0),
    ],
)
def test_who_does_not_come_to_the_joint_does_not_go_first(user):
    assert not found(user).there[0]


@pytest.mark.parametrize("speed", [0.0, 3.0, 9.0])
@pytest.mark.parametrize("when", [1.0, 4.0, 1e3])
def test_the_line_is_reached_when_it_is_free_and_never_before(speed, when):
    room = 12.0
    pull = float(arrive(jnp.array(room), jnp.array(speed), jnp.array(when)))
    if 2 * room > speed * when:
        assert speed * when + pull * when**2 / 2 == pytest.approx(room, abs=1e-4) and speed + pull * when > -1e-4
    else:
        assert speed**2 / (2 * -pull) == pytest.approx(room - SHORT)


def test_a_line_that_is_free_holds_nobody_up():
    assert arrive(jnp.array(0.2), jnp.array(9.0), jnp.array(-0.1)) == NOBODY


def test_nobody_panics_about_who_is_near_but_not_slower():
    """At most so much harder than what it takes; where the model brakes less, it is the model's."""
    gap, closing = jnp.meshgrid(jnp.linspace(0.5, 60, 40), jnp.linspace(-4, 6, 21))
    speed, wanted, headway, most = (jnp.array(x) for x in (9.0, 12.0, 1.5, 1.8))
    calm, model = follow_calmly(speed, wanted, gap, closing, headway, most), follow_the_leader(speed, wanted, gap, closing, headway=headway)
    needed = -(jnp.maximum(closing, 0) ** 2) / (2 * gap)
    assert np.all(calm >= needed - CALM - 1e-4) and np.all(calm >= model - 1e-4)
    assert np.array_equal(calm[model >= needed], model[model >= needed]) and np.any(model < needed - 2 * CALM)


def approach(gap, line=8.0, speed=5.0):
    told = {"speed": speed, "desired": 11.0, "headway": 1.2, "gap": gap, "line": line}
    return Approach(**{name: jnp.asarray(x, float) for name, x in told.items()}, stations=STRAIGHT[1:-1], bends=jnp.zeros(9))


@jax.jit
def pulls(me, places):
    """Accelerations with one who goes first at 9 m/s, wherever it is."""
    return jax.vmap(lambda place: choose(me, Stream(jnp.ones(1, bool), place[None], jnp.array([9.0]), jnp.array([CAR[0]])))[0])(places)


def test_the_gap_that_a_driver_wants_decides_before_whom_it_goes():
    places = jnp.linspace(-70.0, 0.0, 141)
    bold, timid = (np.asarray(pulls(approach(gap), places)) > 1.0 for gap in (1.0, 2.6))
    assert bold[0] and timid[0] and not np.any((bold | timid)[places > -10.0])  # far away: both go; about to be there: none does
    assert np.sum(bold) > np.sum(timid) + 8 and np.all(bold | ~timid)
    near = (places > -30.0) & (places < -12.0)
    assert np.all(np.asarray(pulls(approach(1.8, line=0.5, speed=0.0), places))[near] < 0.3)  # at the line it waits


def test_nobody_there_is_nobody_to_wait_for():
    others = Stream(jnp.zeros(2, bool), jnp.zeros(2), jnp.full(2, 9.0), jnp.full(2, CAR[0]))
    free = follow_the_leader(jnp.array(5.0), jnp.array(11.0), jnp.array(NOBODY), jnp.array(0.0), headway=jnp.array(1.2))
    assert choose(approach(2.6), others)[0] == pytest.approx(float(free))


@pytest.mark.parametrize("controlled", [1, 3])
def test_nobody_replayed_joins_the_ring_where_a_driven_car_may_be(controlled):
    """Either it has joined before the fastest of those who are driven can be there, or it waits at its line to the end."""
    scene = Roundabout(controlled=controlled)
    logs = jax.jit(jax.vmap(scene.log))(random.split(random.key(0), 256))
    radius = jnp.sqrt(jnp.sum(logs.road.lanes[:, 2, 0] ** 2, axis=-1))[:, None]
    far = jnp.sqrt(jnp.sum(logs.pose[..., :2] ** 2, axis=-1))
    arms = np.array([0, *(FROM[i] for i in LAST[: controlled - 1]), *FROM])
    checked = waited = 0
    for user in range(controlled, controlled + len(FROM)):
        there = np.asarray(logs.kind[:, user] > 0)
        joined = np.asarray(far[:, user] < radius + 0.3)
        when, stays = np.argmax(joined, axis=1) / RATE, ~np.any(joined, axis=1)
        for car in range(controlled):
            turn = (arms[user] - arms[car]) % 4
            if turn in (1, 2):
                way = far[:, car, 0] - radius[:, 0] - MOUTH + JOINED + turn * radius[:, 0] * np.pi / 2
                first = (when < np.asarray(way) / HASTE) | stays
                assert np.all(first[there])
                checked, waited = (
                    checked + np.sum(there),
                    waited + np.sum(stays & there & np.asarray(far[:, user, -1] < radius[:, 0] + MOUTH + 6)),
                )
    assert waited > 20 and checked - waited > 20
