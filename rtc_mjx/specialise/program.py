"""A traced and folded function as a value: `Program`, and `specialise`, which wraps one as a JAX function."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero

from rtc_mjx.errors import UsageError
from rtc_mjx.specialise import emit, interpret
from rtc_mjx.specialise.derivative import adjoint
from rtc_mjx.specialise.graph import Graph, Node

Shape = tuple[tuple[int, ...], np.dtype]


@dataclass(frozen=True, eq=False)
class Program:
    """Scalar arithmetic from flat inputs to flat outputs.

    Attributes:
        graph: where the nodes live; adjoints are added to it.
        inputs: shape and type of each input array, in order; scalars are numbered through.
        outputs: nodes of each output array.
        types: type of each output array; an empty one has no node to tell it.
    """

    graph: Graph
    inputs: tuple[Shape, ...]
    outputs: tuple[np.ndarray, ...]
    types: tuple[np.dtype, ...]

    @functools.cached_property
    def input_nodes(self) -> list[Node]:
        """One node per input scalar."""
        dtypes = [dtype for shape, dtype in self.inputs for _ in range(int(np.prod(shape)))]
        return [self.graph.input(i, dtype) for i, dtype in enumerate(dtypes)]

    @functools.cached_property
    def output_nodes(self) -> list[Node]:
        """One node per output scalar."""
        return [int(n) for array in self.outputs for n in array.flat]

    @functools.cached_property
    def saved(self) -> list[Node]:
        """Nodes that the forward pass keeps for the backward pass."""
        return [n for n in self.graph.live(self.output_nodes) if self.graph.ops[n] == "saved"]

    @property
    def operations(self) -> int:
        """Number of scalar operations left after folding."""
        return sum(self.graph.ops[n] not in ("const", "input") for n in self.graph.live(self.output_nodes))

    @functools.lru_cache(maxsize=16)  # noqa: B019 programs are few and live as long as the process
    def backward(self, wanted: tuple[bool, ...]) -> "Backward":
        """The adjoint program with respect to the inputs marked as wanted."""
        graph, nodes = self.graph, self.input_nodes
        count = len(nodes)
        floats = [np.issubdtype(graph.dtypes[n], np.inexact) for n in self.output_nodes]
        seeds = [
            graph.input(count + i, graph.dtypes[n]) if f else None for i, (n, f) in enumerate(zip(self.output_nodes, floats, strict=True))
        ]
        ends = np.cumsum([int(np.prod(shape)) for shape, _ in self.inputs])
        groups = np.split(np.array(nodes, np.int64), ends[:-1])
        chosen = [int(n) for group, want in zip(groups, wanted, strict=True) if want for n in group]
        return Backward([s for s in seeds if s is not None], adjoint(graph, self.output_nodes, seeds, chosen))

    def __call__(self, *arrays: Any, mode: emit.Mode | None = None) -> list[jax.Array]:
        """Evaluates the program; differentiable in reverse mode."""
        return list(_call(self, mode or emit.default_mode())(*(jnp.asarray(a, d) for a, (_, d) in zip(arrays, self.inputs, strict=True))))


@dataclass(frozen=True)
class Backward:
    """An adjoint program: cotangent inputs, and the cotangents of the wanted inputs."""

    seeds: list[Node]
    outputs: list[Node]


@dataclass(frozen=True, eq=False)
class Specialised:
    """A program as a function of pytrees.

    Attributes:
        program: the folded arithmetic; `program.operations` says how much is left.
        structure: of the result.
        arguments: structure of the arguments.
        mode: how it is emitted; None for what suits the device.
    """

    program: Program
    structure: Any
    arguments: Any
    mode: emit.Mode | None

    def __call__(self, *inputs: Any) -> Any:
        """Evaluates it; the arguments must have the structure, shapes and types it was specialised for."""
        if jax.tree.structure(inputs) != self.arguments:
            raise UsageError(f"specialised for arguments {self.arguments}, called with {jax.tree.structure(inputs)}")
        for leaf, (shape, _) in zip(jax.tree.leaves(inputs), self.program.inputs, strict=True):
            if np.shape(leaf) != shape:
                raise UsageError(f"specialised for an array of shape {shape}, called with one of shape {np.shape(leaf)}; vmap adds axes")
        return jax.tree.unflatten(self.structure, self.program(*jax.tree.leaves(inputs), mode=self.mode))


def specialise(function: Callable[..., Any], *examples: Any, mode: emit.Mode | None = None) -> Specialised:
    """Returns the same function of one world, folded and scalarised for the shapes and types of the examples.

    Args:
        function: a JAX function of pytrees of arrays for one world; constants it closes over are folded in.
        examples: arguments (arrays or ShapeDtypeStruct) that give structure, shapes and types; values are not used.
        mode: 'kernel', 'vector', or None for what suits the device (`emit`).

    Returns:
        A function of the same arguments with the same values and reverse-mode derivatives, to float rounding; its attribute
        `program` is the `Program`.
    """
    program, structure = trace(function, *examples)
    return Specialised(program, structure, jax.tree.structure(examples), mode)


def compress(function: Callable[..., Any], *examples: Any, mode: emit.Mode | None = None) -> tuple[Specialised, Callable[[jax.Array], Any]]:
    """Specialises a function whose result goes into another specialised function, without losing what is known about it.

    Returns:
        compact: the function, with its result as one vector of the scalars that are neither constant nor equal to another.
        expand: from that vector to the result; traced inside the next function it restores constants and equalities.
    """
    program, structure = trace(function, *examples)
    graph = program.graph
    passed = _fewest(graph, program.output_nodes)
    dtypes = {graph.dtypes[n] for n in passed}
    if len(dtypes) > 1:
        raise UsageError(f"results of one type are needed to pack them, got {sorted(str(d) for d in dtypes)}")

    def expand(vector: jax.Array) -> Any:
        given = dict(zip(passed, _scalars([vector]), strict=True))
        values = emit.evaluate(graph, given, program.output_nodes, "vector")
        return jax.tree.unflatten(structure, _pack(values, program.outputs, program.types))

    dtype = dtypes.pop() if dtypes else jax.dtypes.canonicalize_dtype(float)
    packed = Program(graph, program.inputs, (np.array(passed, np.int64),), (dtype,))
    return Specialised(packed, jax.tree.structure(0), jax.tree.structure(examples), mode), expand


def _fewest(graph: Graph, outputs: Sequence[Node]) -> list[Node]:
    """Few nodes from which the outputs follow: an operand shared by several outputs may stand for them (n + t, n - t, n)."""
    passed = dict.fromkeys(n for n in outputs if not graph.is_constant(n))

    def implied(extra: Sequence[Node]) -> list[Node]:
        have = {*passed, *extra}
        return [n for n in passed if pure(n) and all(a in have or graph.is_constant(a) for a in graph.args[n])]

    def pure(node: Node) -> bool:  # what is held or saved must stay so, and no native operation is repeated
        return bool(graph.args[node]) and graph.ops[node] not in ("hold", "saved", "native", "result")

    types = {graph.dtypes[n] for n in passed}
    for candidate in sorted({a for n in passed for a in graph.args[n]} - set(passed)):
        if graph.is_constant(candidate) or graph.ops[candidate] == "native" or graph.dtypes[candidate] not in types:
            continue
        if len(gone := implied([candidate])) >= 2:
            for node in gone:
                del passed[node]
            passed[candidate] = None
    for node in implied([]):
        del passed[node]
    return list(passed)


def trace(function: Callable[..., Any], *examples: Any) -> tuple[Program, Any]:
    """Traces and folds; returns the program and the structure of the function's result."""
    leaves = [jax.ShapeDtypeStruct(np.shape(x), jax.dtypes.canonicalize_dtype(x.dtype)) for x in jax.tree.leaves(examples)]
    examples = jax.tree.unflatten(jax.tree.structure(examples), leaves)
    jaxpr, shapes = jax.make_jaxpr(function, return_shape=True)(*examples)
    graph, nodes, count = Graph(), [], 0
    for leaf in leaves:
        size = int(np.prod(leaf.shape))
        scalars = [graph.input(count + i, leaf.dtype) for i in range(size)]
        nodes.append(np.array(scalars, np.int64).reshape(leaf.shape))
        count += size
    outputs = interpret.trace_into(graph, jaxpr, nodes)
    types = tuple(np.dtype(x.dtype) for x in jax.tree.leaves(shapes))
    program = Program(graph, tuple((x.shape, np.dtype(x.dtype)) for x in leaves), tuple(outputs), types)
    return program, jax.tree.structure(shapes)


