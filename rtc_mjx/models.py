"""The agent's networks: policy pi(a|s,g), encoder e(g|tau), prior p(g), discriminator D(s,a), Q(g|s,a) of InfoMGAIL, V(s,g) of GAIL.

`Agent` bundles the networks (`rtc_mjx.networks`) with what is not learned (input statistics, the type space, the scene) and gives
each the name that the losses use. All functions take one trajectory or one step.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jax.tree_util import Partial
from jaxtyping import Array, Float

from rtc_mjx.agent_types import TypeSpace, mixture_of
from rtc_mjx.distributions import Distribution, GaussianMixture
from rtc_mjx.networks import Encoder, Layout, Reader, Scores
from rtc_mjx.pytree import pytree
from rtc_mjx.scenes import Actor, Scene
from rtc_mjx.trajectory import Trajectory


@dataclass(frozen=True)
class ModelOptions:
    """Sizes of the networks and of the types.

    Attributes:
        width: units of a hidden layer.
        discriminator_width: units of a hidden layer of the discriminator.
        depth: hidden layers of each network.
        mixture: components of the policy's Gaussian mixture.
        choice_gradient: whether what a rollout loses moves the weights of the mixture, by the biased straight-through estimator;
            if not, likelihood alone decides how often each component is chosen.
        smallest_scale: lower bound of the policy's standard deviation, in the scene's units of the controls.
        type_size: dimension of a continuous type.
        type_count: number of discrete types.
        prior_components: of the continuous prior.
        posterior_components: of the encoder's posterior over continuous types; with more than one it can say "one of these", as of a
            demonstration that ends before it shows its type.
    """

    width: int = 64
    discriminator_width: int = 64
    depth: int = 2
    mixture: int = 2
    choice_gradient: bool = True
    smallest_scale: float = 0.05
    type_size: int = 4
    type_count: int = 8
    prior_components: int = 8
    posterior_components: int = 1


@pytree
class Networks:
    """All that is learned; None where a method has no such part.

    Attributes:
        policy: (s, g) -> outputs that parametrise the action distribution.
        encoder: tau -> outputs that parametrise e(g|tau).
        prior: outputs that parametrise p(g).
        discriminator: (s, a) -> logit of "this is the expert".
        inference: (s, a) -> outputs that parametrise Q(g|s,a).
        value: (s, g, share of the episode that is left) -> mean reward from here on.
    """

    policy: Any
    encoder: Any
    prior: Any
    discriminator: Any
    inference: Any
    value: Any = None


@pytree
class Statistics:
    """Mean and standard deviation of the expert's observations and actions; every network sees standardised inputs."""

    observation_mean: Float[Array, "features"]
    observation_scale: Float[Array, "features"]
    action_mean: Float[Array, "controls"]
    action_scale: Float[Array, "controls"]


