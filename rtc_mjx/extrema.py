"""The least and the largest of an axis, with a derivative that is finite however a program is compiled.

The derivative of `jnp.max` goes to the places that equal the maximum, and is shared out by their number. A compiler may compute a
place twice and round it differently; then none equals the maximum, and the derivative is 0 / 0. Here one place is found first, and
both the value and its derivative are read there.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int


def largest(x: Float[Array, "..."], axis: int) -> Float[Array, "..."]:
    """The maximum along an axis; of several that are equal the first has the derivative."""
    return at(x, jnp.argmax(lax.stop_gradient(x), axis, keepdims=True), axis)


def least(x: Float[Array, "..."], axis: int) -> Float[Array, "..."]:
    """The minimum along an axis; of several that are equal the first has the derivative."""
    return at(x, jnp.argmin(lax.stop_gradient(x), axis, keepdims=True), axis)


def at(x: Float[Array, "..."], index: Int[Array, "..."], axis: int) -> Float[Array, "..."]:
    """What stands at one place of an axis; `index` keeps the axis, with length 1."""
    return jnp.sum(jnp.where(lax.broadcasted_iota(index.dtype, x.shape, axis % x.ndim) == index, x, 0), axis)
