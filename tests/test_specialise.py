"""A specialised function equals what it was made from, in value and in reverse mode, and less is left to compute."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jax.scipy.linalg import cho_factor, cho_solve, solve_triangular

from rtc_mjx.errors import UsageError
from rtc_mjx.specialise import compress, emit, kernel, specialise

QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}  # compiling is most of this file's time
TOLERANCE = {"float32": 3e-4, "float64": 1e-10}
COMBINATIONS = [("kernel", "float64"), ("vector", "float32"), ("kernel", "float32"), ("vector", "float64")]
DIAGONAL = pytest.mark.parametrize(("mode", "dtype"), COMBINATIONS[:2], indirect=["dtype"])  # each mode and each type, to save time
OTHER_DIAGONAL = pytest.mark.parametrize(("mode", "dtype"), COMBINATIONS[2:], indirect=["dtype"])


def in_turn(table):
    """Cases take modes and types in turn: what moves or unrolls them is the same for all four, and compiling is slow."""
    cases = [(name, *COMBINATIONS[i % len(COMBINATIONS)]) for i, name in enumerate(table)]
    return pytest.mark.parametrize(("name", "mode", "dtype"), cases, indirect=["dtype"])


@pytest.fixture(params=TOLERANCE)
def dtype(request):
    with jax.enable_x64(request.param == "float64"):
        yield request.param


def draw(dtype, *shape, low=-2.0):
    return jnp.asarray(np.random.default_rng(0).uniform(low, 2.0, shape), dtype)


def leaves(result):
    return [jnp.asarray(x) for x in jax.tree.leaves(result)]


def with_gradient(function, *, wanted=(0, 1)):
    """The function's leaves, and the gradient of a random weighted sum of them."""

    def loss(*inputs):
        out, random = leaves(function(*inputs)), np.random.default_rng(1)
        weights = [jnp.asarray(random.standard_normal(o.shape), o.dtype) for o in out if jnp.issubdtype(o.dtype, jnp.inexact)]
        floats = [o for o in out if jnp.issubdtype(o.dtype, jnp.inexact)]
        return sum(jnp.sum(w * o) for w, o in zip(weights, floats, strict=True)), out

    def run(*inputs):
        (_, out), gradient = jax.value_and_grad(loss, wanted, has_aux=True)(*inputs)
        return out, leaves(gradient)

    return run


def assert_same(ours, theirs, tolerance):
    ours, theirs = leaves(ours), leaves(theirs)
    assert [(o.shape, o.dtype) for o in ours] == [(t.shape, t.dtype) for t in theirs]
    for index, (o, t) in enumerate(zip(ours, theirs, strict=True)):
        o, t = np.asarray(o, np.float64), np.asarray(t, np.float64)
        scale = 1 + np.max(np.abs(np.nan_to_num(t)), initial=0)
        assert np.allclose(o, t, rtol=0, atol=tolerance * scale, equal_nan=True), f"leaf {index}: {o} is not {t}"


def assert_equal(ours, theirs, *inputs):
    """Compares the results of two functions, compiled as one."""
    both = jax.jit(lambda *inputs: (ours(*inputs), theirs(*inputs)), compiler_options=QUICK)
    assert_same(*both(*inputs), TOLERANCE[str(inputs[0].dtype)])


def assert_specialised_equals(function, x, y, mode, *, gradient=True):
    """Values and gradients of a batch."""
    functions = [jax.vmap(f) for f in (specialise(function, x[0], y[0], mode=mode), function)]
    assert_equal(*(with_gradient(f) if gradient else f for f in functions), x, y)


def whole(x):
    return jnp.round(3 * x).astype(int)


