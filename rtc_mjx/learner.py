"""All that is static in a training: what is learned, by which method, how; and how its minibatches are laid out.

Rows are agents: an episode with several of them is simulated once and makes a row each (`rtc_mjx.scenes.several`).
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax import random
from jaxtyping import Array

from rtc_mjx.agent_types import SOURCES, Typed, TypeSpace
from rtc_mjx.losses import CLOSED_LOOP, PATHWISE, LossWeights
from rtc_mjx.methods import Branch, Method
from rtc_mjx.models import Agent, ModelOptions, Networks, Statistics
from rtc_mjx.physics import OneStep
from rtc_mjx.rollout import GradientMode, rollout
from rtc_mjx.scenes import Scene, crew, merged, parted
from rtc_mjx.sharding import ALL_ROWS, Rows
from rtc_mjx.trajectory import Demonstration, Episode, Trajectory


@dataclass(frozen=True)
class OptimiserOptions:
    """How gradients become updates.

    Attributes:
        learning_rate: Adam's, of policy and encoder; falls along a half cosine to `final_rate` of it.
        prior_rate: Adam's, of the prior; falls alike.
        discriminator_rate: Adam's, of discriminator and Q; constant.
        discriminator_steps: of each trajectory, at random times, that the discriminator learns from in an update; 0 for all.
        value_rate: Adam's, of GAIL's V; constant.
        final_rate: share of the learning rate left at the last update.
        clip: largest norm of an update's gradient: of policy and encoder, of the prior, of discriminator and Q, of V.
        trajectory_clip: largest norm of the gradient of one trajectory's own loss by the policy's outputs.
        gradient: what flows back from step to step of a rollout: everything ('full'), all but how the policy reacts to what it sees
            ('dynamics_only'), or nothing ('none').
        decay: shrinks the backward signal at each step back in time.
        discount: of GAIL's rewards, a step.
        trace: lambda of GAIL's advantage estimation: 0 trusts V after one step, 1 only looks at rewards.
    """

    learning_rate: float = 1e-3
    prior_rate: float = 3e-3
    discriminator_rate: float = 1e-3
    discriminator_steps: int = 0
    value_rate: float = 1e-3
    final_rate: float = 0.1
    clip: float = 1.0
    trajectory_clip: float = 10.0
    gradient: GradientMode = "full"
    decay: float = 1.0
    discount: float = 0.99
    trace: float = 0.95


@dataclass(frozen=True)
class Learner:
    """All that is static in a training: what is learned, by which method, how.

    Attributes:
        scene: where.
        method: which branches and losses.
        space: of types.
        statistics: of the expert.
        model: sizes.
        weights: of the losses.
        optimiser: options.
        updates: length of the training; learning rates follow it.
        batch: episodes of a minibatch.
        encoder_share: the paper's f.
        one_step: physics in place of the scene's own.
        shared: how the episodes of the minibatch are shared out among devices.
    """

    scene: Scene
    method: Method
    space: TypeSpace
    statistics: Statistics
    model: ModelOptions
    weights: LossWeights
    optimiser: OptimiserOptions
    updates: int
    batch: int
    encoder_share: float
    one_step: OneStep | None = None
    shared: Rows = ALL_ROWS

    def agent(self, networks: Networks) -> Agent:
        """The agent that these networks make."""
        return Agent(networks, self.statistics, self.model, self.space, self.scene)

    def rows(self, branch: Branch) -> slice:
        """The episodes of the minibatch that a branch takes."""
        return branch.rows(self.batch, self.encoder_share)

    def size(self, branch: Branch) -> int:
        """The number of these episodes, on all devices together."""
        rows = self.rows(branch)
        return rows.stop - rows.start

    @property
    def closed_loop(self) -> tuple[Branch, ...]:
        """The branches that are played."""
        return tuple(b for b in self.method.branches if CLOSED_LOOP & set(self.losses(b)))

    @property
    def faking(self) -> tuple[Branch, ...]:
        """The branches that L_adv and the discriminator read; all that are played, where the minibatch leaves nothing for those."""
        return tuple(b for b in self.method.faking(self.weights.fakes) if self.size(b)) or self.method.closed_loop

    def of_rollouts(self, values: Sequence[Any]) -> np.ndarray:
        """Of a value for each branch that is played, the one of each rollout that this device makes in an update."""
        return np.repeat(values, [self.scene.agents * self.shared.count(self.size(b)) for b in self.closed_loop])

    def losses(self, branch: Branch) -> tuple[str, ...]:
        """The losses of a branch: those that the scene has, L_adv where its rollouts are fakes, and recovery of types where it counts."""
        has = {
            "reconstruction": self.scene.reconstructs_rollouts,
            "adversarial": branch in self.faking,
            "type_recovery": bool(self.weights.type_recovery),
        }
        return tuple(name for name in branch.losses if has.get(name, True))

    @property
    def pathwise(self) -> bool:
        """Whether a loss is differentiated through the simulation."""
        return any(PATHWISE & set(self.losses(b)) for b in self.closed_loop)

    def part(self, branch: Branch, batch: Demonstration) -> Demonstration:
        """A branch's episodes of the minibatch, as far as this device has them, a row for each agent."""
        rows = self.rows(branch)
        return self.by_agent(self.shared.mine(jax.tree.map(lambda x: x[rows], batch), self.size(branch)))

    def by_agent(self, batch: Demonstration) -> Demonstration:
        """Joint demonstrations as rows of single agents'."""
        return merged(self.scene, jax.vmap(self.scene.views)(batch))

    def keys(self, key: Array, *sizes: int) -> Array:
        """A key for each of this device's rows, of branches with so many episodes."""
        keys = random.split(key, self.scene.agents * sum(sizes))
        return merged(self.scene, self.shared.mine(parted(self.scene, keys), *sizes))

    def types(self, source: str, agent: Agent, demonstration: Demonstration, key: Array) -> Typed:
        """Types of the agents of one episode, from a source of `agent_types.SOURCES`."""
        draw = self.scene.each(functools.partial(SOURCES[source], agent))
        return draw(self.scene.views(demonstration), self.scene.key_each(key))

    def play(self, agent: Agent, episode: Episode, agent_type: Array, key: Array, nudge: Array | None = None) -> Trajectory:
        """One rollout of the policy under one type, with `nudge` (T, outputs) added to its outputs to differentiate by.

        Of several agents types, keys and nudges have a leading axis, and the trajectory is joint.
        """
        options, actor = self.optimiser, crew(self.scene, self.scene.each(agent.actor)(agent_type, key, nudge))
        return rollout(self.scene, actor, episode, gradient=options.gradient, decay=options.decay, one_step=self.one_step)
