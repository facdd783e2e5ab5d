"""A scene as a `dm_env.Environment`, so that dm_control's viewer and any dm_env loop can live in it.

Physics are MJX's, as in training; a dm_control `Physics` of the same model is kept in step, for viewers and pixels. Where a scene has
several agents, observations, actions and rewards have a leading axis of agents.
"""

import functools
from typing import Any

import dm_env
import jax
import jax.numpy as jnp
import numpy as np
from dm_control import mujoco as dm_mujoco
from dm_env import specs

from rtc_mjx.errors import NonFiniteError, UsageError
from rtc_mjx.keys import stream
from rtc_mjx.physics import PhysicsState, control_step, place_surroundings, specialised_step
from rtc_mjx.scenes import Scene
from rtc_mjx.trajectory import Episode


class Environment(dm_env.Environment):
    """Episodes of a scene, one after another.

    Args:
        scene: which.
        seed: of the sequence of episodes.
    """

    def __init__(self, scene: Scene, seed: int = 0) -> None:
        self._scene, self._seed, self._count = scene, seed, 0
        self._physics = dm_mujoco.Physics.from_model(dm_mujoco.wrapper.MjModel(scene.world.mj))
        self._now: tuple[Episode, int, PhysicsState] | None = None
        advance = control_step(scene.world, scene.substeps, specialised_step(scene.world))
        self._reset = jax.jit(scene.reset)
        self._look = jax.jit(lambda episode, time, state: (scene.observe(episode, time, state), scene.reward(episode, time, state)))
        self._advance = jax.jit(
            lambda episode, time, state, action: advance(
                state, action.reshape(-1), *(jax.tree.map(lambda x, at=at: x[at], episode.surroundings) for at in (time, time + 1))
            )
        )

    @property
    def physics(self) -> dm_mujoco.Physics:
        """dm_control's view of the current state."""
        return self._physics

    def control_timestep(self) -> float:
        """Seconds between two actions."""
        return self._scene.substeps * self._scene.world.timestep

    def reset(self) -> dm_env.TimeStep:
        """Begins the next episode."""
        key = jax.random.fold_in(stream("environment", self._seed), self._count)
        self._count += 1
        episode = self._reset(key)
        return dm_env.restart(self._enter(episode, 0, episode.start)[0])

    def step(self, action: Any) -> dm_env.TimeStep:
        """One control step; begins an episode if none is under way.

        Raises:
            UsageError: the action has another shape than the scene's controls.
            NonFiniteError: it is not finite.
        """
        if self._now is None or self._now[1] == self._scene.steps:
            return self.reset()
        episode, time, state = self._now
        control = np.asarray(action, np.float32)
        if control.shape != self.action_spec().shape:
            raise UsageError(f"an action of shape {control.shape}; scene {self._scene.name} takes {self.action_spec().shape}")
        if not np.all(np.isfinite(control)):
            raise NonFiniteError(f"the action {control.tolist()} is not finite")
        observation, reward = self._enter(episode, time + 1, self._advance(episode, time, state, jnp.asarray(control)))
        ending = dm_env.truncation if time + 1 == self._scene.steps else dm_env.transition
        return ending(reward=reward, observation=observation)

    def observation_spec(self) -> specs.Array:
        """The scene's observation, unbounded."""
        return specs.Array(self._shapes[0], np.float32, name="observation")

    def action_spec(self) -> specs.BoundedArray:
        """The scene's controls with their range."""
        (low, high), names = self._scene.control_range.astype(np.float32).T, self._scene.world.control_names
        shape = (*self._shapes[1], self._scene.controls)
        return specs.BoundedArray(shape, np.float32, low.reshape(shape), high.reshape(shape), name=" ".join(names))

    def reward_spec(self) -> specs.Array:
        """The scene's reward, a number an agent."""
        return specs.Array(self._shapes[1], float, name="reward")

    @functools.cached_property
    def _shapes(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Of an observation and of a reward."""
        episode = jax.eval_shape(self._scene.reset, jax.random.key(0))
        seen, reward = jax.eval_shape(self._look, episode, jnp.array(0), episode.start)
        return seen.shape, reward.shape

    def _enter(self, episode: Episode, time: int, state: PhysicsState) -> tuple[np.ndarray, Any]:
        """Makes a state the current one, dm_control's physics included; returns its observation and reward."""
        self._now = (episode, time, state)
        data = self._physics.data
        with self._physics.reset_context():
            data.qpos[:], data.qvel[:] = np.asarray(state.qpos), np.asarray(state.qvel)
            place_surroundings(data, np.asarray(episode.surroundings.pose[time]))
            data.time = time * self.control_timestep()
        observation, reward = self._look(episode, time, state)
        return np.asarray(observation, np.float32), np.asarray(reward, float)[()]