SCALAR = {  # of two short vectors
    "trigonometry": lambda x, y: [jnp.sin(x), jnp.cos(y), jnp.tan(x), jnp.tanh(y), jnp.arctan(x), jnp.arcsin(x / 3), jnp.arccos(y / 3)],
    "atan2": lambda x, y: [jnp.arctan2(y, x), jnp.arctan2(x, 1), jnp.arctan2(2, y)],
    "roots and logarithms": lambda x, y: [jnp.exp(x), jnp.log(x * x + 1), jnp.sqrt(y * y + 1), lax.rsqrt(x * x + 0.1)],
    "steps": lambda x, y: [jnp.abs(x), jnp.sign(x) * y, jnp.floor(x) + y, jnp.ceil(y) * x, -x, jnp.round(y)],
    "powers": lambda x, y: [(x * x + 0.1) ** y, x**3, x**-2, x**0, x**7, (y * y) ** 0.3, 2.0**y, jnp.square(x)],
    "whole powers": lambda x, y: [jnp.power(x, jnp.array([2, 5])), jnp.power(x, whole(y)), jnp.power(2.5, whole(y))],
    "division": lambda x, y: [x / y, 1 / y, x / 3, 0 / y, (x * y) / y],
    "remainder": lambda x, y: [lax.rem(x, y), x % y, x // y, x % 0.7, jnp.fmod(3.5, y)],
    "bounds": lambda x, y: [jnp.maximum(x, y), jnp.minimum(x, 0.3), jnp.clip(x, -1, 0.5), jnp.clip(y, x, x + 1)],
    "clamp": lambda x, y: lax.clamp(0 * y - 1, x, y * y),
    "choice": lambda x, y: [jnp.where(x > y, x, 2 * y), jnp.where(((x > 0) & (y <= 0)) | ~(x >= y), x, 0), jnp.where(x != x, 0, y)],
    "comparison": lambda x, y: [x * y, x > y, x <= 0, (x < 0) ^ (y < 0), x == y, jnp.isfinite(x), (x > 0) * y, (x > 0) & True],
    "integers": lambda x, y: [x, whole(x) // 2, whole(x) % 3, -whole(y), ~whole(x), whole(x) & 3, whole(x) * y],
    "known integers": lambda x, y: [jnp.array([7, -7]) // 2 * y, lax.div(jnp.array([7, -7]), jnp.array([-2, 2])) * x],
    "not in the graph": lambda x, y: [jnp.log1p(x * x) * y, jax.nn.sigmoid(x), jnp.cbrt(y) * 2, jnp.logaddexp(2 * x, y)],
}  # fmt: skip


@pytest.mark.parametrize("name", SCALAR)
@DIAGONAL
def test_specialised_arithmetic_equals_plain(name, mode, dtype):
    assert_specialised_equals(SCALAR[name], *draw(dtype, 2, 9, 2), mode)


ROWS = np.array([2, 0, -2], np.int32)
PAST = np.array([0, 9, -9], np.int32)
COLUMNS = np.array([2, 0, 7], np.int32)
SORTED = np.array([[1, 0, 0], [2, 1, 2], [2, 2, 0]], np.int32)

MOVED = {  # of two 3 x 3 matrices
    "shapes": lambda x, y: [x.reshape(9), x.T, x[None], jnp.broadcast_to(x, (2, 3, 3)), jnp.squeeze(x[:, :1])],
    "nothing": lambda x, y: [x, x[:0], jnp.sum(x[:0], 1), x[:0] @ y, jnp.sum(x[:0]), whole(x)[:0]],
    "pads": lambda x, y: [jnp.pad(x, ((0, 1), (2, 0)), constant_values=3), lax.pad(x, y[0, 0], [(-1, 2, 1), (1, -2, 2)])],
    "crops": lambda x, y: [lax.pad(x, y[0, 0], [(-2, 3, 0), (4, -5, 0)]), jnp.pad(x, 1, mode="edge")],
    "joins": lambda x, y: [jnp.concatenate([x, y], 1), jnp.stack([x, y], 1), jnp.tile(x, (2, 1)), jnp.repeat(x, 2, 0), jnp.roll(x, 1, 1)],
    "slices": lambda x, y: [jnp.flip(x, 1), x[::2, 1::2], x[::-1], jnp.split(x, [1], 1), jnp.split(y, 3), jnp.triu(x), jnp.diag(y)],
    "windows": lambda x, y: [lax.dynamic_slice(x, (1, -2), (2, 2)), lax.dynamic_slice(x, (5, 5), (2, 2)), lax.dynamic_index_in_dim(y, 1)],
    "updates": lambda x, y: [lax.dynamic_update_slice(x, y[:2, :2], (1, 2)), x.at[1:, ::2].set(y[1:, ::2]), x.at[1].add(y[0])],
    "rows": lambda x, y: [x[ROWS], x[:, ROWS], x[1], x[:, -1], x[ROWS, ROWS], x[ROWS[:, None], ROWS], x.at[ROWS].get()],
    "clipped": lambda x, y: [jnp.take(x, PAST, 0, mode="clip"), jnp.take(y, PAST, 1, mode="clip"), x.at[PAST, 1].get(mode="clip")],
    "filled": lambda x, y: [jnp.take(x, PAST, 1, mode="fill", fill_value=5), x.at[PAST].get(mode="fill"), (x > y).at[7].get(mode="fill")],
    "filled integers": lambda x, y: [x, *(jnp.take(whole(x).astype(kind), PAST, 0, mode="fill") for kind in ("int32", "uint8"))],
    "along axes": lambda x, y: [jnp.take_along_axis(x, SORTED, 1), jnp.take_along_axis(y, SORTED[:1], 0)],
    "batched gathers": lambda x, y: [jax.vmap(lambda r, i: r[i])(x, ROWS % 3), jax.vmap(lambda r: r[ROWS])(x)],
    "gathers by batches": lambda x, y: [jax.vmap(lambda i: y[i])(ROWS), jax.vmap(lambda i: x[:, i])(ROWS)],
    "batched windows": lambda x, y: jax.vmap(lambda r, i: lax.dynamic_slice(r, (i,), (2,)))(x, COLUMNS),
    "scatters": lambda x, y: [x.at[ROWS[:2]].set(y[:2]), x.at[:, ROWS].add(y), x.at[0].subtract(2 * y[1])],
    "products": lambda x, y: [x.at[0].multiply(y[0], unique_indices=True), x.at[1].divide(2.0)],
    "doubled scatters": lambda x, y: [x.at[np.array([0, 0, 5])].add(y), x.at[ROWS, ROWS].add(1.5), x.at[7].set(3.0), x.at[PAST].set(y)],
    "batched sets": lambda x, y: jax.vmap(lambda r, i, v: r.at[i].set(v))(x, COLUMNS, y[:, 0]),
    "batched sums": lambda x, y: jax.vmap(lambda r, v: r.at[PAST].add(v))(x, y),
    "running": lambda x, y: [jnp.cumsum(x, 0), jnp.cumprod(y, 1), lax.cumsum(x, 1, reverse=True), lax.cumprod(x, 0, reverse=True)],
    "running bounds": lambda x, y: [lax.cummax(x, 0), lax.cummin(y, 1, reverse=True), lax.cummax(x * y, 1, reverse=True)],
    "barriers": lambda x, y: [lax.optimization_barrier((2 * x, y))[0] * y, lax.optimization_barrier(x), jax.checkpoint(jnp.sin)(x) * y],
}  # fmt: skip


@in_turn(MOVED)
def test_specialised_moves_equal_plain(name, mode, dtype):
    assert_specialised_equals(MOVED[name], *draw(dtype, 2, 2, 3, 3), mode)


@pytest.mark.parametrize(
    "function",
    [
        lambda x, y: [x.at[ROWS].min(y), x.at[PAST].max(y), x[PAST]],  # the last breaks its promise to be in bounds: JAX clamps
        lambda x, y: x.at[ROWS].apply(jnp.sin),  # a scatter that applies a function to what was there
        lambda x, y: lax.while_loop(lambda c: jnp.sum(c) < 50, lambda c: 2 * c + y * y, x * x + 1) * y,
    ],
)
@DIAGONAL
def test_what_jax_does_not_differentiate_has_equal_values(function, mode, dtype):
    assert_specialised_equals(function, *draw(dtype, 2, 2, 3, 3), mode, gradient=False)


def positive(x):
    return x @ x.T + 3 * jnp.eye(3, dtype=x.dtype)


def triangular(left, lower, transposed):
    sides = {"left_side": left, "lower": lower, "transpose_a": transposed}
    return lambda x, y: lax.linalg.triangular_solve(positive(x), y[:, :1] if left else y[:1], **sides)


SIDES = [(left, lower, transposed) for left in (True, False) for lower in (True, False) for transposed in (True, False)]
LINEAR = {
    "products": lambda x, y: [x @ y.T, x[0] @ y[0], x @ y[1], jnp.outer(x[0], y[1]), jnp.tensordot(x, y, 2), x[0] @ jnp.arange(3)],
    "batched products": lambda x, y: [jnp.einsum("ij,ij->i", x, y), jnp.einsum("bij,kbj->kib", jnp.stack([x, y]), jnp.stack([y, x], 1))],
    "transposed products": lambda x, y: [jnp.einsum("ij,ik->kj", x, y), jnp.matmul(x[:, None], y), x.T @ y[0], jnp.cross(x, y)],
    "cholesky": lambda x, y: [jnp.linalg.cholesky(positive(x)), jnp.linalg.cholesky(positive(y), upper=True)],
    "cholesky solve": lambda x, y: [cho_solve(cho_factor(positive(x), lower=True), y[:, 0]), cho_solve(cho_factor(positive(y)), x[:, :1])],
    "batched cholesky": lambda x, y: jax.vmap(lambda a, b: cho_solve(cho_factor(positive(a)), b[0]))(jnp.stack([x, y]), jnp.stack([y, x])),
    "unit diagonal": lambda x, y: [solve_triangular(x, y[0], unit_diagonal=True), solve_triangular(positive(x), y[:, 0], trans=1)],
    **{f"triangular {left} {lower} {t}": triangular(left, lower, t) for left, lower, t in SIDES},
    "sums": lambda x, y: [jnp.sum(x), jnp.sum(x, 0), jnp.mean(x, (0, 1)), jnp.var(y, 1), jnp.linalg.norm(x), jnp.sum(x, where=y > 0)],
    "reductions": lambda x, y: [jnp.prod(x, 1), jnp.max(x), jnp.min(y, 0), jnp.any(x > 1, 0), jnp.all(x > -1, 1), jnp.argmax(x, 1)],
    "several axes": lambda x, y: [jnp.sum(jnp.stack([x, y]), (0, 2)), jnp.max(jnp.stack([x, y]), (0, 1)), jnp.sum(jnp.stack([x, y]), ())],
}  # fmt: skip


@in_turn(LINEAR)
def test_specialised_linear_algebra_equals_plain(name, mode, dtype):
    assert_specialised_equals(LINEAR[name], *draw(dtype, 2, 2, 3, 3), mode)


@jax.custom_vjp
def tripled(x):
    return x * x


tripled.defvjp(lambda x: (x * x, x), lambda x, g: (3 * g * x,))

UNKNOWN = {  # arithmetic before and after what stays as JAX has it
    "scan": lambda x, y: lax.scan(lambda c, v: (jnp.sin(c) + v, c * v), 2 * x[0], y)[1] * x,
    "loop": lambda x, y: lax.fori_loop(0, 4, lambda i, c: 0.5 * c + x[i % 3] * y[0], y[1] * 3) * y,
    "sort": lambda x, y: [jnp.sort(2 * x, 1) * y, jnp.argsort(x * y)],
    "eigenvalues": lambda x, y: jnp.linalg.eigh(positive(x))[0] * y[0],
    "solve": lambda x, y: jnp.linalg.solve(positive(x), y[0]) * y,
    "condition": lambda x, y: lax.cond(x[0, 0] > 0, lambda a: a * y, lambda a: jnp.sin(a) + y, 2 * x) * y,
    "branches": lambda x, y: lax.switch(jnp.abs(whole(x))[0, 0] % 3, [lambda a: a, jnp.sin, lambda a: a * a], y) * x,
    "gather": lambda x, y: [(2 * x)[whole(y[0]) % 3] * y, lax.dynamic_slice(x, (jnp.argmax(y[0]), 0), (2, 2)) * y[:2, :2]],
    "scatter": lambda x, y: [x.at[jnp.argmax(y[0])].set(3.0) * y, x.at[jnp.argmin(y[0])].add(y[0])],
    "custom": lambda x, y: [tripled(x) * y, jax.nn.relu(2 * x)],
    "specialised": lambda x, y: specialise(lambda a: jnp.sin(a) * a, x)(2 * x) * y,
    "known": lambda x, y: [lax.cond(jnp.asarray(2) > 1, jnp.sin, jnp.cos, x), lax.while_loop(lambda c: c < 9, lambda c: 2 * c + 1, 1) * y],
}


@in_turn(UNKNOWN)
def test_what_is_not_unrolled_is_bound_natively_and_equals_plain(name, mode, dtype):
    assert_specialised_equals(UNKNOWN[name], *draw(dtype, 2, 2, 3, 3), mode)


TIES = {
    "maximum": jnp.maximum,
    "minimum": jnp.minimum,
    "abs": lambda x, y: jnp.abs(x) + y,
    "clip": lambda x, y: jnp.clip(x, -1, 1) * y,
    "clamp": lambda x, y: lax.clamp(jnp.full_like(x, -1), x, jnp.full_like(x, 1)) * y,
    "choice": lambda x, y: jnp.where(x > y, x, 2 * y),
    "largest of two": lambda x, y: jnp.max(jnp.stack([x, y]), 0),
    "product with zeros": lambda x, y: jnp.prod(x) + jnp.cumprod(y),
    "power of zero": lambda x, y: x**2.0 + jnp.power(y, jnp.array([0, 1, 2, 3, 5, 6])),
}


@in_turn(TIES)
def test_gradients_at_ties_and_kinks_equal_plain(name, mode, dtype):
    x, y = jnp.asarray([0, 1, -1, 1, 2, 0], dtype), jnp.asarray([0, 1, -1, 2, 1, -3], dtype)
    assert_specialised_equals(TIES[name], x[None], y[None], mode)


@DIAGONAL
@pytest.mark.parametrize("function", [jnp.linalg.norm, lambda x: jnp.sum(jnp.sqrt(x)), lambda x: jnp.sqrt(jnp.sum(x * x))])
def test_the_root_of_zero_has_gradient_zero(function, mode, dtype):
    gradient = jax.grad(specialise(function, jnp.zeros(3, dtype), mode=mode))(jnp.zeros(3, dtype))
    assert np.array_equal(gradient, np.zeros(3))


def composed(state, push):
    """A little of everything, as a step is: dictionaries, whole numbers, matrices, moves, choices and something native."""
    x, count = state["x"], state["count"]
    force = jnp.where(push > 0, push, 0.1 * push)[::-1] - 0.3 * jnp.sort(x)
    return {"x": jnp.tanh(jnp.outer(x, x) @ force) + 0.5 * x, "count": count + 1}


def over_time(f):
    def run(state, pushes):
        after, path = lax.scan(lambda s, p: (f(s, p), s["x"]), state, pushes)
        return after["x"], after["count"], path

    return run


TRANSFORMS = {  # (batch shape of state, of push, what is made of the step)
    "alone": ((), (), lambda f: f),
    "jit": ((), (), jax.jit),
    "vmap": ((3,), (3,), jax.vmap),
    "vmap of one": ((3,), (), lambda f: jax.vmap(f, (0, None))),
    "nested vmap": ((2, 3), (2,), lambda f: jax.vmap(jax.vmap(f, (0, None)))),
    "scan": ((), (4,), over_time),
    "vmap of scan": ((3,), (3, 4), lambda f: jax.vmap(over_time(f))),
    "checkpoint": ((), (), jax.checkpoint),
}


@pytest.mark.parametrize("name", TRANSFORMS)
@OTHER_DIAGONAL
def test_transforms_of_specialised_equal_transforms_of_plain(name, mode, dtype):
    states, pushes, transform = TRANSFORMS[name]
    ours = specialise(composed, {"x": jnp.zeros(2, dtype), "count": 0 * jnp.arange(1)}, jnp.zeros(2, dtype), mode=mode)
    x, push = draw(dtype, *states, 2), draw(dtype, *pushes, 2, low=-1.0)

    def run(f):
        return with_gradient(lambda x, push: transform(f)({"x": x, "count": jnp.zeros((*states, 1), int)}, push))

    if name == "alone":  # ours operation by operation
        assert_same(run(ours)(x, push), jax.jit(run(composed), compiler_options=QUICK)(x, push), TOLERANCE[dtype])
    else:
        assert_equal(run(ours), run(composed), x, push)


@pytest.mark.parametrize("wanted", [0, 1, (0, 1)])
@DIAGONAL
def test_gradients_of_some_arguments_equal_plain(wanted, mode, dtype):
    def function(x, y):
        return jnp.sin(x) @ jnp.outer(y, x), x, y[0]

    x, y = draw(dtype, 2, 3)
    assert_equal(with_gradient(specialise(function, x, y, mode=mode), wanted=wanted), with_gradient(function, wanted=wanted), x, y)


@pytest.mark.parametrize(
    ("function", "operations"),
    [
        (lambda x: jnp.full(3, 2.0) * jnp.sin(1.0), 0),
        (lambda x: [x - x, 0 * x, jnp.zeros((2, 3)) @ x, x**0, x >= x], 0),
        (lambda x: [x[::-1], x.at[1].set(3.0), jnp.pad(x, 2), 1 * x + 0, 0 - (0 - x), jnp.where(x == x, x, 7)], 0),
        (lambda x: jnp.zeros((3, 3)).at[0, 1].set(5.0) @ jnp.cos(x), 2),  # the cosine of one entry, times 5
        (lambda x: [jnp.sin(x) * x, x * jnp.sin(x), jnp.sin(1 * x)], 6),
        (lambda x: [jnp.exp(x)[0] + x[1], x[1] + jnp.exp(x[0])], 2),
        (lambda x: lax.cond(jnp.asarray(1) > 0, jnp.sin, jnp.cos, x), 3),
    ],
)
def test_what_is_known_or_equal_is_folded(function, operations):
    assert specialise(function, jnp.ones(3)).program.operations == operations


@DIAGONAL
def test_stopped_gradients_are_exactly_zero(mode, dtype):
    x, y = draw(dtype, 2, 3)
    f = specialise(lambda x, y: lax.stop_gradient(jnp.sin(x)) * y + lax.stop_gradient(checkpoint_name(x, "x")), x, y, mode=mode)
    gradient = jax.grad(lambda *inputs: jnp.sum(f(*inputs)), (0, 1))(x, y)
    assert np.array_equal(gradient[0], np.zeros(3))
    assert_same(gradient[1], jnp.sin(x), TOLERANCE[dtype])


@DIAGONAL
def test_named_values_are_differentiated_like_plain(mode, dtype):
    def function(x, y):
        return [checkpoint_name(jnp.sin(x), "a") * y, jnp.exp(checkpoint_name(x * y, "b"))]

    assert_specialised_equals(function, *draw(dtype, 2, 2, 3), mode)


@pytest.mark.parametrize("named", [True, False])
def test_named_values_are_kept_and_not_computed_again_backwards(named):
    def function(x):
        solution = lax.stop_gradient(lax.while_loop(lambda c: jnp.sum(c) < 9, lambda c: 2 * c + 1, x))
        return jnp.sum((checkpoint_name(solution, "solution") if named else solution) * x)

    ours = specialise(function, jnp.ones(3))
    assert len(ours.program.saved) == (3 if named else 0)
    assert str(jax.make_jaxpr(jax.grad(ours))(jnp.ones(3))).count("while[") == (1 if named else 2)


@pytest.mark.parametrize(("length", "operations", "slots"), [(4, 30, 115), (3, 150, 3)])
def test_programs_cut_into_many_kernels_equal_plain(length, operations, slots, monkeypatch, x64):
    monkeypatch.setattr(emit, "KERNEL_OPERATIONS", operations)
    monkeypatch.setattr(emit, "KERNEL_SLOTS", slots)
    ours, plain, x, y = long_program(length)
    assert kernels(ours, x, y) >= 1 + ours.program.operations // operations
    assert_equal(with_gradient(ours), with_gradient(plain), x, y)


def test_programs_of_thousands_of_operations_equal_plain(x64):
    ours, plain, x, y = long_program(230)
    assert ours.program.operations > 5000
    assert kernels(ours, x, y) >= 1 + ours.program.operations // emit.KERNEL_OPERATIONS
    assert_equal(ours, plain, x, y)


def long_program(length):
    """A function that does not fold, written out and specialised, and the same as a scan."""
    drift = jnp.linspace(0, 1, length)

    def advance(x, shift):
        return 0.5 * jnp.sin(x) + 0.4 * jnp.roll(x, 1) * x[0] + shift, None

    def unrolled(x, y):
        for i in range(length):
            x, _ = advance(x, drift[i])
        return x * y

    x, y = draw("float64", 2, 4)
    return specialise(unrolled, x, y, mode="kernel"), lambda x, y: lax.scan(advance, x, drift)[0] * y, x, y


def kernels(function, *inputs):
    return jax.jit(function).lower(*inputs).as_text().count("stablehlo.reduce(")


def test_kernels_are_traced_no_more_often_than_they_stand_in_the_lowered_program(monkeypatch, x64):
    traced, run = [], kernel.run_scalars
    monkeypatch.setattr(kernel, "run_scalars", lambda graph, part, values: (traced.append(part), run(graph, part, values)))
    state = {"x": draw("float64", 3, 2), "count": jnp.zeros((3, 1), int)}
    ours = jax.checkpoint(specialise(composed, *jax.tree.map(lambda x: x[0], (state, state["x"])), mode="kernel"))

    def loss(pushes):
        return jnp.sum(jax.vmap(over_time(ours))(state, pushes)[0])

    text = jax.jit(jax.value_and_grad(loss)).lower(draw("float64", 3, 5, 2)).as_text()
    assert 0 < len(traced) <= text.count("stablehlo.reduce(") - text.count("applies stablehlo.add")  # the others are sums


COMPRESSED = {  # (function, how many numbers are passed on)
    "constants": (lambda x: [jnp.ones(4), 2 * jnp.eye(2)], 0),
    "duplicates and constants": (lambda x: [jnp.sin(x), jnp.sin(x)[::-1], jnp.zeros(2), jnp.sin(x)[1:]], 3),
    "triples": (lambda x: [x[0] + x[1] * x[2], x[0] - x[1] * x[2], x[0]], 2),
    "triples of products": (lambda x: [jnp.sin(x) + x * x, jnp.sin(x) - x * x, jnp.sin(x), jnp.zeros(3)], 6),
    "multiples": (lambda x: [2 * jnp.exp(x), jnp.exp(x) + 1, jnp.exp(x) ** 2], 3),
    "arguments": (lambda x: {"a": x, "b": (x[:2], 3 * x)}, 3),
    "no floats shared": (lambda x: [jnp.where(x > 0, 1.0, 2.0), jnp.where(x > 0, 3.0, 4.0)], 6),  # the predicate is no float
    "native": (lambda x: [jnp.sort(x), 2 * jnp.sort(x)[::-1]], None),
    "stopped": (lambda x: [x * x, lax.stop_gradient(x * x), lax.stop_gradient(jnp.sin(x)) * x], None),
    "empty": (lambda x: [x[:0], x * 1], 3),
}


@in_turn(COMPRESSED)
def test_expanding_what_was_compacted_equals_plain(name, mode, dtype):
    function, passed = COMPRESSED[name]
    x = draw(dtype, 3)
    compact, expand = compress(function, x, mode=mode)
    vector = jax.eval_shape(compact, x)
    assert vector.dtype == dtype and (passed is None or vector.shape == (passed,))
    assert jax.tree.structure(jax.eval_shape(expand, vector)) == jax.tree.structure(jax.eval_shape(function, x))
    after = specialise(lambda v: jax.tree.map(jnp.tanh, expand(v)), vector, mode=mode)
    ours = with_gradient(lambda x: (expand(compact(x)), after(compact(x))), wanted=0)
    assert_equal(ours, with_gradient(lambda x: (function(x), jax.tree.map(jnp.tanh, function(x))), wanted=0), x)


def test_expanded_constants_fold_in_the_next_function():
    compact, expand = compress(lambda x: [jnp.diag(x), jnp.zeros(3)], jnp.ones(3))
    after = specialise(lambda v: expand(v)[0] @ jnp.arange(1.0, 4.0) + expand(v)[1], jax.eval_shape(compact, jnp.ones(3)))
    assert after.program.operations == 2  # 1 x is x


@pytest.mark.parametrize(
    "call",
    [
        lambda f: f([jnp.ones((2, 3))]),
        lambda f: f(jnp.ones((2, 3)), jnp.ones(3)),
        lambda f: f(),
        lambda f: f(jnp.ones((3, 2))),  # as many numbers, in another order
        lambda f: f(jnp.ones((4, 2, 3))),
        lambda f: compress(lambda x: [2 * x, whole(x)], jnp.ones(3)),
    ],
)
def test_what_does_not_fit_is_refused(call):
    with pytest.raises(UsageError):
        call(specialise(lambda x: 2 * x, jnp.ones((2, 3))))
