"""How much one random vector tells of another: a lower bound of their mutual information by a probe on held-out samples.

InfoNCE (van den Oord et al. 2018; Poole et al. 2019): a critic that picks the y of an x among the ys of others has learned at least so
much of what they share. Trained where nothing is shared (a permutation), it says what the estimate is worth: the null.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jax import lax
from jaxtyping import Array, Float

from rtc_mjx.networks import MLP


@dataclass(frozen=True)
class ProbeOptions:
    """The probe.

    Attributes:
        width: units of a hidden layer.
        size: of the vectors whose product is the critic.
        updates: of its training.
        learning_rate: Adam's.
        decay: of its weights.
        null: permutations.
    """

    width: int = 64
    size: int = 16
    updates: int = 400
    learning_rate: float = 3e-3
    decay: float = 1e-2
    null: int = 16


def information(
    x: Float[np.ndarray, "samples a"], y: Float[np.ndarray, "samples b"], options: ProbeOptions = ProbeOptions()
) -> tuple[float, np.ndarray]:
    """A lower bound of I(x; y) in bits, and the same estimate under permutations of y.

    Half of the samples teach the critic, a quarter chooses when to stop, a quarter is measured on: the bound cannot exceed the
    logarithm of that quarter's size.

    Args:
        x: one vector a row.
        y: the other of each row.
        options: of the probe.

    Returns:
        The bound, and one value for each permutation.
    """
    order = np.stack([np.arange(len(y)), *(np.random.default_rng(i).permutation(len(y)) for i in range(options.null))])
    left, right = _standard(x), _standard(y)
    estimate = jax.jit(lambda order: lax.map(lambda rows: _estimate(left, right[rows], options), order))
    bits = np.asarray(estimate(jnp.asarray(order)))
    return float(bits[0]), bits[1:]


def _standard(values: np.ndarray) -> Array:
    flat = np.asarray(values, np.float64).reshape(len(values), -1)
    spread = flat.std(axis=0)
    return jnp.asarray((flat - flat.mean(axis=0)) / np.where(spread > 1e-6, spread, 1.0), jnp.float32)


def _estimate(x: Array, y: Array, options: ProbeOptions) -> Array:
    """The bound on the last quarter, with the critic that did best on the third."""
    learn, choose, measure = (tuple(a[part] for a in (x, y)) for part in _split(len(x)))
    rngs = nnx.Rngs(0)
    sizes = [options.width, options.width, options.size]
    graph, start = nnx.split((MLP([x.shape[1], *sizes], rngs, 1.0), MLP([y.shape[1], *sizes], rngs, 1.0)))
    adam = optax.adamw(options.learning_rate, weight_decay=options.decay)

    def update(carry: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], None]:
        weights, moments, best, best_weights = carry
        slope = jax.grad(lambda w: -bound(nnx.merge(graph, w), *learn))(weights)
        step, moments = adam.update(slope, moments, weights)
        weights = optax.apply_updates(weights, step)
        now = bound(nnx.merge(graph, weights), *choose)
        best_weights = jax.tree.map(lambda a, b: jnp.where(now > best, a, b), weights, best_weights)
        return (weights, moments, jnp.maximum(now, best), best_weights), None

    first = (start, adam.init(start), -jnp.inf, start)
    (_, _, _, chosen), _ = lax.scan(update, first, length=options.updates)
    return bound(nnx.merge(graph, chosen), *measure)


def _split(count: int) -> tuple[slice, slice, slice]:
    """Half, a quarter, the rest."""
    return slice(0, count // 2), slice(count // 2, count * 3 // 4), slice(count * 3 // 4, count)


def bound(critics: tuple[MLP, MLP], x: Float[Array, "n a"], y: Float[Array, "n b"]) -> Float[Array, ""]:
    """InfoNCE in bits, the mean of both directions."""
    left, right = critics[0](x), critics[1](y)
    score = left @ right.T / left.shape[1] ** 0.5
    mine = jnp.diagonal(score)
    nats = jnp.log(len(x)) + mine - 0.5 * (jax.nn.logsumexp(score, axis=0) + jax.nn.logsumexp(score, axis=1))
    return jnp.mean(nats) / jnp.log(2.0)
