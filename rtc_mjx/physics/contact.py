r"""The contact problem, its solution by Newton's method, and its exact derivative.

With M the mass matrix, f the smooth force, J the constraint Jacobian, D the constraint stiffness and a the reference
acceleration, MuJoCo's pyramidal contact solve is the minimum over accelerations q of the convex, piecewise quadratic

    c(q) = 1/2 q^T M q - q^T f + 1/2 sum_i D_i min(J_i q - a_i, 0)^2.

Its residual (the gradient) is r(q) = M q - f + J^T D act (J q - a) with act = [J q < a]; where act does not change, the
solution is a smooth function of (M, f, J, D, a) whose derivative is one linear solve with H = M + J^T D act J. `exact` states
it as one Newton correction around a solution that the differentiator takes as constant, so any converged solver will do.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float

from rtc_mjx.pytree import pytree

SOLUTION = "contact_solution"  # what a checkpoint policy keeps, so that a backward pass need not solve again
MAX_ITERATIONS = 32  # Newton steps; many more than the pile-ups of the tests need
LINE_SEARCH_ITERATIONS = 2
TOLERANCE = 1000  # in units of machine precision: by how much a row may end on the wrong side


@pytree
class Rows:
    """One-sided constraint rows (contacts and joint limits): J, D and a of the module docstring."""

    jacobian: Float[Array, "rows nv"]
    stiffness: Float[Array, "rows"]
    reference: Float[Array, "rows"]


@pytree
class ContactProblem:
    """What the solver sees: mass matrix (kg, kg m, kg m^2), smooth force (N, N m) and the constraint rows."""

    mass: Float[Array, "nv nv"]
    force: Float[Array, "nv"]
    rows: Rows


def violation(problem: ContactProblem, acceleration: Float[Array, "nv"]) -> Float[Array, "rows"]:
    """J q - a where negative, else 0: by how much each active row falls short of its reference acceleration."""
    return jnp.minimum(_excess(problem, acceleration), 0)


def residual(problem: ContactProblem, acceleration: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """r(q): the gradient of the contact cost, in N and N m; zero at the solution."""
    forces = problem.rows.stiffness * violation(problem, acceleration)
    return problem.mass @ acceleration - problem.force + problem.rows.jacobian.T @ forces


def relative_residual(problem: ContactProblem, acceleration: Float[Array, "nv"]) -> Float[Array, ""]:
    """Norm of the residual, in units of acceleration (M^-1 r), over 1 + the norm of the acceleration itself."""
    change = solve(problem.mass, residual(problem, acceleration))
    return jnp.linalg.norm(change) / (1 + jnp.linalg.norm(acceleration))


def exact(problem: ContactProblem, solution: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """The solution again, now carrying the implicit derivative with respect to every part of the problem.

    Args:
        problem: the contact problem, differentiable.
        solution: its minimiser from any converged solver, run on constants.

    Returns:
        q* - H^-1 r(q*), where only r's own dependence on the problem is differentiated (module docstring).
    """
    solution = checkpoint_name(lax.stop_gradient(solution), SOLUTION)
    hessian = lax.stop_gradient(
        _hessian(problem, _excess(problem, solution) < 0)
    )  # H is held fixed: r(q*) = 0, so its derivative drops out
    return solution - solve(hessian, residual(problem, solution))


def newton(problem: ContactProblem, start: Float[Array, "nv"]) -> tuple[Float[Array, "nv"], Bool[Array, ""]]:
    """Minimises the contact cost by safeguarded Newton steps until the active set is the solution's.

    The cost is piecewise quadratic, so a full step that leaves the active set as it was ends at the minimum, to rounding.

    Args:
        problem: the contact problem; no derivative is taken here (see `exact`).
        start: where to begin, such as the previous step's solution, m/s^2 and rad/s^2.

    Returns:
        The minimiser, and whether it was reached within `MAX_ITERATIONS`.
    """
    return iterate(functools.partial(newton_step, problem), start)


def iterate(advance: Callable[[Array], tuple[Array, Array]], start: Float[Array, "nv"]) -> tuple[Float[Array, "nv"], Bool[Array, ""]]:
    """Repeats a Newton step (`newton_step` with its problem filled in) until it says that it is done."""

    def body(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        acceleration, done = advance(carry[0])
        return acceleration, done, carry[2] + 1

    first = (start, jnp.zeros((), bool), jnp.zeros((), jnp.int32))
    return lax.while_loop(lambda carry: ~carry[1] & (carry[2] < MAX_ITERATIONS), body, first)[:2]


def newton_step(problem: ContactProblem, acceleration: Float[Array, "nv"]) -> tuple[Float[Array, "nv"], Bool[Array, ""]]:
    """One Newton step on the contact cost, and whether it ended at the minimum."""
    excess = _excess(problem, acceleration)
    force = problem.rows.stiffness * jnp.minimum(excess, 0)
    gradient = problem.mass @ acceleration - problem.force + problem.rows.jacobian.T @ force
    direction = -solve(_hessian(problem, excess < 0), gradient)
    change = problem.rows.jacobian @ direction
    there = excess + change
    astray = jnp.where(excess < 0, jnp.maximum(there, 0), jnp.minimum(there, 0))  # by how much rows changed sides
    slack = TOLERANCE * jnp.finfo(there.dtype).eps * (1 + jnp.max(jnp.abs(problem.rows.reference)))
    done = jnp.max(jnp.abs(astray)) <= slack
    length = _line_search(problem, direction, direction @ gradient, excess, change)
    return acceleration + jnp.where(done, 1, length) * direction, done


def _excess(problem: ContactProblem, acceleration: Float[Array, "nv"]) -> Float[Array, "rows"]:
    return problem.rows.jacobian @ acceleration - problem.rows.reference


def _hessian(problem: ContactProblem, active: Bool[Array, "rows"]) -> Float[Array, "nv nv"]:
    weight = jnp.where(active, problem.rows.stiffness, 0)
    return problem.mass + (problem.rows.jacobian.T * weight) @ problem.rows.jacobian


def _line_search(
    problem: ContactProblem,
    direction: Float[Array, "nv"],
    slope: Float[Array, ""],
    excess: Float[Array, "rows"],
    change: Float[Array, "rows"],
) -> Float[Array, ""]:
    """Step length at which the cost's slope along the direction is nearly zero: Newton from 1, held in its bracket.

    Args:
        problem: the contact problem.
        direction: where to go.
        slope: the cost's slope at length 0, negative.
        excess: J q - a at length 0.
        change: J times the direction.
    """
    push, before = problem.rows.stiffness * change, jnp.minimum(excess, 0)
    quadratic = direction @ (problem.mass @ direction)
    low, high, length = jnp.zeros_like(slope), jnp.full_like(slope, 2), jnp.ones_like(slope)
    for _ in range(LINE_SEARCH_ITERATIONS):
        there = excess + length * change
        here = slope + length * quadratic + push @ (jnp.minimum(there, 0) - before)
        curvature = quadratic + jnp.sum(jnp.where(there < 0, push * change, 0))
        low, high = jnp.where(here < 0, length, low), jnp.where(here < 0, high, length)
        proposal = length - here / jnp.where(curvature > 0, curvature, 1)
        length = jnp.where((proposal >= low) & (proposal <= high), proposal, 0.5 * (low + high))
    return length


def solve(matrix: Float[Array, "nv nv"], vector: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """Solves a symmetric positive definite system, such as one with the mass matrix."""
    return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(matrix, symmetrize_input=False), True), vector)
