"""From a jaxpr to the scalar graph: every array becomes an array of nodes, every equation is unrolled or moved away.

What is not known here (loops, sorting of unknowns, a primitive that a newer JAX adds) is bound natively on packed arrays:
slower, never wrong. Equations whose inputs are all constants are evaluated once, by JAX itself.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend import core

from rtc_mjx.specialise import moves
from rtc_mjx.specialise.graph import ELEMENTWISE, Graph, Native, Node

Nodes = np.ndarray
INLINED = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "checkpoint": "jaxpr",
    "remat2": "jaxpr",
}
SCATTERS = {"scatter": None, "scatter-add": "add", "scatter-mul": "mul", "scatter-min": "min", "scatter-max": "max"}
REDUCTIONS = {"reduce_sum": "add", "reduce_prod": "mul", "reduce_max": "max", "reduce_min": "min", "reduce_and": "and", "reduce_or": "or"}
CUMULATIVES = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}


def trace_into(graph: Graph, jaxpr: core.ClosedJaxpr, inputs: Sequence[Nodes]) -> list[Nodes]:
    """Adds a closed jaxpr to the graph, applied to arrays of nodes; returns the nodes of its outputs."""
    return _Interpreter(graph).run(jaxpr.jaxpr, jaxpr.consts, inputs)


def constants(graph: Graph, value: Any) -> Nodes:
    """A concrete array as constant nodes."""
    value = np.asarray(value)
    nodes = [graph.constant(v, value.dtype) for v in value.flat]
    return np.array(nodes, np.int64).reshape(value.shape)


def _out_of_bounds(dtype: np.dtype) -> Any:
    """What JAX reads outside an array: NaN, the smallest signed or the largest unsigned number, True."""
    if dtype.kind == "b" or np.issubdtype(dtype, np.inexact):
        return True if dtype.kind == "b" else np.nan
    limits = np.iinfo(dtype)
    return limits.min if limits.min < 0 else limits.max


def _applies_function(update: core.Jaxpr | None) -> bool:
    """Whether a scatter combines old and new by more than taking the new (`.at[].apply`)."""
    return update is not None and (bool(update.eqns) or update.outvars[0] is not update.invars[1])


class _Interpreter:
    """Walks equations; methods are named after what they unroll."""

    def __init__(self, graph: Graph):
        self.graph = graph

    def run(self, jaxpr: core.Jaxpr, consts: Sequence[Any], inputs: Sequence[Nodes]) -> list[Nodes]:
        """Evaluates a jaxpr on nodes."""
        held: dict[Any, Nodes] = dict(zip(jaxpr.constvars, (constants(self.graph, c) for c in consts), strict=True))
        held.update(zip(jaxpr.invars, inputs, strict=True))

        def read(atom: Any) -> Nodes:
            if isinstance(atom, core.Literal):
                return constants(self.graph, np.asarray(atom.val, getattr(atom.aval, "dtype", None)))
            return held[atom]

        for equation in jaxpr.eqns:
            results = self.equation(equation, [read(a) for a in equation.invars])
            held.update(zip(equation.outvars, results, strict=True))
        return [read(a) for a in jaxpr.outvars]

    def equation(self, equation: Any, inputs: list[Nodes]) -> list[Nodes]:
        """One equation: inlined, evaluated, moved, unrolled, or bound natively, whichever applies first."""
        name, params = equation.primitive.name, equation.params
        if name in INLINED:
            inner = params[INLINED[name]]
            closed = inner if hasattr(inner, "consts") else core.ClosedJaxpr(inner, ())
            return self.run(closed.jaxpr, closed.consts, inputs)
        result = self.unrolled(equation, inputs)
        if result is None and not equation.effects and all(self.known(x) for x in inputs):
            result = self.evaluated(equation, inputs)
        if result is None:
            result = self.natively(equation, inputs)
        return list(result) if isinstance(result, (list, tuple)) else [result]

    def unrolled(self, equation: Any, inputs: list[Nodes]) -> Nodes | list[Nodes] | None:
        """The results where a rule applies; constants fold as the nodes are made."""
        name, params = equation.primitive.name, equation.params
        rule = getattr(self, "unroll_" + name.replace("-", "_"), None)
        if name in ELEMENTWISE:
            return self.each(lambda *a: self.graph.apply(name, *a), *inputs)
        if name in moves.MOVES and len(equation.outvars) == 1:
            return moves.MOVES[name](*inputs, **params)
        if name in REDUCTIONS:
            return self.reduce(inputs[0], REDUCTIONS[name], params["axes"])
        if name in CUMULATIVES:
            return self.cumulative(inputs[0], CUMULATIVES[name], params["axis"], params["reverse"])
        if name in SCATTERS:
            return self.scatter(SCATTERS[name], inputs, params)
        return None if rule is None else rule(equation, inputs)

    def known(self, nodes: Nodes) -> bool:
        """Whether every element is a constant."""
        return all(self.graph.is_constant(int(n)) for n in nodes.flat)

    def numbers(self, nodes: Nodes) -> np.ndarray:
        """The values of constant nodes."""
        return np.array([self.graph.values[int(n)] for n in nodes.flat]).reshape(nodes.shape)

    def packed(self, nodes: Nodes, aval: Any) -> np.ndarray:
        """The values of constant nodes, in the type of the array they stand for."""
        return self.numbers(nodes).astype(aval.dtype).reshape(aval.shape)

    def each(self, function: Callable[..., Node], *arrays: Nodes) -> Nodes:
        """Applies a scalar rule element by element."""
        arrays = np.broadcast_arrays(*arrays)
        nodes = [function(*(int(n) for n in group)) for group in zip(*(a.flat for a in arrays), strict=True)]
        return np.array(nodes, np.int64).reshape(arrays[0].shape)

    def evaluated(self, equation: Any, inputs: list[Nodes]) -> list[Nodes]:
        """An equation on constants, evaluated by JAX."""
        params = equation.params
        values = [self.packed(x, a.aval) for x, a in zip(inputs, equation.invars, strict=True)]
        with jax.ensure_compile_time_eval():
            out = equation.primitive.bind(*(jax.numpy.asarray(v) for v in values), **equation.primitive.get_bind_params(params))
        out = out if equation.primitive.multiple_results else [out]
        return [constants(self.graph, v) for v in out]

    def natively(self, equation: Any, inputs: list[Nodes]) -> list[Nodes]:
        """Binds the equation as JAX has it."""
        primitive, params = equation.primitive, equation.params

        def function(*arrays: Any) -> Sequence[Any]:
            out = primitive.bind(*arrays, **primitive.get_bind_params(params))  # custom derivatives bind functions, not jaxprs
            return tuple(out) if primitive.multiple_results else (out,)

        takes = tuple((a.aval.shape, np.dtype(a.aval.dtype)) for a in equation.invars)
        gives = tuple((a.aval.shape, np.dtype(a.aval.dtype)) for a in equation.outvars)
        return self.graph.native(Native(function, takes, gives), inputs)

    def fold(self, op: str, nodes: Sequence[Node]) -> Node:
        """Combines nodes left to right with a binary operation."""
        total = nodes[0]
        for node in nodes[1:]:
            total = self.graph.apply(op, total, node)
        return total

    def reduce(self, x: Nodes, op: str, axes: Sequence[int]) -> Nodes | None:
        """A reduction over axes."""
        kept = [d for d in range(x.ndim) if d not in axes]
        rows = np.transpose(x, [*kept, *axes]).reshape([*(x.shape[d] for d in kept), math.prod(x.shape[d] for d in axes)])
        if rows.shape[-1] == 0:
            return None
        out = [self.fold(op, [int(n) for n in rows[i]]) for i in np.ndindex(*rows.shape[:-1])]
        return np.array(out, np.int64).reshape(rows.shape[:-1])

    def cumulative(self, x: Nodes, op: str, axis: int, reverse: bool) -> Nodes:
        """A running reduction along an axis."""
        out = np.moveaxis(np.flip(x, axis) if reverse else x, axis, 0).copy()
        for i in range(1, out.shape[0]):
            out[i] = self.each(lambda a, b: self.graph.apply(op, a, b), out[i - 1], out[i])
        out = np.moveaxis(out, 0, axis)
        return np.flip(out, axis) if reverse else out

    def scatter(self, op: str | None, inputs: list[Nodes], params: dict[str, Any]) -> Nodes | None:
        """A scatter with known indices."""
        x, indices, updates = inputs
        if not self.known(indices) or (op is None and _applies_function(params["update_jaxpr"])):
            return None
        combine = (lambda old, new: new) if op is None else (lambda old, new: self.graph.apply(op, old, new))
        wanted = {k: params[k] for k in ("dimension_numbers", "mode")}
        return moves.scatter(x, self.numbers(indices).astype(np.int64), updates, combine, **wanted)

    def unroll_gather(self, equation: Any, inputs: list[Nodes]) -> Nodes | None:
        x, indices = inputs
        if not self.known(indices):
            return None
        out, params = equation.outvars[0].aval, equation.params
        fill = params["fill_value"]
        if fill is None:
            fill = _out_of_bounds(out.dtype)
        filler = self.graph.constant(fill, out.dtype)
        wanted = {k: params[k] for k in ("dimension_numbers", "slice_sizes", "mode")}
        return moves.gather(x, self.numbers(indices).astype(np.int64), filler, out.shape, **wanted)

    def unroll_dynamic_slice(self, equation: Any, inputs: list[Nodes]) -> Nodes | None:
        x, *starts = inputs
        if not all(self.known(s) for s in starts):
            return None
        sizes = equation.params["slice_sizes"]
        begin = [min(max(int(self.numbers(s)), 0), n - size) for s, n, size in zip(starts, x.shape, sizes, strict=True)]
        return x[tuple(slice(b, b + size) for b, size in zip(begin, sizes, strict=True))]

    def unroll_dynamic_update_slice(self, equation: Any, inputs: list[Nodes]) -> Nodes | None:
        x, update, *starts = inputs
        if not all(self.known(s) for s in starts):
            return None
        begin = [min(max(int(self.numbers(s)), 0), n - size) for s, n, size in zip(starts, x.shape, update.shape, strict=True)]
        out = x.copy()
        out[tuple(slice(b, b + size) for b, size in zip(begin, update.shape, strict=True))] = update
        return out

    def unroll_select_n(self, equation: Any, inputs: list[Nodes]) -> Nodes | None:
        which, *cases = inputs
        if len(cases) != 2 or equation.invars[0].aval.dtype.kind != "b":
            return None
        return self.each(self.graph.select, which, cases[1], cases[0])

    def unroll_split(self, equation: Any, inputs: list[Nodes]) -> list[Nodes]:
        return moves.split(inputs[0], **equation.params)

    def unroll_convert_element_type(self, equation: Any, inputs: list[Nodes]) -> Nodes:
        dtype = equation.params["new_dtype"]
        return self.each(lambda n: self.graph.convert(n, dtype), inputs[0])

    def unroll_square(self, equation: Any, inputs: list[Nodes]) -> Nodes:
        return self.each(lambda n: self.graph.apply("mul", n, n), inputs[0])

    def unroll_integer_pow(self, equation: Any, inputs: list[Nodes]) -> Nodes:
        power = equation.params["y"]

        def raised(node: Node) -> Node:
            product = self.fold("mul", [node] * abs(power)) if power else self.graph.constant(1, self.graph.dtypes[node])
            return product if power >= 0 else self.graph.apply("div", self.graph.constant(1, self.graph.dtypes[node]), product)

        return self.each(raised, inputs[0])

    def unroll_clamp(self, equation: Any, inputs: list[Nodes]) -> Nodes:
        g = self.graph

        def clamped(low: Node, x: Node, high: Node) -> Node:  # selects, since at a bound JAX gives x no derivative
            return g.select(g.apply("gt", x, low), g.select(g.apply("lt", x, high), x, high), g.apply("min", low, high))

        return self.each(clamped, *inputs)

    def unroll_stop_gradient(self, equation: Any, inputs: list[Nodes]) -> Nodes:
        return self.each(self.graph.hold, inputs[0])

    def unroll_name(self, equation: Any, inputs: list[Nodes]) -> Nodes:
        return self.each(self.graph.save, inputs[0])

    def unroll_cond(self, equation: Any, inputs: list[Nodes]) -> list[Nodes] | None:
        if not self.known(inputs[0]):
            return None
        branches = equation.params["branches"]
        branch = branches[min(max(int(self.numbers(inputs[0])), 0), len(branches) - 1)]
        return self.run(branch.jaxpr, branch.consts, inputs[1:])

    def unroll_dot_general(self, equation: Any, inputs: list[Nodes]) -> Nodes:
        (contract_x, contract_y), (batch_x, batch_y) = equation.params["dimension_numbers"]
        x, y = inputs
        dtype = equation.outvars[0].aval.dtype
        free_x = [d for d in range(x.ndim) if d not in (*contract_x, *batch_x)]
        free_y = [d for d in range(y.ndim) if d not in (*contract_y, *batch_y)]
        batch, depth = [x.shape[d] for d in batch_x], math.prod(x.shape[d] for d in contract_x)
        height, width = math.prod(x.shape[d] for d in free_x), math.prod(y.shape[d] for d in free_y)
        rows = np.transpose(x, [*batch_x, *free_x, *contract_x]).reshape([*batch, height, depth])
        columns = np.transpose(y, [*batch_y, *free_y, *contract_y]).reshape([*batch, width, depth])
        rows, columns = (self.each(lambda n: self.graph.convert(n, dtype), part) for part in (rows, columns))
        out = np.empty([*rows.shape[:-1], columns.shape[-2]], np.int64)
        for place in np.ndindex(*out.shape):
            *group, i, j = place
            pairs = zip(rows[(*group, i)], columns[(*group, j)], strict=True)
            out[place] = self.graph.sum([self.graph.apply("mul", int(a), int(b)) for a, b in pairs], dtype)
        return out.reshape([*batch, *(x.shape[d] for d in free_x), *(y.shape[d] for d in free_y)])

    def unroll_cholesky(self, equation: Any, inputs: list[Nodes]) -> Nodes:
        g, x = self.graph, inputs[0]
        out = np.empty_like(x)
        zero = g.constant(0, equation.outvars[0].aval.dtype)
        for group in np.ndindex(*x.shape[:-2]):
            a, lower = x[group], np.full(x.shape[-2:], zero, np.int64)
            for j in range(a.shape[0]):
                for i in range(j, a.shape[0]):
                    taken = g.sum([g.apply("mul", int(lower[i, k]), int(lower[j, k])) for k in range(j)], g.dtypes[zero])
                    rest = g.apply("sub", int(a[i, j]), taken)
                    lower[i, j] = g.apply("sqrt", rest) if i == j else g.apply("div", rest, int(lower[j, j]))
            out[group] = lower
        return out

    def unroll_triangular_solve(self, equation: Any, inputs: list[Nodes]) -> Nodes | None:
        g, p = self.graph, equation.params
        a, b = inputs
        if p["conjugate_a"] or a.shape[:-2] != b.shape[:-2]:
            return None
        if not p["left_side"]:
            a, b = np.swapaxes(a, -1, -2), np.swapaxes(b, -1, -2)
        if p["transpose_a"]:
            a = np.swapaxes(a, -1, -2)
        lower = p["lower"] == (p["transpose_a"] == (not p["left_side"]))
        n, out = a.shape[-1], b.copy()
        order = range(n) if lower else range(n - 1, -1, -1)
        for place in np.ndindex(*b.shape[:-2], b.shape[-1]):
            *group, column = place
            matrix = a[tuple(group)]
            solved: list[int] = []
            for i in order:
                taken = g.sum([g.apply("mul", int(matrix[i, k]), int(out[(*group, k, column)])) for k in solved], g.dtypes[int(b.flat[0])])
                rest = g.apply("sub", int(b[(*group, i, column)]), taken)
                out[(*group, i, column)] = rest if p["unit_diagonal"] else g.apply("div", rest, int(matrix[i, i]))
                solved.append(i)
        return out if p["left_side"] else np.swapaxes(out, -1, -2)
