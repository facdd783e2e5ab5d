"""The agent's networks: policy pi(a|s,g), encoder e(g|tau), prior p(g), discriminator D(s,a) and InfoMGAIL's Q(g|s,a).

The networks are `flax.nnx` modules used as plain pytrees. `Agent` bundles them with what is not learned (input statistics, the
type space, the scene) and gives each the name that the losses use. All functions take one trajectory or one step.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from rtc_mjx.agent_types import TypeSpace, mixture_of
from rtc_mjx.distributions import Distribution, GaussianMixture
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
        smallest_scale: lower bound of the policy's standard deviation, in units of the control.
        type_size: dimension of a continuous type.
        type_count: number of discrete types.
        prior_components: of the continuous prior.
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


class MLP(nnx.Module):
    """A multi-layer perceptron with tanh units and a last layer that starts small."""

    def __init__(self, sizes: Sequence[int], rngs: nnx.Rngs, last_scale: float = 0.1) -> None:
        def layer(a: int, b: int, scale: float) -> nnx.Linear:
            return nnx.Linear(a, b, kernel_init=nnx.initializers.variance_scaling(scale, "fan_in", "truncated_normal"), rngs=rngs)

        scales = [1.0] * (len(sizes) - 2) + [last_scale]
        self.layers = nnx.List([layer(a, b, s) for a, b, s in zip(sizes[:-1], sizes[1:], scales, strict=True)])

    def __call__(self, x: Array) -> Array:
        """The outputs; leading axes of `x` are batch."""
        for layer in self.layers[:-1]:
            x = jnp.tanh(layer(x))
        return self.layers[-1](x)


class Encoder(nnx.Module):
    """Reads a whole trajectory: a perceptron on each step, the mean over steps, a perceptron on that."""

    def __init__(self, inputs: int, outputs: int, width: int, depth: int, rngs: nnx.Rngs) -> None:
        self.step = MLP([inputs, *[width] * (depth + 1)], rngs, last_scale=1.0)
        self.head = MLP([width, *[width] * (depth - 1), outputs], rngs)

    def __call__(self, steps: Float[Array, "steps inputs"]) -> Float[Array, "outputs"]:
        """The outputs for one trajectory."""
        return self.head(jnp.tanh(jnp.mean(self.step(steps), axis=0)))


@pytree
class Networks:
    """All that is learned; None where a method has no such part.

    Attributes:
        policy: (s, g) -> outputs that parametrise the action distribution.
        encoder: tau -> outputs that parametrise e(g|tau).
        prior: outputs that parametrise p(g).
        discriminator: (s, a) -> logit of "this is the expert".
        inference: (s, a) -> outputs that parametrise Q(g|s,a).
    """

    policy: Any
    encoder: Any
    prior: Any
    discriminator: Any
    inference: Any


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
        return output_count(self.options, len(self.scene.world.control_ids))

    def actor(self, agent_type: Array, key: Array, nudge: Array | None = None) -> Actor:
        """The policy under one type, with the noise of T actions; `nudge` (T, outputs) is added to its outputs."""
        draw = self.action_distribution(jnp.zeros(self.outputs)).noise
        nudge = jnp.zeros((self.scene.steps, self.outputs)) if nudge is None else nudge

        def act(memory: tuple[()], observation: Array, given: tuple[Any, Array]) -> tuple[tuple[()], Array]:
            noise, push = given
            choice = self.action_distribution(self.policy_outputs(observation, agent_type) + push)
            return memory, choice.sample(noise, self.options.choice_gradient)

        return Actor((), act, (jax.vmap(draw)(jax.random.split(key, self.scene.steps)), nudge))

    def policy_outputs(self, observation: Array, agent_type: Array) -> Array:
        """The policy network on one observation in the scene's units, or on an array of them, and a type."""
        kind = jnp.broadcast_to(agent_type, (*observation.shape[:-1], self.space.size))
        return self.networks.policy(jnp.concatenate([self._seen(observation), kind], axis=-1))

    def action_distribution(self, outputs: Array) -> GaussianMixture:
        """pi(a|s,g) from the policy's outputs: a mixture of Gaussians in the actuators' units."""
        controls = self.statistics.action_mean.shape[-1]
        return mixture_of(outputs, self.options.mixture, controls, self.options.smallest_scale)

    def posterior(self, trajectory: Trajectory) -> Distribution:
        """e(g|tau): reads all states and actions, the last state included."""
        last = jnp.zeros_like(trajectory.actions[:1])
        steps = jnp.concatenate([self._seen(trajectory.observations), jnp.concatenate([self._done(trajectory.actions), last])], axis=-1)
        return self.space.posterior(self.networks.encoder(steps))

    def prior(self) -> Distribution:
        """p(g)."""
        return self.space.prior(self.networks.prior)

    def logit(self, observation: Array, action: Array) -> Array:
        """The discriminator's log-odds that the expert acted; it never sees the type."""
        return self.networks.discriminator(self.pair(observation, action))[..., 0]

    def inference_outputs(self, observation: Array, action: Array) -> Array:
        """Outputs that parametrise Q(g|s,a)."""
        return self.networks.inference(self.pair(observation, action))

    def pair(self, observation: Array, action: Array) -> Array:
        """A standardised state-action pair, as the discriminator reads it."""
        return jnp.concatenate([self._seen(observation), self._done(action)], axis=-1)

    def _seen(self, observation: Array) -> Array:
        return (observation - self.statistics.observation_mean) / self.statistics.observation_scale

    def _done(self, action: Array) -> Array:
        return (action - self.statistics.action_mean) / self.statistics.action_scale


def output_count(options: ModelOptions, controls: int) -> int:
    """Numbers that parametrise a mixture over controls: weights, means, raw scales."""
    return options.mixture * (1 + 2 * controls)


def make_networks(key: Array, scene: Scene, features: int, space: TypeSpace, options: ModelOptions, parts: frozenset[str]) -> Networks:
    """Draws the networks of one seed; `parts` names the optional ones that the method has."""
    rngs, controls = nnx.Rngs(key), len(scene.world.control_ids)
    hidden = [options.width] * options.depth
    pair = features + controls
    builders: dict[str, Callable[[], Any]] = {
        "policy": lambda: MLP([features + space.size, *hidden, output_count(options, controls)], rngs),
        "encoder": lambda: Encoder(pair, space.posterior_outputs, options.width, options.depth, rngs),
        "prior": lambda: jax.random.normal(rngs(), (space.prior_outputs,)),
        "discriminator": lambda: MLP([pair, *[options.discriminator_width] * options.depth, 1], rngs),
        "inference": lambda: MLP([pair, *hidden, space.posterior_outputs], rngs),
    }
    return Networks(**{name: build() if name in parts | {"policy"} else None for name, build in builders.items()})
