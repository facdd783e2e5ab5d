"""Reverse mode on the scalar graph: the adjoint of a program is another program on the same graph.

Only nodes that depend on a wanted input get adjoints. Ties follow JAX (max and min give half to each side; a reduction over
three or more equal values shares pairwise, where JAX gives equal parts). At x = 0 the
square root's slope is taken as 0 where JAX gives infinity: norms then have derivative zero at rest instead of NaN.
"""

from collections.abc import Callable, Sequence

import jax
import numpy as np

from rtc_mjx.specialise.graph import Graph, Native, Node

CONSTANT = {"const", "hold", "sign", "floor", "ceil"}  # what the derivative holds fixed


def adjoint(graph: Graph, outputs: Sequence[Node], seeds: Sequence[Node | None], wanted: Sequence[Node]) -> list[Node]:
    """Adds the vector-Jacobian product to the graph.

    Args:
        graph: where the program lives; it grows.
        outputs: the program's outputs.
        seeds: a cotangent node per output; None where there is none.
        wanted: the inputs to differentiate with respect to.

    Returns:
        A cotangent node per wanted input.
    """
    live = graph.live(outputs)
    moving = _moving(graph, live, set(wanted))
    total: dict[Node, Node] = {}
    results: dict[Node, dict[tuple[int, int], Node]] = {}

    def give(node: Node, share: Node) -> None:
        if node in moving and not graph.equals(share, 0):
            total[node] = graph.apply("add", total[node], share) if node in total else share

    for output, seed in zip(outputs, seeds, strict=True):
        if seed is not None:
            give(output, seed)
    for node in reversed(live):
        op, args = graph.ops[node], graph.args[node]
        if op == "native" and node in results:
            for argument, share in zip(args, _native(graph, node, results[node]), strict=True):
                give(argument, share)
        elif node in total and op == "result":
            results.setdefault(args[0], {})[graph.values[node]] = total[node]
        elif node in total and args:
            _RULES[op](graph, node, args, total[node], give)
    return [total.get(node, graph.constant(0, graph.dtypes[node])) for node in wanted]


def _moving(graph: Graph, live: Sequence[Node], wanted: set[Node]) -> set[Node]:
    moving: set[Node] = set()
    for node in live:
        if node in wanted:
            moving.add(node)
        elif graph.ops[node] in CONSTANT or not any(a in moving for a in graph.args[node]):
            continue
        elif graph.ops[node] == "native" or np.issubdtype(graph.dtypes[node], np.inexact):
            moving.add(node)
    return moving


def _native(graph: Graph, node: Node, results: dict[tuple[int, int], Node]) -> list[Node]:
    """The adjoint of a natively bound operation: JAX's own, bound natively."""
    native = graph.natives[graph.values[node]]
    moving = [i for i, (_, dtype) in enumerate(native.gives) if np.issubdtype(dtype, np.inexact)]
    floats = [i for i, (_, dtype) in enumerate(native.takes) if np.issubdtype(dtype, np.inexact)]

    def backward(*arrays: jax.Array) -> Sequence[jax.Array]:
        inputs, seeds = list(arrays[: len(native.takes)]), arrays[len(native.takes) :]

        def forward(*parts: jax.Array) -> list[jax.Array]:
            whole = dict(zip(floats, parts, strict=True))
            out = native.function(*(whole.get(i, x) for i, x in enumerate(inputs)))
            return [out[i] for i in moving]

        return jax.vjp(forward, *(inputs[i] for i in floats))[1](list(seeds))

    takes = (*native.takes, *(native.gives[i] for i in moving))
    inputs = _arrays(graph.args[node], [shape for shape, _ in native.takes])
    for i in moving:
        shape, dtype = native.gives[i]
        zero = graph.constant(0, dtype)
        seeds = [results.get((i, k), zero) for k in range(int(np.prod(shape)))]
        inputs.append(np.array(seeds, np.int64).reshape(shape))
    given = graph.native(Native(backward, takes, tuple(native.takes[i] for i in floats)), inputs)
    whole = dict(zip(floats, given, strict=True))
    zeros = [np.full(shape, graph.constant(0, np.float32), np.int64) for shape, _ in native.takes]
    return [int(n) for i in range(len(native.takes)) for n in np.ravel(whole.get(i, zeros[i]))]


def _arrays(nodes: Sequence[Node], shapes: Sequence[tuple[int, ...]]) -> list[np.ndarray]:
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    return [part.reshape(shape) for part, shape in zip(np.split(np.array(nodes, np.int64), ends[:-1]), shapes, strict=True)]


Give = Callable[[Node, Node], None]
Rule = Callable[[Graph, Node, tuple[Node, ...], Node, Give], None]


def _linear_add(g: Graph, node: Node, args: tuple[Node, ...], seed: Node, give: Give) -> None:
    give(args[0], seed)
    give(args[1], seed)


def _linear_sub(g: Graph, node: Node, args: tuple[Node, ...], seed: Node, give: Give) -> None:
    give(args[0], seed)
    give(args[1], g.apply("neg", seed))


def _mul(g: Graph, node: Node, args: tuple[Node, ...], seed: Node, give: Give) -> None:
    give(args[0], g.apply("mul", seed, args[1]))
    give(args[1], g.apply("mul", seed, args[0]))


def _div(g: Graph, node: Node, args: tuple[Node, ...], seed: Node, give: Give) -> None:
    share = g.apply("div", seed, args[1])
    give(args[0], share)
    give(args[1], g.apply("neg", g.apply("mul", share, node)))


