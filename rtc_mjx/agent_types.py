"""Types g: the spaces they live in, and where a branch of a method takes them from.

A type space turns the raw outputs of a network into a distribution over types. A source is a function (agent, demonstration, key)
-> `Typed`; which one a branch uses is what tells the methods apart (`rtc_mjx.methods`). Paper, section IV.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from rtc_mjx.distributions import Choice, Distribution, Gaussian, GaussianMixture, OneHot
from rtc_mjx.errors import UsageError
from rtc_mjx.pytree import pytree

if TYPE_CHECKING:
    from rtc_mjx.models import Agent
    from rtc_mjx.trajectory import Demonstration

SMALLEST_SCALE = 0.05  # of a Gaussian type: a narrower posterior would let densities grow without bound


class TypeSpace(Protocol):
    """A space of types."""

    @property
    def size(self) -> int:
        """Length of a type vector."""

    @property
    def points(self) -> bool:
        """Whether a type points at one of the items of the observation's first set (of the routes)."""

    @property
    def posterior_outputs(self) -> int:
        """How many numbers an encoder puts out."""

    @property
    def inference_outputs(self) -> int:
        """How many numbers InfoMGAIL's Q puts out."""

    @property
    def prior_outputs(self) -> int:
        """How many numbers parametrise the prior."""

    def posterior(self, outputs: Array) -> Distribution:
        """The distribution an encoder's outputs stand for."""

    def inference(self, outputs: Array) -> Distribution:
        """InfoMGAIL's Q(g|s,a); continuous: of unit sigma, since a learned one makes the objective unbounded."""

    def pooled(self, outputs: Array) -> Distribution:
        """What a whole trajectory says of the type, by Q's outputs at each of its steps (leading axis)."""

    def prior(self, outputs: Array) -> Distribution:
        """The learned prior."""

    def fixed_prior(self) -> Distribution:
        """The prior of methods that do not learn one."""


@dataclass(frozen=True)
class NoType:
    """The space of methods without types: vectors of length zero."""

    size: int = 0
    points: ClassVar[bool] = False
    posterior_outputs: int = 0
    inference_outputs: int = 0
    prior_outputs: int = 0

    def posterior(self, outputs: Array) -> Gaussian:
        """Nothing to infer."""
        return Gaussian(jnp.zeros(0), jnp.ones(0))

    inference = pooled = prior = posterior

    def fixed_prior(self) -> Gaussian:
        """Nothing to draw."""
        return Gaussian(jnp.zeros(0), jnp.ones(0))


@dataclass(frozen=True)
class Continuous:
    """Real vectors: Gaussian encoder, mixture-of-Gaussians prior.

    Attributes:
        size: dimension of a type.
        components: of the prior.
        posterior_components: of the encoder's posterior; one is a Gaussian.
    """

    size: int
    components: int
    posterior_components: int = 1
    points: ClassVar[bool] = False

    @property
    def posterior_outputs(self) -> int:
        """Mean and raw scale of each coordinate; of several components also the weight of each."""
        return 2 * self.size if self.posterior_components == 1 else self.posterior_components * (1 + 2 * self.size)

    @property
    def inference_outputs(self) -> int:
        """Mean and raw scale of each coordinate."""
        return 2 * self.size

    @property
    def prior_outputs(self) -> int:
        """Weight of each component, mean and raw scale of each of its coordinates."""
        return self.components * (1 + 2 * self.size)

    def posterior(self, outputs: Array) -> Distribution:
        """A Gaussian whose scale is at least SMALLEST_SCALE, and near 0.7 at outputs of zero; or a mixture of such."""
        if self.posterior_components > 1:
            return mixture_of(outputs, self.posterior_components, self.size, SMALLEST_SCALE)
        mean, raw = jnp.split(outputs, 2, axis=-1)
        return Gaussian(mean, scale_of(raw))

    def inference(self, outputs: Array) -> Gaussian:
        """A Gaussian of unit scale."""
        mean, _ = jnp.split(outputs, 2, axis=-1)
        return Gaussian(mean, jnp.ones_like(mean))

    def pooled(self, outputs: Array) -> Gaussian:
        """As many unit-scale observations of the type as there are steps: their mean, and its standard error."""
        mean, _ = jnp.split(outputs, 2, axis=-1)
        return Gaussian(jnp.mean(mean, axis=0), jnp.full(self.size, len(outputs) ** -0.5))

    def prior(self, outputs: Array) -> GaussianMixture:
        """The mixture."""
        return mixture_of(outputs, self.components, self.size, SMALLEST_SCALE)

    def fixed_prior(self) -> Gaussian:
        """The standard normal."""
        return Gaussian(jnp.zeros(self.size), jnp.ones(self.size))


