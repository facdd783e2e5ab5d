"""Operations that only move elements, applied to arrays of node numbers: they cost nothing and leave no code.

Gather and scatter count as moves when their indices are known; `moved` returns None where they are not.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.lax import GatherScatterMode

Nodes = np.ndarray  # of node numbers, in the shape of the array they stand for


def broadcast_in_dim(x: Nodes, *, shape: Sequence[int], broadcast_dimensions: Sequence[int], **_: Any) -> Nodes:
    """See jax.lax.broadcast_in_dim."""
    kept = [x.shape[broadcast_dimensions.index(d)] if d in broadcast_dimensions else 1 for d in range(len(shape))]
    return np.broadcast_to(x.reshape(kept), shape)


def slice_(x: Nodes, *, start_indices: Sequence[int], limit_indices: Sequence[int], strides: Sequence[int] | None) -> Nodes:
    """See jax.lax.slice."""
    steps = strides or [1] * x.ndim
    return x[tuple(slice(*part) for part in zip(start_indices, limit_indices, steps, strict=True))]


def pad(x: Nodes, filler: Nodes, *, padding_config: Sequence[tuple[int, int, int]]) -> Nodes:
    """See jax.lax.pad; negative padding crops."""
    spread = [max(n + (n - 1) * inner, 0) for n, (_, _, inner) in zip(x.shape, padding_config, strict=True)]
    out = np.full(spread, filler.item(), np.int64)
    out[tuple(slice(None, None, inner + 1) for _, _, inner in padding_config)] = x
    around = [(max(low, 0), max(high, 0)) for low, high, _ in padding_config]
    out = np.pad(out, around, constant_values=filler.item())
    crop = [slice(max(-low, 0), n - max(-high, 0)) for n, (low, high, _) in zip(out.shape, padding_config, strict=True)]
    return out[tuple(crop)]


def split(x: Nodes, *, sizes: Sequence[int], axis: int) -> list[Nodes]:
    """See jax.lax.split."""
    return np.split(x, np.cumsum(sizes)[:-1], axis=axis)


MOVES: dict[str, Callable[..., Nodes]] = {
    "broadcast_in_dim": broadcast_in_dim,
    "slice": slice_,
    "pad": pad,
    "reshape": lambda x, *, new_sizes, **_: x.reshape(new_sizes),
    "squeeze": lambda x, *, dimensions: np.squeeze(x, tuple(dimensions)),
    "expand_dims": lambda x, *, dimensions: np.expand_dims(x, tuple(dimensions)),
    "transpose": lambda x, *, permutation: np.transpose(x, permutation),
    "rev": lambda x, *, dimensions: np.flip(x, dimensions),
    "concatenate": lambda *xs, dimension: np.concatenate(xs, dimension),
    "stack": lambda *xs, axis: np.stack(xs, axis),
    "tile": lambda x, *, reps: np.tile(x, reps),
    "copy": lambda x: x,
    "copy_p": lambda x: x,
    "optimization_barrier": lambda x: x,
}


def _starts(numbers: np.ndarray, group: tuple[int, ...], rank: int, index_map: Sequence[int], batching: Sequence[int],
            index_batching: Sequence[int]) -> np.ndarray:  # fmt: skip
    """Where in the operand the window of one index vector begins."""
    start = np.zeros(rank, np.int64)
    start[list(index_map)] = numbers[group]
    for dimension, source in zip(batching, index_batching, strict=True):
        start[dimension] = group[source]
    return start


def _placed(start: np.ndarray, room: np.ndarray, clips: bool) -> np.ndarray | None:
    """The start after the out-of-bounds rule: moved inside, or None where the window is dropped."""
    if clips:
        return np.clip(start, 0, room)
    return None if np.any(start < 0) or np.any(start > room) else start


def gather(x: Nodes, numbers: np.ndarray, filler: int, out_shape: Sequence[int], *, dimension_numbers: Any,
           slice_sizes: Sequence[int], mode: GatherScatterMode, **_: Any) -> Nodes:  # fmt: skip
    """jax.lax.gather with known indices; `filler` is the node that stands for out-of-bounds elements."""
    d = dimension_numbers
    window = [i for i in range(x.ndim) if i not in d.collapsed_slice_dims and i not in d.operand_batching_dims]
    batch = [i for i in range(len(out_shape)) if i not in d.offset_dims]
    room = np.array(x.shape) - np.array(slice_sizes)
    out = np.empty(out_shape, np.int64)
    for place in np.ndindex(*out_shape):
        group = tuple(place[i] for i in batch)
        start = _starts(numbers, group, x.ndim, d.start_index_map, d.operand_batching_dims, d.start_indices_batching_dims)
        placed = _placed(start, room, mode != GatherScatterMode.FILL_OR_DROP)  # XLA clips what is promised to be inside
        if placed is not None:
            placed[window] += np.array([place[i] for i in d.offset_dims], np.int64)
        out[place] = filler if placed is None else x[tuple(placed)]
    return out


def scatter(x: Nodes, numbers: np.ndarray, updates: Nodes, combine: Callable[[int, int], int], *, dimension_numbers: Any,
            mode: GatherScatterMode, **_: Any) -> Nodes:  # fmt: skip
    """jax.lax.scatter and its kin with known indices; `combine` makes the node of (old, update)."""
    d = dimension_numbers
    window = [i for i in range(x.ndim) if i not in d.inserted_window_dims and i not in d.operand_batching_dims]
    batch = [i for i in range(updates.ndim) if i not in d.update_window_dims]
    sizes = np.ones(x.ndim, np.int64)
    sizes[window] = [updates.shape[i] for i in d.update_window_dims]
    room = np.array(x.shape) - sizes
    out = np.array(x, np.int64)
    for place in np.ndindex(*updates.shape):
        group = tuple(place[i] for i in batch)
        start = _starts(numbers, group, x.ndim, d.scatter_dims_to_operand_dims, d.operand_batching_dims, d.scatter_indices_batching_dims)
        placed = _placed(start, room, mode == GatherScatterMode.CLIP)  # XLA drops what is outside
        if placed is not None:
            placed[window] += np.array([place[i] for i in d.update_window_dims], np.int64)
            out[tuple(placed)] = combine(int(out[tuple(placed)]), int(updates[place]))
    return out
