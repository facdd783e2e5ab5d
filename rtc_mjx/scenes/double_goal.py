"""The double goal problem (Igl et al., section V-A): a point mass, two drifting goals, an expert who prefers the lower one.

Internal to the expert: which goal it approaches (redrawn each step for t < 10, frozen after, P(lower) = 0.75) and the way its path
bends. External, xi: where the goals are and how they drift. A type that knows where *this* episode's goals were is useless in
another one; a type that knows which goal was wanted is not.
"""

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import random
from jaxtyping import Array, Float

from rtc_mjx import metrics
from rtc_mjx.physics import PhysicsState, Surroundings, World, load, rest_state
from rtc_mjx.scenes.base import Actor, Features, Ranges, Scene
from rtc_mjx.trajectory import Demonstration, Episode, Trajectory

GOAL_X = (-0.9, 0.9)  # m, goals are drawn in this range ...
GOAL_Y = (0.35, 0.9)  # m, ... on either side of y = 0
NEAREST_Y = 0.25  # m, a drifting goal turns back here, so it keeps its side
DRIFT = (0.05, 0.2)  # m/s
REACHED = 0.1  # m, from an agent to a goal it has reached
SPEED = 2.2  # m/s, the expert's on its way ...
CIRCLING = 1.0  # m/s, ... and while it is undecided: it then moves at right angles to the goal in mind, and nears neither
SLOW_WITHIN = 0.25  # m, from its goal, where the expert begins to slow down
BEND = (0.7, 1.0)  # rad, how far off the straight line it heads at first, to either side
BEND_WITHIN = 0.9  # m, from its goal, where it begins to turn in
GAIN = 1.2  # control per m/s of velocity error
TREMOR = 0.1  # standard deviation of the expert's controls
TURNING = 20  # steps after that in which its path bends
UNDECIDED = 10  # steps during which the goal is redrawn
LOWER, UPPER = 0, 1


