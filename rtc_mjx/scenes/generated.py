"""What generated driving scenes share: who demonstrates in them, and the way from their parts to a logged scene.

Where several cars are driven, each comes by a way of its own: the agent as always, the others where the last one of the traffic on
their way would have been, as fast. Nobody replayed comes behind them: they would not react.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rtc_mjx.logs import VEHICLE, LoggedScene, RoadGraph
from rtc_mjx.physics.car import CAR
from rtc_mjx.scenes.base import Actor
from rtc_mjx.scenes.driver import expert_driver
from rtc_mjx.scenes.driving import Driving
from rtc_mjx.scenes.joining import Joint, join
from rtc_mjx.scenes.several import crew
from rtc_mjx.trajectory import Episode

Traffic = tuple[Array, Array, Array, Array]  # poses (users, times, 3), velocities, sizes, kinds (users,)


@dataclass(frozen=True)
class Generated(Driving):
    """Settings of a generated driving scene.

    Attributes:
        steps: T, the number of control steps of 0.3 s in an episode.
        road_users: bodies for replayed road users; the nearest are kept.
        controlled: cars that are driven, each by an agent with a type of its own; the road users are replayed.
    """

    speeds: ClassVar[tuple[float, float]]  # m/s, what the agent's drivers want on a free road
    joint: ClassVar[Joint | None] = None  # where the agent's drivers join others who go first

    def expert(self, key: jax.Array, episode: Episode) -> tuple[Actor, Any]:
        """For each car a driver with a route and a temper of its own."""
        pedals = partial(join, self.joint) if self.joint else None
        drivers = self.each(lambda key, routes: expert_driver(key, self, routes, self.speeds, pedals))
        actors, truth = drivers(self.key_each(key), episode.context.routes)
        return crew(self, actors), truth


def moving(poses: Float[Array, "times users 3"], speeds: Float[Array, "times users"], sizes: Array, kinds: Int[Array, "users"]) -> Traffic:
    """Road users that move the way they head; those of kind 0 are not there."""
    velocity = speeds[..., None] * jnp.stack([jnp.cos(poses[..., 2]), jnp.sin(poses[..., 2])], axis=-1)
    return poses.swapaxes(0, 1), velocity.swapaxes(0, 1), sizes, kinds


def assemble(
    road: RoadGraph, signals: Array, pose: Float[Array, "3"], speed: Array, traffic: Traffic, taken: Int[Array, "more"], times: int
) -> LoggedScene:
    """The logged scene, the agent first, and after it those of the traffic that are taken over: driven from where they are at t = 0.

    Who is driven is there at t = 0 only: what it does then is for its driver.
    """
    poses, velocities, sizes, kinds = traffic
    heading = jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
    start = jnp.concatenate([pose[None], poses[taken, 0]])[:, None]
    velocity = jnp.concatenate([(speed * heading)[None], velocities[taken, 0]])[:, None]
    kinds, cars = kinds.at[taken].set(0), len(start)
    return LoggedScene(
        road=road,
        signals=signals,
        pose=jnp.concatenate([jnp.broadcast_to(start, (cars, times, 3)), poses]),
        velocity=jnp.concatenate([jnp.broadcast_to(velocity, (cars, times, 2)), velocities]),
        size=jnp.concatenate([jnp.tile(jnp.array([CAR]), (cars, 1)), sizes]),
        kind=jnp.concatenate([jnp.full(cars, VEHICLE), kinds]),
        valid=jnp.concatenate([jnp.tile(jnp.arange(times) == 0, (cars, 1)), jnp.broadcast_to(kinds[:, None] > 0, (len(kinds), times))]),
        controlled=jnp.arange(cars) if cars > 1 else jnp.array(0),
    )