@dataclass(frozen=True)
class Agent:
    """Networks with what they need to be read: one agent, of one seed.

    Attributes:
        networks: what is learned.
        statistics: of the expert, for inputs.
        options: sizes.
        space: of types.
        scene: what it acts in.
    """

    networks: Networks
    statistics: Statistics
    options: ModelOptions
    space: TypeSpace
    scene: Scene

    @property
    def outputs(self) -> int:
        """How many numbers the policy puts out."""
        return output_count(self.options, self.scene.controls)

    def actor(self, agent_type: Array, key: Array, nudge: Array | None = None) -> Actor:
        """The policy under one type, with the noise of T actions; `nudge` (T, outputs) is added to its outputs."""
        draw = self.action_distribution(jnp.zeros(self.outputs)).noise
        nudge = jnp.zeros((self.scene.steps, self.outputs)) if nudge is None else nudge

        def act(agent_type: Array, memory: tuple[()], observation: Array, given: tuple[Any, Array]) -> tuple[tuple[()], Array]:
            noise, push = given
            choice = self.action_distribution(self.policy_outputs(observation, agent_type) + push)
            return memory, choice.sample(noise, self.options.choice_gradient)

        return Actor((), Partial(act, agent_type), (jax.vmap(draw)(jax.random.split(key, self.scene.steps)), nudge))

    def policy_outputs(self, observation: Array, agent_type: Array) -> Array:
        """The policy network on one observation in the scene's units, or on an array of them, and a type."""
        return self.networks.policy(self._seen_as(observation, agent_type))

    def action_distribution(self, outputs: Array) -> GaussianMixture:
        """pi(a|s,g) from the policy's outputs, which are in the scene's units: a mixture of Gaussians in the actuators' units."""
        unit = jnp.asarray(self.scene.control_unit, outputs.dtype)
        held = mixture_of(outputs, self.options.mixture, len(unit), self.options.smallest_scale)
        return GaussianMixture(held.logits, held.mean * unit, held.scale * unit)

    def posterior(self, trajectory: Trajectory) -> Distribution:
        """e(g|tau): reads all states and actions, the last state included."""
        last = jnp.zeros_like(trajectory.actions[:1])
        steps = jnp.concatenate([self._seen(trajectory.observations), jnp.concatenate([self._done(trajectory.actions), last])], axis=-1)
        return self.space.posterior(self.networks.encoder(steps))

    def prior(self, observation: Array) -> Distribution:
        """p(g), of an episode's first observation where types point at its items, otherwise the same for all episodes."""
        return self.space.prior(self.networks.prior(self._seen(observation)) if self.space.points else self.networks.prior)

    def logit(self, observation: Array, action: Array) -> Array:
        """The discriminator's log-odds that the expert acted; it never sees the type."""
        return self.networks.discriminator(self.pair(observation, action))[..., 0]

    def inference_outputs(self, observation: Array, action: Array) -> Array:
        """Outputs that parametrise Q(g|s,a)."""
        return self.networks.inference(self.pair(observation, action))

    def value(self, observations: Float[Array, "steps_and_one features"], agent_type: Array) -> Float[Array, "steps_and_one"]:
        """The mean reward from each time of an episode on, as V expects it."""
        left = jnp.linspace(1.0, 0.0, len(observations))[:, None]  # not the policy's to see: a baseline may know more
        return self.networks.value(jnp.concatenate([self._seen_as(observations, agent_type), left], axis=-1))[..., 0]

    def pair(self, observation: Array, action: Array) -> Array:
        """A standardised state-action pair, as the discriminator reads it."""
        return jnp.concatenate([self._seen(observation), self._done(action)], axis=-1)

    def _seen(self, observation: Array) -> Array:
        standard = (observation - self.statistics.observation_mean) / self.statistics.observation_scale
        if not self.scene.sets:
            return standard
        own, items = observation_layout(self.scene, observation.shape[-1]).parts(standard)
        there = [jnp.where(x[..., :1] > 0.5, x, 0.0).reshape(*own.shape[:-1], -1) for x in items]  # an item that is not there says nothing
        return jnp.concatenate([own, *there], axis=-1)

    def _seen_as(self, observation: Array, agent_type: Array) -> Array:
        """What policy and V read of observations and a type.

        A type that points at an item of the observation's first set is shown as one more number of each of these items.
        """
        seen, kind = self._seen(observation), jnp.broadcast_to(agent_type, (*observation.shape[:-1], self.space.size))
        if not self.space.points:
            return jnp.concatenate([seen, kind], axis=-1)
        layout = observation_layout(self.scene, seen.shape[-1])
        own, (first, *rest) = layout.parts(seen)
        marked = jnp.concatenate([first, kind[..., None]], axis=-1)
        return jnp.concatenate([x.reshape(*own.shape[:-1], -1) for x in (own, marked, *rest)], axis=-1)

    def _done(self, action: Array) -> Array:
        return (action - self.statistics.action_mean) / self.statistics.action_scale


def output_count(options: ModelOptions, controls: int) -> int:
    """Numbers that parametrise a mixture over controls: weights, means, raw scales."""
    return options.mixture * (1 + 2 * controls)


def observation_layout(scene: Scene, features: int, extra: int = 0) -> Layout:
    """How an observation of so many features is made up, with so many numbers after it."""
    return Layout(features - sum(held.count * held.size for held in scene.sets), scene.sets, extra)


def make_networks(key: Array, scene: Scene, features: int, space: TypeSpace, options: ModelOptions, parts: frozenset[str]) -> Networks:
    """Draws the networks of one seed; `parts` names the optional ones that the method has."""
    rngs, controls = nnx.Rngs(key), scene.controls
    width, hidden = options.width, [options.width] * options.depth
    pair, alone = observation_layout(scene, features, controls), observation_layout(scene, features)
    typed = dataclasses.replace(alone, extra=space.size)
    if space.points:
        first, *rest = scene.sets
        typed = dataclasses.replace(alone, sets=(dataclasses.replace(first, size=first.size + 1), *rest))
    builders: dict[str, Callable[[], Any]] = {
        "policy": lambda: Reader(typed, hidden, output_count(options, controls), rngs),
        "encoder": lambda: Encoder(pair, space.posterior_outputs, width, options.depth, rngs),
        "prior": lambda: Scores(alone, width, rngs) if space.points else jax.random.normal(rngs(), (space.prior_outputs,)),
        "discriminator": lambda: Reader(pair, [options.discriminator_width] * options.depth, 1, rngs),
        "inference": lambda: Reader(pair, hidden, space.inference_outputs, rngs),
        "value": lambda: Reader(dataclasses.replace(typed, extra=typed.extra + 1), hidden, 1, rngs),
    }
    return Networks(**{name: build() if name in parts | {"policy"} else None for name, build in builders.items()})
