"""The shapes of networks: perceptrons, perceptrons that read sets of items, and an encoder of whole trajectories.

They are `flax.nnx` modules used as plain pytrees. All of them take flat vectors of standardised numbers; a network that reads sets
knows where in the vector the items are, and does not care in which order they come.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
from flax import nnx
from jax import lax
from jaxtyping import Array, Float

from rtc_mjx.extrema import largest
from rtc_mjx.products import dot_general
from rtc_mjx.scenes import ItemSet, split_items


@dataclass(frozen=True)
class Layout:
    """How the vector that a network reads is made up: plain numbers, then the items of each set, then more plain numbers.

    Attributes:
        own: how many plain numbers come first.
        sets: the sets, in order.
        extra: how many plain numbers come last (actions, a type).
    """

    own: int
    sets: tuple[ItemSet, ...]
    extra: int

    @property
    def plain(self) -> int:
        """How many plain numbers there are."""
        return self.own + self.extra

    def parts(self, x: Float[Array, "*batch inputs"]) -> tuple[Float[Array, "*batch plain"], list[Array]]:
        """The plain numbers, and the items (..., count, size) of each set."""
        return split_items(self.sets, self.own, x)


def linear(inputs: int, outputs: int, rngs: nnx.Rngs, scale: float = 1.0) -> nnx.Linear:
    """A layer whose outputs have a variance of `scale` times that of its inputs."""
    start = nnx.initializers.variance_scaling(scale, "fan_in", "truncated_normal")
    return nnx.Linear(inputs, outputs, kernel_init=start, dot_general=dot_general, rngs=rngs)


class MLP(nnx.Module):
    """A multi-layer perceptron with tanh units and a last layer that starts small."""

    def __init__(self, sizes: Sequence[int], rngs: nnx.Rngs, last_scale: float = 0.1) -> None:
        scales = [1.0] * (len(sizes) - 2) + [last_scale]
        self.layers = nnx.List([linear(a, b, rngs, s) for a, b, s in zip(sizes[:-1], sizes[1:], scales, strict=True)])

    def __call__(self, x: Array) -> Array:
        """The outputs; leading axes of `x` are batch."""
        for layer in self.layers[:-1]:
            x = jnp.tanh(layer(x))
        return self.layers[-1](x)


class Items(nnx.Module):
    """Each item of a set, seen beside the plain numbers, as a vector of features."""

    def __init__(self, size: int, plain: int, width: int, rngs: nnx.Rngs) -> None:
        self.item, self.beside, self.second = linear(size, width, rngs), linear(plain, width, rngs), linear(width, width, rngs)

    def __call__(self, items: Float[Array, "*batch count size"], plain: Float[Array, "*batch plain"]) -> Float[Array, "*batch count width"]:
        """The features."""
        return jnp.tanh(self.second(jnp.tanh(self.item(items) + self.beside(plain)[..., None, :])))


class Pool(nnx.Module):
    """A set as one vector: attention over its items, and the largest of each feature. The order of items changes nothing."""

    def __init__(self, size: int, plain: int, width: int, rngs: nnx.Rngs) -> None:
        self.items, self.score = Items(size, plain, width, rngs), linear(width, 1, rngs)

    def __call__(self, items: Float[Array, "*batch count size"], plain: Float[Array, "*batch plain"]) -> Float[Array, "*batch twice"]:
        """The vector; zero for an empty set."""
        there = items[..., :1] > 0.5
        features = self.items(items, plain)
        score = jnp.where(there, self.score(features), -30.0)
        share = jnp.exp(score - lax.stop_gradient(jnp.max(score, axis=-2, keepdims=True))) * there
        attended = jnp.sum(share * features, axis=-2) / jnp.maximum(jnp.sum(share, axis=-2), 1e-6)
        most = largest(jnp.where(there, features, -1.0), axis=-2) * jnp.any(there, axis=-2)
        return jnp.concatenate([attended, most], axis=-1)


class Reader(nnx.Module):
    """A perceptron on the plain numbers and on each set as one vector."""

    def __init__(self, layout: Layout, hidden: Sequence[int], outputs: int, rngs: nnx.Rngs, last_scale: float = 0.1) -> None:
        self.layout, width = layout, hidden[0]
        self.pools = nnx.List([Pool(s.size, layout.plain, width, rngs) for s in layout.sets])
        self.head = MLP([layout.plain + 2 * width * len(layout.sets), *hidden, outputs], rngs, last_scale)

    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        """The outputs."""
        plain, sets = self.layout.parts(x)
        return self.head(jnp.concatenate([plain, *(pool(items, plain) for pool, items in zip(self.pools, sets, strict=True))], axis=-1))


class Scores(nnx.Module):
    """A score for each item of the first set: which of them is chosen."""

    def __init__(self, layout: Layout, width: int, rngs: nnx.Rngs) -> None:
        self.layout = layout
        self.items, self.last = Items(layout.sets[0].size, layout.plain, width, rngs), linear(width, 1, rngs, 0.1)

    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch count"]:
        """Logits; far below the others for items that are not there."""
        plain, sets = self.layout.parts(x)
        return jnp.where(sets[0][..., 0] > 0.5, self.last(self.items(sets[0], plain))[..., 0], -30.0)


class Encoder(nnx.Module):
    """Reads a whole trajectory: a network on each step, the mean over steps, a perceptron on that."""

    def __init__(self, layout: Layout, outputs: int, width: int, depth: int, rngs: nnx.Rngs) -> None:
        self.step = Reader(layout, [width] * depth, width, rngs, last_scale=1.0)
        self.head = MLP([width, *[width] * (depth - 1), outputs], rngs)

    def __call__(self, steps: Float[Array, "steps inputs"]) -> Float[Array, "outputs"]:
        """The outputs for one trajectory."""
        return self.head(jnp.tanh(jnp.mean(self.step(steps), axis=0)))