@dataclass(frozen=True)
class DoubleGoal(Scene):
    """Settings of the double goal problem.

    Attributes:
        steps: T, the number of control steps of 0.05 s in an episode.
        lower_probability: the expert's probability of the lower goal.
    """

    name: ClassVar[str] = "double_goal"
    main_metrics: ClassVar[tuple[str, ...]] = ("return", "jsd_goal")
    coverage: ClassVar[str] = "jsd_goal"
    described_by: ClassVar[tuple[str, ...]] = ("return", "upper", "left", "decided")
    steps: int = 60
    lower_probability: float = 0.75

    @functools.cached_property
    def world(self) -> World:
        """A point mass on two slides, without contacts."""
        return load("double_goal")

    def reset(self, key: jax.Array) -> Episode:
        """The agent at rest at the origin; a goal on either side, each drifting straight on, turning back before y = 0."""
        place, way, pace = random.split(key, 3)
        low, high = jnp.array([GOAL_X[0], GOAL_Y[0]]), jnp.array([GOAL_X[1], GOAL_Y[1]])
        first = random.uniform(place, (2, 2), minval=low, maxval=high)
        bearing = random.uniform(way, (2,), maxval=2 * jnp.pi)
        speed = random.uniform(pace, (2,), minval=DRIFT[0], maxval=DRIFT[1])
        times = self.world.timestep * jnp.arange(self.steps + 1)
        x = first[:, 0] + times[:, None] * speed * jnp.cos(bearing)
        off = NEAREST_Y + jnp.abs(first[:, 1] - NEAREST_Y + times[:, None] * speed * jnp.sin(bearing))
        y = off * jnp.array([-1.0, 1.0])
        pose = jnp.stack([x, y, jnp.zeros_like(x)], axis=-1)
        return Episode(rest_state(self.world), Surroundings(pose, jnp.full((self.steps + 1, 2, 2), 2 * REACHED)), ())

    def observe(self, episode: Episode, time: Array, state: PhysicsState) -> Float[Array, "9"]:
        """Position in m, velocity in m/s, where both goals are in m, and the time as a share of the episode."""
        goals = episode.surroundings.pose[time, :, :2]
        return jnp.concatenate([state.qpos, state.qvel, goals[LOWER], goals[UPPER], jnp.array([time / self.steps])])

    def reward(self, episode: Episode, time: Array, state: PhysicsState) -> Float[Array, ""]:
        """One in a step that ends within 0.1 m of either goal."""
        distance = jnp.linalg.norm(state.qpos - episode.surroundings.pose[time, :, :2], axis=-1)
        return (jnp.min(distance) < REACHED).astype(state.qpos.dtype)

    def expert(self, key: jax.Array, episode: Episode) -> tuple[Actor, Any]:
        """Heads for one goal on a path that bends to one side; both the goal and the bend are its own choice."""
        goals, side, size, tremor = random.split(key, 4)
        draws = random.bernoulli(goals, 1 - self.lower_probability, (self.steps,)).astype(int)
        goal = draws[jnp.minimum(jnp.arange(self.steps), UNDECIDED - 1)]
        bend = random.rademacher(side, ()) * random.uniform(size, minval=BEND[0], maxval=BEND[1])
        noise = {"goal": goal, "undecided": jnp.arange(self.steps) < UNDECIDED, "tremor": TREMOR * random.normal(tremor, (self.steps, 2))}

        def act(memory: tuple[()], observation: Array, noise: dict[str, Array]) -> tuple[tuple[()], Array]:
            away = observation[4:8].reshape(2, 2)[noise["goal"]] - observation[:2]
            bent = bend * jnp.clip(jnp.sqrt(jnp.sum(away**2) + 1e-12) / BEND_WITHIN, 0, 1)
            angle = jnp.where(noise["undecided"], jnp.sign(bend) * jnp.pi / 2, bent)
            speed = jnp.where(noise["undecided"], CIRCLING, SPEED)
            return memory, _towards(away, observation[2:4], angle, speed) + noise["tremor"]

        return Actor((), act, noise), {"goal": goal[-1], "bend": bend}

    def luck(self, episode: Episode) -> Float[Array, "8"]:
        """Where both goals are at first, and where at last, in m."""
        return episode.surroundings.pose[np.array([0, -1]), :, :2].reshape(-1)

    def flipped(self, episode: Episode) -> Episode:
        """Both goals, and their drift, on the other side of x = 0: to go to one means to go there, not where it was."""
        around = episode.surroundings
        return dataclasses.replace(episode, surroundings=Surroundings(around.pose.at[..., 0].multiply(-1), around.size))

    def sketch(self, axes: Any, episode: Episode) -> None:
        """Both goals, where they are at last, and the way they came."""
        from matplotlib.patches import Circle  # takes a while to import

        for goal in (LOWER, UPPER):
            way = np.asarray(episode.surroundings.pose[:, goal, :2])
            axes.plot(*way.T, color="0.6", linewidth=1, zorder=1)
            axes.add_patch(Circle(tuple(way[-1]), REACHED, facecolor="#cfe3cf", edgecolor="#4f9a72", zorder=1))

    def label(self, demonstration: Demonstration) -> None:
        """The double goal problem has no hand-made label: Symphony does not run on it."""

    def features(self, demonstration: Demonstration, trajectory: Trajectory) -> dict[str, Array]:
        """Steps at either goal, the side at the end, h = sign(y_T) (paper, section V-A), the turn of the path, whether it ends at a goal.

        The turn is not in the paper: like the goal it is the expert's own choice, half left and half right, and a population has both.
        """
        way = jnp.diff(trajectory.states.qpos, axis=0)
        turn = way[:-1, 0] * way[1:, 1] - way[:-1, 1] * way[1:, 0]  # positive to the left
        rewards = jax.vmap(self.reward, in_axes=(None, 0, 0))(demonstration.episode, jnp.arange(self.steps + 1), trajectory.states)
        return {
            "return": jnp.sum(rewards[1:]),
            "upper": (trajectory.states.qpos[-1, 1] > 0).astype(int),
            "left": (jnp.sum(turn[UNDECIDED : UNDECIDED + TURNING]) > 0).astype(int),
            "decided": rewards[-1],
        }

    def metrics(self, features: Features, expert: Features, ranges: Ranges | None = None) -> dict[str, float]:
        """Mean return in steps; Jensen-Shannon divergence in bits from the expert's of h, and of goal and turn together; share lower."""
        both, experts = (2 * f["upper"] + f["left"] for f in (features, expert))
        return {
            "return": float(np.mean(features["return"])),
            "jsd_goal": metrics.jsd(features["upper"], expert["upper"], bins=2, limits=(-0.5, 1.5)),
            "jsd_goal_and_turn": metrics.jsd(both, experts, bins=4, limits=(-0.5, 3.5)),
            "lower": float(1 - np.mean(features["upper"])),
        }


def _towards(away: Float[Array, "2"], velocity: Float[Array, "2"], angle: Array, speed: Array) -> Float[Array, "2"]:
    """The control that heads `angle` off the straight line to a goal `away` from the agent, slowing down near it."""
    distance = jnp.sqrt(jnp.sum(away**2) + 1e-12)
    turn = jnp.array([[jnp.cos(angle), -jnp.sin(angle)], [jnp.sin(angle), jnp.cos(angle)]])
    wanted = speed * jnp.clip(distance / SLOW_WITHIN, 0, 1) * turn @ (away / distance)
    return jnp.clip(GAIN * (wanted - velocity) + velocity / 3, -1, 1)  # 1/3: damping over actuator gain