def _rem(g: Graph, node: Node, args: tuple[Node, ...], seed: Node, give: Give) -> None:
    give(args[0], seed)
    whole = g.apply("div", g.apply("sub", args[0], node), args[1])
    give(args[1], g.apply("neg", g.apply("mul", seed, whole)))


def _extremum(g: Graph, node: Node, args: tuple[Node, ...], seed: Node, give: Give) -> None:
    zero, half = g.constant(0, g.dtypes[seed]), g.apply("mul", seed, g.constant(0.5, g.dtypes[seed]))
    wins = "gt" if g.ops[node] == "max" else "lt"
    tie = g.apply("eq", *args)
    for this, other in (args, args[::-1]):
        give(this, g.select(g.apply(wins, this, other), seed, g.select(tie, half, zero)))


def _pow(g: Graph, node: Node, args: tuple[Node, ...], seed: Node, give: Give) -> None:
    base, power = args
    one, zero = g.constant(1, g.dtypes[base]), g.constant(0, g.dtypes[base])
    less = g.apply("sub", power, g.constant(1, g.dtypes[power]))  # the power may be an integer
    slope = g.apply("mul", g.convert(power, g.dtypes[base]), g.apply("pow", base, less))
    give(base, g.apply("mul", seed, g.select(g.apply("eq", power, g.constant(0, g.dtypes[power])), zero, slope)))
    positive = g.select(g.apply("gt", base, zero), base, one)
    give(power, g.apply("mul", seed, g.apply("mul", node, g.apply("log", positive))))


def _atan2(g: Graph, node: Node, args: tuple[Node, ...], seed: Node, give: Give) -> None:
    y, x = args
    square = g.apply("add", g.apply("mul", x, x), g.apply("mul", y, y))
    zero, one = g.constant(0, g.dtypes[x]), g.constant(1, g.dtypes[x])
    share = g.apply("div", seed, g.select(g.apply("gt", square, zero), square, one))
    give(y, g.apply("mul", share, x))
    give(x, g.apply("neg", g.apply("mul", share, y)))


def _select(g: Graph, node: Node, args: tuple[Node, ...], seed: Node, give: Give) -> None:
    predicate, if_true, if_false = args
    zero = g.constant(0, g.dtypes[seed])
    give(if_true, g.select(predicate, seed, zero))
    give(if_false, g.select(predicate, zero, seed))


def _convert(g: Graph, node: Node, args: tuple[Node, ...], seed: Node, give: Give) -> None:
    give(args[0], g.convert(seed, g.dtypes[args[0]]))


def _unary(slope: Callable[[Graph, Node, Node], Node]) -> Rule:
    """A rule from d node / d x as a function of (graph, x, node)."""

    def rule(g: Graph, node: Node, args: tuple[Node, ...], seed: Node, give: Give) -> None:
        give(args[0], g.apply("mul", seed, slope(g, args[0], node)))

    return rule


def _inverse_of(slope: Callable[[Graph, Node, Node], Node]) -> Rule:
    """A rule from 1 / (d node / d x)."""

    def rule(g: Graph, node: Node, args: tuple[Node, ...], seed: Node, give: Give) -> None:
        give(args[0], g.apply("div", seed, slope(g, args[0], node)))

    return rule


def _magnitude(g: Graph, node: Node, args: tuple[Node, ...], seed: Node, give: Give) -> None:
    give(args[0], g.select(g.apply("ge", args[0], g.constant(0, g.dtypes[node])), seed, g.apply("neg", seed)))  # at 0 as JAX has it


def _root(g: Graph, node: Node, args: tuple[Node, ...], seed: Node, give: Give) -> None:
    zero, half = g.constant(0, g.dtypes[node]), g.constant(0.5, g.dtypes[node])
    positive = g.apply("gt", node, zero)
    slope = g.apply("div", half, g.select(positive, node, g.constant(1, g.dtypes[node])))
    give(args[0], g.apply("mul", seed, g.select(positive, slope, zero)))


def _one_minus_square(g: Graph, x: Node, op: str = "sub") -> Node:
    return g.apply(op, g.constant(1, g.dtypes[x]), g.apply("mul", x, x))


_RULES: dict[str, Rule] = {
    "add": _linear_add, "sub": _linear_sub, "mul": _mul, "div": _div, "rem": _rem, "max": _extremum, "min": _extremum,
    "pow": _pow, "atan2": _atan2, "select": _select, "convert": _convert, "sqrt": _root,
    "saved": lambda g, node, args, seed, give: give(args[0], seed),
    "neg": lambda g, node, args, seed, give: give(args[0], g.apply("neg", seed)),
    "abs": _magnitude,
    "sin": _unary(lambda g, x, y: g.apply("cos", x)),
    "cos": _unary(lambda g, x, y: g.apply("neg", g.apply("sin", x))),
    "tan": _unary(lambda g, x, y: _one_minus_square(g, y, "add")),
    "tanh": _unary(lambda g, x, y: _one_minus_square(g, y)),
    "exp": _unary(lambda g, x, y: y),
    "log": _inverse_of(lambda g, x, y: x),
    "rsqrt": _unary(lambda g, x, y: g.apply("mul", g.constant(-0.5, g.dtypes[x]), g.apply("div", y, x))),
    "asin": _inverse_of(lambda g, x, y: g.apply("sqrt", _one_minus_square(g, x))),
    "acos": _inverse_of(lambda g, x, y: g.apply("neg", g.apply("sqrt", _one_minus_square(g, x)))),
    "atan": _inverse_of(lambda g, x, y: _one_minus_square(g, x, "add")),
}  # fmt: skip
