"""The product of many rows with one matrix, flat however many batch axes there are.

The gradient by the matrix adds up over all rows. Where `vmap` leaves the rows on several axes, XLA sums over all of these at once, and
on a CPU first writes both factors out with these axes last, which takes several times as long as the product itself. Here all axes
become one before the product, so that its gradients are products of two plain matrices.
"""

import math
from typing import Any

from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, Float


def dot_general(
    rows: Float[Array, "*batch inputs"],
    matrix: Float[Array, "inputs outputs"],
    dimension_numbers: Any = None,
    precision: Any = None,
    out_sharding: None = None,
) -> Float[Array, "*batch outputs"]:
    """Rows times matrix, in place of `lax.dot_general` in a layer of `flax.nnx`.

    Args:
        rows: any number of batch axes, none included.
        matrix: of the layer.
        dimension_numbers: as of `lax.dot_general`; the last axis of the rows and the first of the matrix, or None.
        precision: as of `lax.dot_general`.
        out_sharding: None; `shard_map` without checks of its axes is what shares out rows here.

    Raises:
        ValueError: other axes, or a sharding.
    """
    if dimension_numbers not in (None, (((rows.ndim - 1,), (0,)), ((), ()))) or out_sharding is not None:
        raise ValueError(f"only rows times matrix: {dimension_numbers}, {out_sharding}")
    flat = rows.reshape(math.prod(rows.shape[:-1]), rows.shape[-1])
    return _product_p.bind(flat, matrix, precision=precision).reshape(*rows.shape[:-1], matrix.shape[1])


def _plain(rows: Array, matrix: Array, *, precision: Any) -> Array:
    return lax.dot_general(rows, matrix, (((1,), (0,)), ((), ())), precision=precision)


def _by_matrix(cotangent: Array, rows: Array, _matrix: Any, *, precision: Any) -> Array:
    return lax.dot_general(rows, cotangent, (((0,), (0,)), ((), ())), precision=precision)


def _by_rows(cotangent: Array, _rows: Any, matrix: Array, *, precision: Any) -> Array:
    return _product_p.bind(cotangent, matrix.T, precision=precision)


def _over_batch(arrays: tuple[Array, Array], axes: tuple[int | None, int | None], *, precision: Any) -> tuple[Array, int]:
    (rows, matrix), (axis, of_matrix) = arrays, axes
    if of_matrix is None:
        stacked = batching.bdim_at_front(rows, axis, len(rows))  # the size counts only where there is no axis
        return dot_general(stacked, matrix, precision=precision), 0
    count = matrix.shape[of_matrix]
    rows, matrix = batching.bdim_at_front(rows, axis, count), batching.bdim_at_front(matrix, of_matrix, count)
    return lax.dot_general(rows, matrix, (((2,), (1,)), ((0,), (0,))), precision=precision), 0


_product_p = Primitive("rows_times_matrix")
_product_p.def_impl(_plain)
_product_p.def_abstract_eval(lambda rows, matrix, **_: rows.update(shape=(rows.shape[0], matrix.shape[1]), weak_type=False))
ad.defbilinear(_product_p, _by_rows, _by_matrix)
batching.primitive_batchers[_product_p] = _over_batch
mlir.register_lowering(_product_p, mlir.lower_fun(_plain, multiple_results=False))
