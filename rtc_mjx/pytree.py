"""What crosses `jit`: frozen dataclasses that JAX sees as trees of their fields."""

import dataclasses
from collections.abc import Iterable
from typing import Any, TypeVar, dataclass_transform

import jax

T = TypeVar("T")


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
