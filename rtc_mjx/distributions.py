"""The distributions of actions and types: Gaussian, mixture of Gaussians, one-hot categorical.

Each is a pytree of its parameters for one sample space; batches are axes added by `vmap`. `noise` draws what a sample needs,
`sample` is then deterministic and differentiable in the parameters, so that gradients flow through samples (reparameterisation).
Choosing a component or a category cannot be reparameterised: the straight-through estimator stands in, and is biased.
"""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
from jax import lax, random
from jax.scipy.special import logsumexp
from jaxtyping import Array, Float

from rtc_mjx.pytree import pytree

UNIFORM_SHARE = 0.01  # of a one-hot distribution: keeps every log-probability and KL finite


class Distribution(Protocol):
    """What a distribution offers."""

    def noise(self, key: Array) -> Any:
        """Draws what one sample needs."""

    def sample(self, noise: Any) -> Array:
        """The sample that the noise stands for, differentiable in the parameters."""

    def log_prob(self, value: Array) -> Array:
        """Log-density or log-probability, in nats."""


@pytree
class Gaussian:
    """Independent normal variables.

    Attributes:
        mean: of each.
        scale: standard deviation of each.
    """

    mean: Float[Array, "*batch size"]
    scale: Float[Array, "*batch size"]

    def noise(self, key: Array) -> Array:
        """Standard normal numbers."""
        return random.normal(key, self.mean.shape)

    def sample(self, noise: Array) -> Array:
        """Mean + scale * noise: exact pathwise gradients."""
        return self.mean + self.scale * noise

    def log_prob(self, value: Array) -> Array:
        """Log-density in nats."""
        return jnp.sum(_normal_log_prob(value, self.mean, self.scale), axis=-1)

    def kl(self, other: "Gaussian") -> Array:
        """KL[self || other] in nats, closed form."""
        ratio, shift = self.scale / other.scale, (self.mean - other.mean) / other.scale
        return jnp.sum((ratio**2 + shift**2 - 1) / 2 - jnp.log(ratio), axis=-1)


@pytree
class GaussianMixture:
    """A mixture of Gaussians with independent coordinates.

    Attributes:
        logits: log-weights of the components, up to a constant.
        mean: of each coordinate in each component.
        scale: standard deviation of each coordinate in each component.
    """

    logits: Float[Array, "*batch components"]
    mean: Float[Array, "*batch components size"]
    scale: Float[Array, "*batch components size"]

    def noise(self, key: Array) -> tuple[Array, Array]:
        """Gumbel numbers that choose the component, standard normal numbers within it."""
        choose, within = random.split(key)
        return random.gumbel(choose, self.logits.shape), random.normal(within, self.mean[..., 0, :].shape)

    def sample(self, noise: tuple[Array, Array], choice_gradient: bool = True) -> Array:
        """One component, drawn straight-through, and a reparameterised sample inside it.

        The gradient with respect to means and scales is exact given the component. With respect to the weights it is biased:
        the backward pass behaves as if the sample were the average of all components under their weights; without
        `choice_gradient` it is zero.
        """
        gumbel, normal = noise
        chosen = straight_through(jax.nn.softmax(self.logits), self.logits + gumbel)
        chosen = chosen if choice_gradient else lax.stop_gradient(chosen)
        return jnp.einsum("...k,...ki->...i", chosen, self.mean + self.scale * normal[..., None, :])

    def log_prob(self, value: Array) -> Array:
        """Log-density in nats."""
        each = jnp.sum(_normal_log_prob(value[..., None, :], self.mean, self.scale), axis=-1)
        return logsumexp(jax.nn.log_softmax(self.logits) + each, axis=-1)


@pytree
class OneHot:
    """A categorical variable as a one-hot vector, mixed with a little of the uniform distribution.

    Attributes:
        logits: log-probabilities before mixing, up to a constant.
    """

    logits: Float[Array, "*batch categories"]

    @property
    def probabilities(self) -> Float[Array, "*batch categories"]:
        """Of each category; at least UNIFORM_SHARE / categories."""
        return (1 - UNIFORM_SHARE) * jax.nn.softmax(self.logits) + UNIFORM_SHARE / self.logits.shape[-1]

    def noise(self, key: Array) -> Array:
        """Gumbel numbers, one per category."""
        return random.gumbel(key, self.logits.shape)

    def sample(self, noise: Array) -> Array:
        """A one-hot vector; its gradient is that of the probabilities (straight-through, biased)."""
        return straight_through(self.probabilities, jnp.log(self.probabilities) + noise)

    def log_prob(self, value: Array) -> Array:
        """Log-probability of a one-hot vector, in nats."""
        return jnp.sum(value * jnp.log(self.probabilities), axis=-1)

    def kl(self, other: "OneHot") -> Array:
        """KL[self || other] in nats, closed form."""
        p, q = self.probabilities, other.probabilities
        return jnp.sum(p * (jnp.log(p) - jnp.log(q)), axis=-1)


@pytree
class Choice(OneHot):
    """A categorical variable as a one-hot vector, as the logits say: a category far below the others is never drawn.

    Attributes:
        logits: log-probabilities, up to a constant.
    """

    @property
    def probabilities(self) -> Float[Array, "*batch categories"]:
        """Of each category."""
        return jnp.maximum(jax.nn.softmax(self.logits), 1e-12)


def kl(p: Distribution, q: Distribution, sample: Array, key: Array) -> Array:
    """KL[p || q] in nats: closed form where both are of one kind that has it; of a mixture, estimated by a sample of each component.

    Otherwise by `sample`, which is one of p.
    """
    if type(p) is type(q) and isinstance(p, Gaussian | OneHot):
        return p.kl(q)  # type: ignore[arg-type]  # both are of the same type
    if isinstance(p, GaussianMixture):
        each = p.mean + p.scale * random.normal(key, p.mean.shape)  # exact pathwise gradients, those by the weights included
        return jnp.sum(jax.nn.softmax(p.logits) * jax.vmap(lambda g: p.log_prob(g) - q.log_prob(g))(each))
    return p.log_prob(sample) - q.log_prob(sample)


def straight_through(probabilities: Array, scores: Array) -> Array:
    """The one-hot vector of the highest score, with the gradient of the probabilities."""
    chosen = jax.nn.one_hot(jnp.argmax(scores, axis=-1), scores.shape[-1], dtype=probabilities.dtype)
    return lax.stop_gradient(chosen - probabilities) + probabilities


def _normal_log_prob(value: Array, mean: Array, scale: Array) -> Array:
    return -0.5 * ((value - mean) / scale) ** 2 - jnp.log(scale) - 0.5 * jnp.log(2 * jnp.pi)