@functools.lru_cache(maxsize=256)
def _call(program: Program, mode: emit.Mode) -> Callable[..., tuple[jax.Array, ...]]:
    """The program on flat arrays, with its own reverse-mode rule: residuals are its inputs and its saved nodes.

    Both directions are jitted inside: JAX goes over a step several times (for scan, checkpoint and its derivative) and finds
    what it has traced, batched and lowered before.
    """

    @functools.partial(jax.jit, static_argnames="keep")
    def run(arrays: Sequence[jax.Array], keep: bool) -> tuple[tuple[jax.Array, ...], list[jax.Array]]:
        given = dict(zip(program.input_nodes, _scalars(arrays), strict=True))
        values = emit.evaluate(program.graph, given, [*program.output_nodes, *(program.saved if keep else ())], mode)
        count = len(program.output_nodes)
        return _pack(values[:count], program.outputs, program.types), values[count:]

    @jax.jit
    def run_back(wanted: "_Wanted", arrays: Sequence[jax.Array], saved: Sequence[jax.Array], seeds: Sequence[jax.Array]) -> list[Any]:
        adjoints = program.backward(wanted.inputs)
        given = dict(zip(program.input_nodes, _scalars(arrays), strict=True))
        given |= dict(zip(program.saved, saved, strict=True)) | dict(zip(adjoints.seeds, _scalars(seeds), strict=True))
        values = iter(emit.evaluate(program.graph, given, adjoints.outputs, mode))
        return [
            _stack([next(values) for _ in range(int(np.prod(shape)))], shape, dtype) if chosen else None
            for chosen, (shape, dtype) in zip(wanted.inputs, program.inputs, strict=True)
        ]

    @jax.custom_vjp
    def call(*arrays: jax.Array) -> tuple[jax.Array, ...]:
        return run(arrays, keep=False)[0]

    def forward(*primals: Any) -> Any:
        arrays = [p.value for p in primals]
        outputs, saved = run(arrays, keep=True)
        return outputs, (_Wanted(tuple(bool(p.perturbed) for p in primals)), arrays, saved)

    def backward(residuals: Any, cotangents: Sequence[Any]) -> tuple[Any, ...]:
        wanted, arrays, saved = residuals
        seeds = [_zeros(c) for c, nodes in zip(cotangents, program.outputs, strict=True) if _is_float(program.graph, nodes)]
        return tuple(run_back(wanted, arrays, saved, seeds))

    call.defvjp(forward, backward, symbolic_zeros=True)
    return call


