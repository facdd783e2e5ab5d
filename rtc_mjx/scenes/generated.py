"""What generated driving scenes share: who demonstrates in them, and the way from their parts to a logged scene."""

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rtc_mjx.logs import VEHICLE, LoggedScene, RoadGraph
from rtc_mjx.scenes.base import Actor
from rtc_mjx.scenes.driver import expert_driver
from rtc_mjx.scenes.driving import CAR, Driving
from rtc_mjx.trajectory import Episode

Others = tuple[Array, Array, Array, Array]  # poses (users, times, 3), velocities, sizes, kinds (users,)


@dataclass(frozen=True)
class Generated(Driving):
    """Settings of a generated driving scene.

    Attributes:
        steps: T, the number of control steps of 0.3 s in an episode.
        road_users: bodies for replayed road users; the nearest are kept.
    """

    speeds: ClassVar[tuple[float, float]]  # m/s, what the agent's drivers want on a free road

    def expert(self, key: jax.Array, episode: Episode) -> tuple[Actor, Any]:
        """A driver with a route and a temper of its own."""
        return expert_driver(key, self, episode, self.speeds)


def moving(poses: Float[Array, "times users 3"], speeds: Float[Array, "times users"], sizes: Array, kinds: Int[Array, "users"]) -> Others:
    """Road users that move the way they head; those of kind 0 are not there."""
    velocity = speeds[..., None] * jnp.stack([jnp.cos(poses[..., 2]), jnp.sin(poses[..., 2])], axis=-1)
    return poses.swapaxes(0, 1), velocity.swapaxes(0, 1), sizes, kinds


def assemble(road: RoadGraph, signals: Array, pose: Array, speed: Array, others: Others, times: int) -> LoggedScene:
    """The logged scene, the agent first; it is there at t = 0 only: what it does then is for whoever drives it."""
    poses, velocities, sizes, kinds = others
    heading = jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
    return LoggedScene(
        road=road,
        signals=signals,
        pose=jnp.concatenate([jnp.broadcast_to(pose, (1, times, 3)), poses]),
        velocity=jnp.concatenate([jnp.broadcast_to(speed * heading, (1, times, 2)), velocities]),
        size=jnp.concatenate([jnp.array([CAR]), sizes]),
        kind=jnp.concatenate([jnp.array([VEHICLE]), kinds]),
        valid=jnp.concatenate([(jnp.arange(times) == 0)[None], jnp.broadcast_to(kinds[:, None] > 0, (len(kinds), times))]),
        controlled=jnp.array(0),
    )
