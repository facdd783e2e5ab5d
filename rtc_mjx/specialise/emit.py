"""From the scalar graph back to JAX: one operation per node, or a few kernels that hold hundreds of nodes each.

On a CPU, XLA runs each scalar operation of a vmapped program as a loop of its own over the batch. A kernel runs them all in one
loop, in registers. JAX has no such construct, but StableHLO's reduce carries a whole scalar computation, and this is a
reduction in the strict sense: over two tagged elements, (0, x) and (1, x), with

    (-1, .) the identity,   (0, x) + (1, x) = (1, x) + (0, x) = (2, f(x)),

so any order and any number of identities that XLA may insert give f(x). What the compiler needs to make one vectorised loop of
it, and where the limits below come from, is in docs/physics.md; longer programs are cut where few values cross.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from rtc_mjx.specialise.graph import ELEMENTWISE, Graph, Node

Mode = Literal["kernel", "vector"]
KERNEL_OPERATIONS = 1800  # XLA's emitters split a computation of 2,000 and compute shared parts again and again
KERNEL_SLOTS = 115  # LLVM gives up telling 250 memory locations apart, and with it vectorising
PER_SLOT = 4  # operations of the reduction itself for each value that goes in or out
IDENTITY, RESULT = -1, 2  # tags, beside 0 and 1 of the two elements
Values = dict[Node, Any]


def default_mode() -> Mode:
    """Kernels on a CPU; elsewhere XLA fuses scalar operations into few kernels by itself."""
    return "kernel" if jax.default_backend() == "cpu" else "vector"


def evaluate(graph: Graph, inputs: dict[Node, Any], outputs: Sequence[Node], mode: Mode) -> list[Any]:
    """Computes output nodes from the values of input nodes (scalars; vmap adds the batch)."""
    order = [n for n in graph.live(outputs, known=list(inputs)) if n not in inputs and graph.ops[n] != "const"]
    values: Values = dict(inputs)
    last_use = _last_use(graph, order, outputs)
    for first, part in _parts(graph, order, last_use):
        op = graph.ops[part[0]]
        if op == "native":
            _run_native(graph, part[0], values)
        elif op == "result":
            values[part[0]] = values[graph.args[part[0]][0]][graph.values[part[0]][0]][graph.values[part[0]][1]]
        elif mode == "vector":
            _run_scalars(graph, part, values)
        else:
            needed = [n for n in part if last_use[n] >= first + len(part)]
            _run_kernel(graph, part, needed, values)
    return [_value(graph, n, values) for n in outputs]


def _parts(graph: Graph, order: Sequence[Node], last_use: dict[Node, int]) -> Iterator[tuple[int, list[Node]]]:
    """Cuts an order of evaluation into kernels, native operations apart; yields (position, nodes)."""
    start = 0
    while start < len(order):
        alone = graph.ops[order[start]] in ("native", "result")
        end = start + 1 if alone else _kernel_end(graph, order, start, last_use)
        yield start, list(order[start:end])
        start = end


def _kernel_end(graph: Graph, order: Sequence[Node], start: int, last_use: dict[Node, int]) -> int:
    """Where to end the kernel that begins at `start`: as late as one kernel allows, near where fewest values cross."""
    inside: set[Node] = set()
    inputs: set[Node] = set()
    leaving: dict[int, int] = {}
    alive, ends = 0, []
    for position in range(start, len(order)):
        node = order[position]
        if graph.ops[node] in ("native", "result"):
            break
        alive += 1 - leaving.pop(position, 0)
        leaving[last_use[node]] = leaving.get(last_use[node], 0) + 1
        inside.add(node)
        inputs.update(a for a in graph.args[node] if a not in inside and graph.ops[a] != "const")
        slots = max(len(inputs), alive)
        if position + 1 - start + PER_SLOT * slots > KERNEL_OPERATIONS:
            break
        ends.append((slots, position + 1))
    small = [(slots, end) for slots, end in ends if slots <= KERNEL_SLOTS] or [min(ends, default=(0, start + 1))]
    late = [(slots, end) for slots, end in small if end - start >= 0.6 * (small[-1][1] - start)]
    return small[-1][1] if small[-1][1] == len(order) else min(late, key=lambda x: (x[0], -x[1]))[1]


def _last_use(graph: Graph, order: Sequence[Node], outputs: Sequence[Node]) -> dict[Node, int]:
    last = dict.fromkeys(order, -1)
    for position, node in enumerate(order):
        for argument in graph.args[node]:
            last[argument] = position
    last.update(dict.fromkeys(outputs, len(order)))
    return last


def _value(graph: Graph, node: Node, values: Values) -> Any:
    return graph.values[node] if graph.ops[node] == "const" else values[node]


def _run_scalars(graph: Graph, part: Sequence[Node], values: Values) -> None:
    """One JAX operation per node."""
    for node in part:
        op, dtype = graph.ops[node], graph.dtypes[node]
        arguments = [_value(graph, a, values) for a in graph.args[node]]
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


def _run_native(graph: Graph, node: Node, values: Values) -> None:
    native, position, arrays = graph.natives[graph.values[node]], 0, []
    for shape, dtype in native.takes:
        count = int(np.prod(shape))
        parts = [jnp.asarray(_value(graph, n, values), dtype) for n in graph.args[node][position : position + count]]
        arrays.append(jnp.stack(parts).reshape(shape) if parts else jnp.zeros(shape, dtype))
        position += count
    values[node] = [jnp.ravel(out) for out in native.function(*arrays)]


def _run_kernel(graph: Graph, part: Sequence[Node], needed: Sequence[Node], values: Values) -> None:
    """Evaluates a run of scalar nodes inside one variadic reduction; the needed ones come out."""
    inside = set(part)
    taken = sorted({a for n in part for a in graph.args[n] if a not in inside and graph.ops[a] != "const"})
    dtypes = sorted({graph.dtypes[n] for n in (*taken, *needed)}, key=str)
    into = {d: [n for n in taken if graph.dtypes[n] == d] for d in dtypes}
    out = {d: [n for n in needed if graph.dtypes[n] == d] for d in dtypes}
    slots = [(d, i) for d in dtypes for i in range(max(len(into[d]), len(out[d])))]
    source = [into[d][i] if i < len(into[d]) else None for d, i in slots]
    target = [out[d][i] if i < len(out[d]) else None for d, i in slots]

    def combine(left: Sequence[Any], right: Sequence[Any]) -> tuple[Any, ...]:
        inner = {n: x for n, x in zip(source, right[1:], strict=True) if n is not None}
        _run_scalars(graph, part, inner)
        both = (left[0] >= 0) & (right[0] >= 0)
        given = [lax.select(right[0] >= 0, b, a) for a, b in zip(left[1:], right[1:], strict=True)]
        made = [g if n is None else lax.select(both, inner[n], g) for n, g in zip(target, given, strict=True)]
        return (lax.select(both, np.int32(RESULT), lax.max(left[0], right[0])), *made)

    given = [np.zeros((), d) if n is None else values[n] for n, (d, _) in zip(source, slots, strict=True)]
    results = _batched(combine)(*given)
    values.update({n: x for n, x in zip(target, results, strict=True) if n is not None})


def _batched(combine: Callable[[Sequence[Any], Sequence[Any]], tuple[Any, ...]]) -> Callable[..., tuple[jax.Array, ...]]:
    """The reduction of the module docstring on scalars; vmap turns it into one reduction over the whole batch.

    A pass that drops unused results of a reduction (StableHLO's target-independent optimisation) walks the body without
    remembering where it has been, which is exponential in shared sub-expressions; it does not start if all are used.
    """

    def reduction(*arrays: Any) -> tuple[jax.Array, ...]:
        shape = jnp.broadcast_shapes(*(jnp.shape(x) for x in arrays))
        tags = lax.broadcasted_iota(np.int32, (2, *shape), 0)  # not an array of constants: see the module docstring
        doubled = [jnp.broadcast_to(x, (2, *shape)) for x in arrays]
        zeros = [np.zeros((), x.dtype) for x in doubled]
        operands = (tags, *doubled)
        results = lax.reduce(operands, (np.int32(IDENTITY), *zeros), combine, (0,))
        return tuple(lax.optimization_barrier(tuple(results))[1:])  # every result used: see the docstring

    batched = jax.custom_batching.custom_vmap(reduction)

    @batched.def_vmap
    def over_batch(size: int, is_batched: Sequence[bool], *arrays: Any) -> tuple[Any, Any]:
        full = [x if b else jnp.broadcast_to(x, (size, *jnp.shape(x))) for x, b in zip(arrays, is_batched, strict=True)]
        results = batched(*full)
        return results, (True,) * len(results)

    return batched