@jax.tree_util.register_static
@dataclass(frozen=True)
class _Wanted:
    """Which inputs a derivative is wanted for: static, so that the adjoint program leaves the others out."""

    inputs: tuple[bool, ...]


def _is_float(graph: Graph, nodes: np.ndarray) -> bool:
    return nodes.size > 0 and np.issubdtype(graph.dtypes[int(nodes.flat[0])], np.inexact)


def _zeros(cotangent: Any) -> jax.Array:
    if isinstance(cotangent, SymbolicZero):
        return jnp.zeros(cotangent.shape, cotangent.dtype)
    return cotangent


def _scalars(arrays: Sequence[Any]) -> list[Any]:
    """The numbers of arrays, one by one; indexing would take JAX twice as long to trace."""
    flat = [lax.reshape(x, (x.size,)) for x in arrays]
    return [lax.reshape(part, ()) for x in flat if x.size for part in lax.split(x, (1,) * x.size)]


def _stack(scalars: Sequence[Any], shape: tuple[int, ...], dtype: Any) -> jax.Array:
    parts = [lax.reshape(lax.convert_element_type(x, dtype), (1,)) for x in scalars]
    return lax.reshape(lax.concatenate(parts, 0), shape) if parts else jnp.zeros(shape, dtype)


def _pack(values: Sequence[Any], outputs: Sequence[np.ndarray], types: Sequence[np.dtype]) -> tuple[jax.Array, ...]:
    ends = np.cumsum([0, *(a.size for a in outputs)])
    return tuple(_stack(values[a:b], nodes.shape, dtype) for a, b, nodes, dtype in zip(ends[:-1], ends[1:], outputs, types, strict=True))
