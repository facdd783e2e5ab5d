"""From the parts of a generated scene to a logged one."""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from rtc_mjx.logs import VEHICLE, LoggedScene, RoadGraph
from rtc_mjx.scenes.driving import CAR

Others = tuple[Array, Array, Array, Array, Array]  # poses (users, times, 3), velocities, sizes, kinds, presence (users,)


def moving(poses: Float[Array, "times users 3"], speeds: Float[Array, "times users"], sizes: Array, kinds: Int[Array, "users"]) -> Others:
    """Road users that move the way they head; those of kind 0 are not there."""
    velocity = speeds[..., None] * jnp.stack([jnp.cos(poses[..., 2]), jnp.sin(poses[..., 2])], axis=-1)
    return poses.swapaxes(0, 1), velocity.swapaxes(0, 1), sizes, kinds, kinds > 0


def assemble(road: RoadGraph, signals: Array, pose: Array, speed: Array, others: Others, times: int) -> LoggedScene:
    """The logged scene, the agent first; it is there at t = 0 only: what it does then is for whoever drives it."""
    poses, velocities, sizes, kinds, valid = others
    heading = jnp.stack([jnp.cos(pose[2]), jnp.sin(pose[2])])
    return LoggedScene(
        road=road,
        signals=signals,
        pose=jnp.concatenate([jnp.broadcast_to(pose, (1, times, 3)), poses]),
        velocity=jnp.concatenate([jnp.broadcast_to(speed * heading, (1, times, 2)), velocities]),
        size=jnp.concatenate([jnp.array([CAR]), sizes]),
        kind=jnp.concatenate([jnp.array([VEHICLE]), kinds]),
        valid=jnp.concatenate([(jnp.arange(times) == 0)[None], jnp.broadcast_to(valid[:, None], (len(valid), times))]),
        controlled=jnp.array(0),
    )
