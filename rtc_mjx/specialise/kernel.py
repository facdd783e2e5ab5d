"""A kernel: hundreds of scalar nodes as one operation that JAX traces, batches and drops as a whole.

On a CPU, XLA runs each scalar operation of a vmapped program as a loop of its own over the batch. A kernel runs them all in one
loop, in registers. StableHLO has no such construct, but its reduce carries a whole scalar computation, and this is a
reduction in the strict sense: over two tagged elements, (0, x) and (1, x), with

    (-1, .) the identity,   (0, x) + (1, x) = (1, x) + (0, x) = (2, f(x)),

so any order and any number of identities that XLA may insert give f(x). What the compiler needs to make one vectorised loop of
it is in docs/physics.md. The scalar operations are traced only when the kernel is lowered: whatever transformations a program
goes through, JAX looks at each of them once.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import batching, mlir

from rtc_mjx.specialise.graph import ELEMENTWISE, Graph, Node

IDENTITY, RESULT = -1, 2  # tags, beside 0 and 1 of the two elements
Values = dict[Node, Any]


@dataclass(frozen=True, eq=False)
class Kernel:
    """A run of scalar nodes.

    Attributes:
        graph: where the nodes live.
        part: the nodes, in order of evaluation.
        taken: nodes that they need from outside.
        needed: those of them that are needed outside.
    """

    graph: Graph
    part: tuple[Node, ...]
    taken: tuple[Node, ...]
    needed: tuple[Node, ...]

    def __call__(self, *values: Any) -> list[jax.Array]:
        """The needed values of the taken ones, as one operation; vmap makes it one over the whole batch."""
        return _kernel_p.bind(*values, kernel=self)

    def reduction(self, *arrays: Any) -> list[jax.Array]:
        """The reduction of the module docstring, over arrays of one shape.

        A pass that drops unused results of a reduction (StableHLO's target-independent optimisation) walks the body without
        remembering where it has been, which is exponential in shared sub-expressions; it does not start if all are used.
        """
        source, target, dtypes = self._slots()
        shape, given = np.shape(arrays[0]), dict(zip(self.taken, arrays, strict=True))  # what takes nothing would be constant
        zeros = [np.zeros((), dtype) for dtype in dtypes]
        doubled = [jnp.broadcast_to(zero if n is None else given[n], (2, *shape)) for n, zero in zip(source, zeros, strict=True)]
        tags = lax.broadcasted_iota(np.int32, (2, *shape), 0)  # not an array of constants: LLVM must see through them

        def combine(left: Sequence[Any], right: Sequence[Any]) -> tuple[Any, ...]:
            inner = {n: x for n, x in zip(source, right[1:], strict=True) if n is not None}
            run_scalars(self.graph, self.part, inner)
            both = (left[0] >= 0) & (right[0] >= 0)
            either = [lax.select(right[0] >= 0, b, a) for a, b in zip(left[1:], right[1:], strict=True)]
            made = [x if n is None else lax.select(both, inner[n], x) for n, x in zip(target, either, strict=True)]
            return (lax.select(both, np.int32(RESULT), lax.max(left[0], right[0])), *made)

        results = lax.reduce((tags, *doubled), (np.int32(IDENTITY), *zeros), combine, (0,))
        made = dict(zip(target, lax.optimization_barrier(tuple(results))[1:], strict=True))  # every result used: see the docstring
        return [made[n] for n in self.needed]

    def _slots(self) -> tuple[list[Node | None], list[Node | None], list[np.dtype]]:
        """What goes in and what comes out of each element of the reduction, and its type; a slot may serve one way only."""
        source: list[Node | None] = []
        target: list[Node | None] = []
        dtypes: list[np.dtype] = []
        for dtype in sorted({self.graph.dtypes[n] for n in (*self.taken, *self.needed)}, key=str):
            into, out = ([n for n in nodes if self.graph.dtypes[n] == dtype] for nodes in (self.taken, self.needed))
            count = max(len(into), len(out))
            source += [*into, *[None] * (count - len(into))]
            target += [*out, *[None] * (count - len(out))]
            dtypes += [dtype] * count
        return source, target, dtypes


def _types(*arrays: Any, kernel: Kernel) -> list[jax.core.ShapedArray]:
    return [jax.core.ShapedArray(arrays[0].shape, kernel.graph.dtypes[n]) for n in kernel.needed]


def _over_batch(arrays: Sequence[Any], axes: Sequence[int | None], *, kernel: Kernel) -> tuple[list[jax.Array], list[int]]:
    size = next(x.shape[axis] for x, axis in zip(arrays, axes, strict=True) if axis is not None)
    full = [batching.bdim_at_front(x, axis, size) for x, axis in zip(arrays, axes, strict=True)]
    return kernel(*full), [0] * len(kernel.needed)


def _reduced(*arrays: Any, kernel: Kernel) -> list[jax.Array]:
    return kernel.reduction(*arrays)


_kernel_p = Primitive("kernel")
_kernel_p.multiple_results = True
_kernel_p.def_impl(_reduced)
_kernel_p.def_abstract_eval(_types)
batching.primitive_batchers[_kernel_p] = _over_batch
mlir.register_lowering(_kernel_p, mlir.lower_fun(_reduced, multiple_results=True))


def value(graph: Graph, node: Node, values: Values) -> Any:
    """A constant's number, or what was computed for the node."""
    return graph.values[node] if graph.ops[node] == "const" else values[node]


def run_scalars(graph: Graph, part: Sequence[Node], values: Values) -> None:
    """One JAX operation per node."""
    for node in part:
        op, dtype = graph.ops[node], graph.dtypes[node]
        arguments = [value(graph, a, values) for a in graph.args[node]]
        if op in ("hold", "saved"):
            values[node] = arguments[0]
        elif op == "select":
            predicate, if_true, if_false = (jnp.asarray(a) for a in arguments)
            values[node] = lax.select_n_p.bind(predicate, if_false, if_true)
        elif op == "convert":
            values[node] = lax.convert_element_type(arguments[0], dtype)
        elif op in ELEMENTWISE:
            values[node] = _FUNCTIONS[op](*arguments)
        else:
            raise NotImplementedError(f"scalar operation '{op}'")


_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "not": lax.bitwise_not, "and": lax.bitwise_and, "or": lax.bitwise_or, "xor": lax.bitwise_xor,
    **{name: getattr(lax, name) for name in ELEMENTWISE if name not in ("not", "and", "or", "xor")},
}  # fmt: skip
