"""How much one random vector tells of another: a lower bound of their mutual information by a probe on held-out samples.

InfoNCE (van den Oord et al. 2018; Poole et al. 2019): a critic that picks the y of an x among the ys of others has learned at least so
much of what they share. Trained where nothing is shared (a permutation), it says what the estimate is worth: the null. Trained on a noisy
copy (`noisy_copy`), of which it is known how much it tells, it says what the estimate misses: the control.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jax import lax, random
from jaxtyping import Array, Float

from rtc_mjx.networks import MLP


@dataclass(frozen=True)
class ProbeOptions:
    """The probe.

    Attributes:
        width: units of a hidden layer.
        size: of the vectors whose product is the critic.
        updates: of its training.
        batch: samples of an update.
        every: updates after which it is tried on the samples that choose when to stop.
        block: samples among which it is measured; the mean over blocks counts, and cannot exceed the logarithm of this.
        learning_rate: Adam's.
        decay: of its weights.
        null: permutations.
    """

    width: int = 64
    size: int = 16
    updates: int = 500
    batch: int = 256
    every: int = 25
    block: int = 512
    learning_rate: float = 1e-3
    decay: float = 1e-2
    null: int = 8


def information(
    x: Float[np.ndarray, "samples a"], y: Float[np.ndarray, "samples b"], options: ProbeOptions = ProbeOptions(), members: int = 1
) -> tuple[float, np.ndarray]:
    """A lower bound of I(x; y) in bits, and the same estimate under permutations of y.

    Half of the samples teach the critic, a quarter chooses when to stop, a quarter is measured on.

    Args:
        x: one vector a row.
        y: the other of each row.
        options: of the probe.
        members: of a group: so many rows in a row belong together (agents of one episode); they stay in one part, and permutations
            exchange whole groups.

    Returns:
        The bound, and one value for each permutation.
    """
    groups = len(y) // members
    order = np.stack([np.arange(groups), *(np.random.default_rng(i).permutation(groups) for i in range(options.null))])
    rows = (order[:, :, None] * members + np.arange(members)).reshape(len(order), -1)
    left, right = (jnp.asarray(standard(values), jnp.float32) for values in (x, y))
    estimate = jax.jit(lambda rows: lax.map(lambda mine: _estimate(left, right[mine], parts(groups, members), options), rows))
    bits = np.asarray(estimate(jnp.asarray(rows)))
    return float(bits[0]), bits[1:]


def noisy_copy(x: Float[np.ndarray, "samples a"], size: int, bits: float) -> tuple[Float[np.ndarray, "samples size"], float]:
    """Random linear functions of x with Gaussian noise: a vector that is known to tell at most so many bits of x.

    Returns:
        The copy, and the most it can tell: what it would tell if these functions were Gaussian (of one covariance those tell most).
    """
    draw = np.random.default_rng(0)
    copy = standard(standard(x) @ draw.standard_normal((x.shape[1], size)))
    noise = 1 / (2 ** (2 * bits / size) - 1)  # its variance, if the functions had nothing in common
    most = np.linalg.slogdet(np.eye(size) + np.atleast_2d(np.cov(copy.T)) / noise)[1] / 2 / np.log(2)
    return copy + np.sqrt(noise) * draw.standard_normal(copy.shape), float(most)


def standard(values: np.ndarray) -> Float[np.ndarray, "samples numbers"]:
    """Rows as flat vectors of mean 0 and standard deviation 1; what never changes is 0."""
    flat = np.asarray(values, np.float64).reshape(len(values), -1)
    spread = flat.std(axis=0)
    return (flat - flat.mean(axis=0)) / np.where(spread > 1e-6, spread, 1.0)


def parts(groups: int, members: int) -> tuple[slice, slice, slice]:
    """The rows of half of the groups, of a quarter, and of the rest."""
    ends = [members * end for end in (0, groups // 2, groups * 3 // 4, groups)]
    return slice(*ends[:2]), slice(*ends[1:3]), slice(*ends[2:])


def _estimate(x: Array, y: Array, split: tuple[slice, slice, slice], options: ProbeOptions) -> Array:
    """The bound on the last part, with the critic that did best on the second."""
    (x_learn, y_learn), choose, measure = ((x[part], y[part]) for part in split)
    rngs = nnx.Rngs(0)
    sizes = [options.width, options.width, options.size]
    graph, start = nnx.split((MLP([x.shape[1], *sizes], rngs, 1.0), MLP([y.shape[1], *sizes], rngs, 1.0)))
    adam = optax.adamw(options.learning_rate, weight_decay=options.decay)

    def update(carry: tuple[Any, Any], key: Array) -> tuple[tuple[Any, Any], None]:
        weights, moments = carry
        everything = len(x_learn) <= options.batch
        rows = jnp.arange(len(x_learn)) if everything else random.permutation(key, len(x_learn))[: options.batch]
        slope = jax.grad(lambda w: -bound(nnx.merge(graph, w), x_learn[rows], y_learn[rows]))(weights)
        step, moments = adam.update(slope, moments, weights)
        return (optax.apply_updates(weights, step), moments), None

    def go_on(carry: tuple[Any, ...], keys: Array) -> tuple[tuple[Any, ...], None]:
        weights, moments, best, best_weights = carry
        (weights, moments), _ = lax.scan(update, (weights, moments), keys)
        now = in_blocks(nnx.merge(graph, weights), choose, options.block)
        best_weights = jax.tree.map(lambda a, b: jnp.where(now > best, a, b), weights, best_weights)
        return (weights, moments, jnp.maximum(now, best), best_weights), None

    keys = random.split(random.key(0), (max(1, options.updates // options.every), options.every))
    (_, _, _, chosen), _ = lax.scan(go_on, (start, adam.init(start), -jnp.inf, start), keys)
    return in_blocks(nnx.merge(graph, chosen), measure, options.block)


def in_blocks(critics: tuple[MLP, MLP], pairs: tuple[Array, Array], block: int) -> Float[Array, ""]:
    """The mean bound over blocks of equal size, at most `block`, of neighbouring rows; what fills no block is left out."""
    rows = len(pairs[0])
    count = -(-rows // block)
    size = rows // count
    blocks = tuple(side[: count * size].reshape(count, size, -1) for side in pairs)
    return jnp.mean(lax.map(lambda block: bound(critics, *block), blocks))


def bound(critics: tuple[MLP, MLP], x: Float[Array, "n a"], y: Float[Array, "n b"]) -> Float[Array, ""]:
    """InfoNCE in bits, the mean of both directions."""
    left, right = critics[0](x), critics[1](y)
    score = left @ right.T / left.shape[1] ** 0.5
    mine = jnp.diagonal(score)
    nats = jnp.log(len(x)) + mine - 0.5 * (jax.nn.logsumexp(score, axis=0) + jax.nn.logsumexp(score, axis=1))
    return jnp.mean(nats) / jnp.log(2.0)
