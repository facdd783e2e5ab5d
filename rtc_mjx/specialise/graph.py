"""The scalar graph: straight-line arithmetic on single numbers, folded as it is built.

A node is an integer. Equal nodes are made once (hash-consing), constants are computed, and identities (0 x, 1 x, x + 0,
select on a known predicate) never become nodes, so a planar world's zeros vanish while it is being traced. Node numbers
rise along every edge: ascending order is an order of evaluation.

Folding assumes finite numbers: 0 x is 0. A world that produces NaN or infinity inside a step is refused before it runs
(`rtc_mjx.physics.check_inputs`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jax import lax

Node = int

ELEMENTWISE: dict[str, tuple[Callable[..., Any], Any]] = {  # name -> (numpy, the lax primitive it stands for)
    "neg": (np.negative, lax.neg_p), "abs": (np.abs, lax.abs_p), "sign": (np.sign, lax.sign_p),
    "floor": (np.floor, lax.floor_p), "ceil": (np.ceil, lax.ceil_p), "not": (np.logical_not, lax.not_p),
    "sin": (np.sin, lax.sin_p), "cos": (np.cos, lax.cos_p), "tan": (np.tan, lax.tan_p), "tanh": (np.tanh, lax.tanh_p),
    "asin": (np.arcsin, lax.asin_p), "acos": (np.arccos, lax.acos_p), "atan": (np.arctan, lax.atan_p),
    "exp": (np.exp, lax.exp_p), "log": (np.log, lax.log_p), "sqrt": (np.sqrt, lax.sqrt_p),
    "rsqrt": (lambda x: 1 / np.sqrt(x), lax.rsqrt_p), "is_finite": (np.isfinite, lax.is_finite_p),
    "add": (np.add, lax.add_p), "sub": (np.subtract, lax.sub_p), "mul": (np.multiply, lax.mul_p),
    "div": (np.divide, lax.div_p), "rem": (np.fmod, lax.rem_p), "max": (np.maximum, lax.max_p),
    "min": (np.minimum, lax.min_p), "pow": (np.power, lax.pow_p), "atan2": (np.arctan2, lax.atan2_p),
    "and": (np.bitwise_and, lax.and_p), "or": (np.bitwise_or, lax.or_p), "xor": (np.bitwise_xor, lax.xor_p),
    "lt": (np.less, lax.lt_p), "le": (np.less_equal, lax.le_p), "gt": (np.greater, lax.gt_p),
    "ge": (np.greater_equal, lax.ge_p), "eq": (np.equal, lax.eq_p), "ne": (np.not_equal, lax.ne_p),
}  # fmt: skip
COMMUTATIVE = {"add", "mul", "max", "min", "and", "or", "xor", "eq", "ne"}
PREDICATES = {"lt", "le", "gt", "ge", "eq", "ne", "is_finite"}


@dataclass(frozen=True)
class Native:
    """An operation kept as JAX has it: a function on arrays, with the types of what it takes and gives."""

    function: Callable[..., Sequence[Any]]
    takes: tuple[tuple[tuple[int, ...], np.dtype], ...]
    gives: tuple[tuple[tuple[int, ...], np.dtype], ...]


@dataclass
class Graph:
    """A growing set of scalar nodes. Lists are indexed by node; `values` holds a constant or an index, else None."""

    ops: list[str] = field(default_factory=list)
    args: list[tuple[Node, ...]] = field(default_factory=list)
    values: list[Any] = field(default_factory=list)
    dtypes: list[np.dtype] = field(default_factory=list)
    natives: list[Native] = field(default_factory=list)
    known: dict[Any, Node] = field(default_factory=dict)

    def add(self, op: str, args: tuple[Node, ...], dtype: Any, value: Any = None, key: Any = None) -> Node:
        """The node of this operation, made now unless an equal one is there."""
        dtype = np.dtype(dtype)
        key = (op, args, dtype.char, value if key is None else key)
        node = self.known.get(key)
        if node is None:
            node = self.known[key] = len(self.ops)
            self.ops.append(op)
            self.args.append(args)
            self.values.append(value)
            self.dtypes.append(dtype)
        return node

    def constant(self, value: Any, dtype: Any) -> Node:
        """The node of a number; told apart by its bits, so that -0.0 is not 0.0."""
        value = np.dtype(dtype).type(value)
        return self.add("const", (), dtype, value, value.tobytes())

    def input(self, index: int, dtype: Any) -> Node:
        """The node of the program's input number `index`."""
        return self.add("input", (), dtype, index)

    def is_constant(self, node: Node) -> bool:
        """Whether a node's value is known."""
        return self.ops[node] == "const"

    def equals(self, node: Node, number: float) -> bool:
        """Whether a node is known to be this number."""
        return self.ops[node] == "const" and bool(self.values[node] == number)

    def apply(self, op: str, *args: Node) -> Node:
        """An elementwise operation on scalars, folded where the operands allow."""
        function = ELEMENTWISE[op][0]
        dtype = np.dtype(bool) if op in PREDICATES else self.dtypes[args[0]]
        if all(self.ops[a] == "const" for a in args):
            with np.errstate(all="ignore"):
                if op == "not" and dtype.kind != "b":
                    return self.constant(np.invert(self.values[args[0]]), dtype)
                return self.constant(function(*(self.values[a] for a in args)), dtype)
        folded = _IDENTITIES[op](self, *args) if op in _IDENTITIES else None
        if folded is not None:
            return folded
        if op in COMMUTATIVE:
            args = tuple(sorted(args))
        return self.add(op, args, dtype)

    def select(self, predicate: Node, if_true: Node, if_false: Node) -> Node:
        """`if_true` where the predicate holds, else `if_false`."""
        if self.is_constant(predicate):
            return if_true if self.values[predicate] else if_false
        if if_true == if_false:
            return if_true
        if self.dtypes[if_true].kind == "b" and self.is_constant(if_true) and self.is_constant(if_false):
            return predicate if self.values[if_true] else self.apply("not", predicate)
        if self.ops[predicate] == "not":
            return self.select(self.args[predicate][0], if_false, if_true)
        return self.add("select", (predicate, if_true, if_false), self.dtypes[if_true])

    def convert(self, node: Node, dtype: Any) -> Node:
        """The node in another type."""
        if self.dtypes[node] == np.dtype(dtype):
            return node
        if self.is_constant(node):
            return self.constant(self.values[node], dtype)
        return self.add("convert", (node,), dtype)

    def hold(self, node: Node) -> Node:
        """The same value, taken as constant by the derivative (stop_gradient)."""
        return node if self.ops[node] in ("const", "hold") else self.add("hold", (node,), self.dtypes[node])

    def save(self, node: Node) -> Node:
        """The same value, kept for the backward pass (checkpoint_name)."""
        return node if self.is_constant(node) else self.add("saved", (node,), self.dtypes[node])

    def sum(self, nodes: Sequence[Node], dtype: Any) -> Node:
        """Sum of nodes, left to right."""
        total = self.constant(0, dtype)
        for node in nodes:
            total = self.apply("add", total, node)
        return total

    def native(self, native: Native, arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Binds an operation natively on packed scalars; returns the nodes of its results, array by array."""
        self.natives.append(native)
        flat = tuple(int(n) for array in arrays for n in array.flat)
        call = self.add("native", flat, np.int32, len(self.natives) - 1)
        results = []
        for number, (shape, dtype) in enumerate(native.gives):
            nodes = [self.add("result", (call,), dtype, (number, i)) for i in range(int(np.prod(shape)))]
            results.append(np.array(nodes, np.int64).reshape(shape))
        return results

    def live(self, outputs: Sequence[Node], known: Sequence[Node] = ()) -> list[Node]:
        """Nodes that the outputs depend on, ascending; nodes in `known` are given and not followed."""
        given, seen, stack = set(known), set(), list(outputs)
        while stack:
            node = stack.pop()
            if node not in seen:
                seen.add(node)
                if node not in given:
                    stack.extend(self.args[node])
        return sorted(seen)


def _add(g: Graph, x: Node, y: Node) -> Node | None:
    if g.equals(x, 0):
        return y
    if g.equals(y, 0):
        return x
    if g.ops[y] == "neg":
        return g.apply("sub", x, g.args[y][0])
    return g.apply("sub", y, g.args[x][0]) if g.ops[x] == "neg" else None


def _sub(g: Graph, x: Node, y: Node) -> Node | None:
    if g.equals(y, 0):
        return x
    if x == y:
        return g.constant(0, g.dtypes[x])
    if g.equals(x, 0):
        return g.apply("neg", y)
    return g.apply("add", x, g.args[y][0]) if g.ops[y] == "neg" else None


def _mul(g: Graph, x: Node, y: Node) -> Node | None:
    for a, b in ((x, y), (y, x)):
        if g.equals(a, 0):
            return a
        if g.equals(a, 1):
            return b
        if g.equals(a, -1):
            return g.apply("neg", b)
    for a, b in ((x, y), (y, x)):
        if g.ops[a] == "neg" and not g.is_constant(b):
            return g.apply("neg", g.apply("mul", g.args[a][0], b))
    return None


def _div(g: Graph, x: Node, y: Node) -> Node | None:
    return x if g.equals(x, 0) or g.equals(y, 1) else None


def _pow(g: Graph, x: Node, y: Node) -> Node | None:
    """Small whole powers as products: a solver's impedance is a square, and pow does not vectorise."""
    if not g.is_constant(y) or g.values[y] not in (0, 1, 2, 3, 4):
        return None
    product = g.constant(1, g.dtypes[x])
    for _ in range(int(g.values[y])):
        product = g.apply("mul", product, x)
    return product


def _neg(g: Graph, x: Node) -> Node | None:
    if g.ops[x] == "sub":
        return g.apply("sub", g.args[x][1], g.args[x][0])
    return g.args[x][0] if g.ops[x] == "neg" else None


def _not(g: Graph, x: Node) -> Node | None:
    return g.args[x][0] if g.ops[x] == "not" else None


def _same(g: Graph, x: Node, y: Node) -> Node | None:
    return x if x == y else None


def _bound(worst: float) -> Callable[[Graph, Node, Node], Node | None]:
    def fold(g: Graph, x: Node, y: Node) -> Node | None:
        if x == y or g.equals(y, worst):
            return x
        return y if g.equals(x, worst) else None

    return fold


def _junction(neutral: bool) -> Callable[[Graph, Node, Node], Node | None]:
    def fold(g: Graph, x: Node, y: Node) -> Node | None:
        if g.dtypes[x].kind != "b":
            return None
        for a, b in ((x, y), (y, x)):
            if g.is_constant(a):
                return b if bool(g.values[a]) == neutral else a
        return x if x == y else None

    return fold


def _reflexive(result: bool) -> Callable[[Graph, Node, Node], Node | None]:
    return lambda g, x, y: g.constant(result, bool) if x == y else None


_IDENTITIES: dict[str, Callable[..., Node | None]] = {
    "add": _add, "sub": _sub, "mul": _mul, "div": _div, "pow": _pow, "neg": _neg, "not": _not,
    "max": _bound(-np.inf), "min": _bound(np.inf), "and": _junction(True), "or": _junction(False),
    "lt": _reflexive(False), "gt": _reflexive(False), "ne": _reflexive(False),
    "le": _reflexive(True), "ge": _reflexive(True), "eq": _reflexive(True),
    "is_finite": lambda g, x: g.constant(True, bool),
}  # fmt: skip
