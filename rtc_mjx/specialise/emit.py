"""From the scalar graph back to JAX: one operation per node, or a few kernels that hold hundreds of nodes each (`kernel`).

Programs longer than a kernel may be are cut where few values cross; where the limits come from is in docs/physics.md.
"""

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from rtc_mjx.specialise.graph import Graph, Node
from rtc_mjx.specialise.kernel import Kernel, Values, run_scalars, value

Mode = Literal["kernel", "vector"]
KERNEL_OPERATIONS = 1800  # XLA's emitters split a computation of 2,000 and compute shared parts again and again
KERNEL_SLOTS = 115  # LLVM gives up telling 250 memory locations apart, and with it vectorising
PER_SLOT = 4  # operations of the reduction itself for each value that goes in or out


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
            run_scalars(graph, part, values)
        else:
            needed = [n for n in part if last_use[n] >= first + len(part)]
            _run_kernel(graph, part, needed, values)
    return [value(graph, n, values) for n in outputs]


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


def _run_native(graph: Graph, node: Node, values: Values) -> None:
    native, position, arrays = graph.natives[graph.values[node]], 0, []
    for shape, dtype in native.takes:
        count = int(np.prod(shape))
        parts = [jnp.asarray(value(graph, n, values), dtype) for n in graph.args[node][position : position + count]]
        arrays.append(jnp.stack(parts).reshape(shape) if parts else jnp.zeros(shape, dtype))
        position += count
    values[node] = [jnp.ravel(out) for out in native.function(*arrays)]


def _run_kernel(graph: Graph, part: Sequence[Node], needed: Sequence[Node], values: Values) -> None:
    """Evaluates a run of scalar nodes inside one kernel; the needed ones come out."""
    inside = set(part)
    taken = sorted({a for n in part for a in graph.args[n] if a not in inside and graph.ops[a] != "const"})
    kernel = Kernel(graph, tuple(part), tuple(taken), tuple(needed))
    values.update(zip(needed, kernel(*(values[n] for n in taken)), strict=True))
