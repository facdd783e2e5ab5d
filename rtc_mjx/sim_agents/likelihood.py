"""How likely the log is among rollouts: a histogram for each agent, all times and rollouts pooled (Montali et al. 2023, section 4).

features of rollouts -> shares of bins, smoothed -> log-likelihood of the log's bin at each time -> mean over agents and times -> exp
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


@dataclass(frozen=True)
class Histogram:
    """How one feature is estimated and what it weighs.

    Attributes:
        weight: its share of the realism meta-metric.
        low: lower limit of the bins, in the feature's unit.
        high: upper limit; values outside the limits count in the outermost bins.
        bins: how many equal ones.
        smoothing: what is added to the count of every bin.
    """

    weight: float
    low: float
    high: float
    bins: int
    smoothing: float = 0.1

    def bin_of(self, values: Float[Array, "*batch"]) -> Int[Array, "*batch"]:
        """The bin of each value; -1, which is none, of what is not a number."""
        place = (jnp.clip(values, self.low, self.high) - self.low) * (self.bins / (self.high - self.low))
        held = jnp.minimum(jnp.floor(place), self.bins - 1)
        return jnp.where(jnp.isnan(held), -1, held).astype(int)


def indicator(weight: float) -> Histogram:
    """Of whether something happened: a Bernoulli variable, as two bins about 0 and 1."""
    return Histogram(weight, -0.5, 1.5, 2, smoothing=0.001)


def log_likelihood(
    estimate: Histogram,
    log: Float[Array, "times"],
    simulated: Float[Array, "rollouts times"],
    known: Bool[Array, "rollouts times"],
) -> Float[Array, "times"]:
    """Of one agent's logged values: ln of the smoothed share of their bins among its simulated values that are known."""
    held = estimate.bin_of(simulated)[..., None] == jnp.arange(estimate.bins)
    counts = jnp.sum(held & known[..., None], axis=(0, 1)) + estimate.smoothing
    return jnp.log(counts / jnp.sum(counts))[estimate.bin_of(log)]


def likelihood(
    estimate: Histogram,
    log: Float[Array, "agents times"],
    simulated: Float[Array, "rollouts agents times"],
    known: Bool[Array, "rollouts agents times"],
    counts: Bool[Array, "agents times"],
) -> Float[Array, ""]:
    """The geometric mean likelihood of the logged values that count, in (0, 1]; NaN where none counts."""
    logs = jax.vmap(lambda *agent: log_likelihood(estimate, *agent), in_axes=(0, 1, 1))(log, simulated, known)
    return jnp.exp(jnp.sum(jnp.where(counts, logs, 0.0)) / jnp.sum(counts))
