"""Where randomness comes from: one independent stream a purpose, so that a training and its test data share nothing by sharing a seed."""

from typing import Literal, get_args

import jax

Stream = Literal["networks", "updates", "demonstrations", "evaluation", "environment", "type shift", "reference"]


def stream(purpose: Stream, seed: jax.Array | int) -> jax.Array:
    """The key of a purpose under a seed."""
    return jax.random.fold_in(jax.random.key(seed), get_args(Stream).index(purpose))


def folded(keys: jax.Array, numbers: jax.Array) -> jax.Array:
    """Each of a vector of keys folded with each of a vector of numbers: one long vector, key by key."""
    return jax.vmap(lambda key: jax.vmap(lambda number: jax.random.fold_in(key, number))(numbers))(keys).reshape(-1)