@dataclass(frozen=True)
class Discrete:
    """One of a number of categories, as a one-hot vector.

    Attributes:
        size: number of categories.
    """

    size: int
    points: ClassVar[bool] = False

    @property
    def posterior_outputs(self) -> int:
        """One logit a category."""
        return self.size

    inference_outputs = prior_outputs = posterior_outputs

    def posterior(self, outputs: Array) -> OneHot:
        """The categorical distribution of the logits."""
        return OneHot(outputs)

    inference = prior = posterior

    def pooled(self, outputs: Array) -> OneHot:
        """Independent evidence multiplies: the sum of the log-probabilities of all steps."""
        return OneHot(jnp.sum(jax.nn.log_softmax(outputs), axis=0))

    def fixed_prior(self) -> OneHot:
        """All categories alike."""
        return OneHot(jnp.zeros(self.size))


@dataclass(frozen=True)
class Pointing(Discrete):
    """One of the items of the observation's first set: a route (Symphony). Its prior reads the first observation.

    Attributes:
        size: items that fit.
    """

    points: ClassVar[bool] = True

    def prior(self, outputs: Array) -> Choice:
        """The choice that the logits stand for."""
        return Choice(outputs)


@pytree
class Typed:
    """A type with the distribution it was drawn from.

    Attributes:
        agent_type: g.
        posterior: e(g|tau) where the encoder inferred it, else None.
    """

    agent_type: Float[Array, "*batch size"]
    posterior: Any


Source = Callable[["Agent", "Demonstration", Array], Typed]
Reading = Callable[["Agent", "Demonstration"], Distribution]


def scale_of(raw: Array, smallest: float = SMALLEST_SCALE) -> Array:
    """A standard deviation from a network's raw output: at least `smallest`, and near 0.7 at zero."""
    return smallest + jnp.logaddexp(raw, 0.0)


def mixture_of(outputs: Array, components: int, size: int, smallest: float) -> GaussianMixture:
    """A mixture of Gaussians from the outputs of a network: weights, means, raw scales."""
    logits, mean, raw = jnp.split(outputs, [components, components * (1 + size)], axis=-1)
    shape = (*outputs.shape[:-1], components, size)
    return GaussianMixture(logits, mean.reshape(shape), scale_of(raw.reshape(shape), smallest))


def from_none(agent: "Agent", demonstration: "Demonstration", key: Array) -> Typed:
    """No type: a vector of length zero."""
    return Typed(jnp.zeros(agent.space.size), None)


def from_fixed_prior(agent: "Agent", demonstration: "Demonstration", key: Array) -> Typed:
    """InfoMGAIL: a draw from a prior that is not learned."""
    prior = agent.space.fixed_prior()
    return Typed(prior.sample(prior.noise(key)), None)


def from_prior(agent: "Agent", demonstration: "Demonstration", key: Array) -> Typed:
    """g_p ~ p(g), with p held fixed: nothing flows back into the prior (paper, eq. 3)."""
    prior = agent.prior(demonstration.trajectory.observations[0])
    return Typed(lax.stop_gradient(prior.sample(prior.noise(key))), None)  # p fixed


def encoded(agent: "Agent", demonstration: "Demonstration") -> Distribution:
    """e(g|tau)."""
    return agent.posterior(demonstration.trajectory)


def inferred(agent: "Agent", demonstration: "Demonstration") -> Distribution:
    """What InfoMGAIL's Q says of a whole trajectory: it sees one step at a time, `pooled` puts the steps together."""
    track = demonstration.trajectory
    return agent.space.pooled(agent.inference_outputs(track.observations[:-1], track.actions))


def labelled(agent: "Agent", demonstration: "Demonstration") -> Choice:
    """The hand-made label; where several fit alike, each of them as likely.

    Raises:
        UsageError: the scene has none.
    """
    label = agent.scene.label(demonstration)
    if label is None:
        raise UsageError(f"scene {agent.scene.name} has no hand-made labels")
    return Choice(jnp.log(jnp.maximum(label, 1e-9)))


READINGS: dict[str, Reading] = {"encoder": encoded, "inference": inferred, "label": labelled}  # sources that read a trajectory


def from_encoder(agent: "Agent", demonstration: "Demonstration", key: Array) -> Typed:
    """g_e ~ e(g|tau), reparameterised: what is lost under g_e flows back into the encoder (paper, eq. 3)."""
    posterior = encoded(agent, demonstration)
    return Typed(posterior.sample(posterior.noise(key)), posterior)


def from_inference(agent: "Agent", demonstration: "Demonstration", key: Array) -> Typed:
    """InfoMGAIL's cloning: the type that Q itself reads off the demonstration, held fixed.

    A randomly paired type would teach the policy to ignore types.
    """
    held = inferred(agent, demonstration)
    return Typed(lax.stop_gradient(held.sample(held.noise(key))), None)


def from_label(agent: "Agent", demonstration: "Demonstration", key: Array) -> Typed:
    """Symphony: the hand-made label of the demonstration; one of them, where several fit alike.

    Raises:
        UsageError: the scene has none.
    """
    drawn = labelled(agent, demonstration)
    return Typed(lax.stop_gradient(drawn.sample(drawn.noise(key))), None)


SOURCES: dict[str, Source] = {
    "none": from_none,
    "fixed_prior": from_fixed_prior,
    "prior": from_prior,
    "encoder": from_encoder,
    "inference": from_inference,
    "label": from_label,
}
