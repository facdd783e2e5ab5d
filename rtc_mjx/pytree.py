"""What crosses `jit`: frozen dataclasses that JAX sees as trees of their fields; and functions of long trees, part by part."""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np

T = TypeVar("T")
Watch = Callable[[Sequence[Any]], Iterable[Any]]


@dataclass_transform(frozen_default=True)
def pytree(cls: type[T]) -> type[T]:
    """Makes a frozen dataclass of a class and registers it with JAX.

    JAX rebuilds trees with leaves of its own (tracers, shapes, None) and extra axes; it does so without calling `__init__`, so
    that shape checks look at what people construct and not at what JAX passes through.
    """
    frozen = dataclasses.dataclass(frozen=True)(cls)
    names = [f.name for f in dataclasses.fields(frozen)]  # type: ignore[arg-type]  # T is any class until it is frozen

    def flatten(value: Any) -> tuple[list[tuple[jax.tree_util.GetAttrKey, Any]], None]:
        return [(jax.tree_util.GetAttrKey(n), getattr(value, n)) for n in names], None

    def unflatten(_: None, leaves: Iterable[Any]) -> Any:
        value = object.__new__(frozen)
        for name, leaf in zip(names, leaves, strict=True):
            object.__setattr__(value, name, leaf)
        return value

    jax.tree_util.register_pytree_with_keys(frozen, flatten, unflatten)
    return frozen


def stacked(trees: Iterable[Any]) -> Any:
    """Trees of one structure as one, with a leading axis."""
    return jax.tree.map(lambda *x: jnp.stack(x), *trees)


def in_parts(function: Callable[[Any], Any], tree: Any, at_once: int, watch: Watch = iter, fill: bool = False) -> Any:
    """A compiled function of a tree's leading axis, as numpy arrays: so many rows at once as memory allows.

    All parts are of one shape, so that one program does; rows that fill up the last part are cut off again.

    Args:
        function: keeps the leading axis.
        tree: arrays with equal leading axes.
        at_once: rows of a part.
        watch: goes through the parts, such as a progress bar.
        fill: whether fewer rows than `at_once` are filled up to as many, so that one program does for any number of rows.
    """
    count = jax.tree.leaves(tree)[0].shape[0]
    at_once, parts = at_once if fill else min(count, at_once), []
    for first in watch(range(0, count, at_once)):
        rows = np.arange(first, first + at_once) % count
        found = jax.device_get(function(jax.tree.map(lambda x, rows=rows: x[rows], tree)))
        parts.append(jax.tree.map(lambda x, left=count - first: x[:left], found))
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)
