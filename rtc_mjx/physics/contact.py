r"""The contact problem, its solution by Newton's method, and its exact derivative.

With M the mass matrix, f the smooth force, J the constraint Jacobian, D the constraint stiffness and a the reference
acceleration, MuJoCo's pyramidal contact solve is the minimum over accelerations q of the convex, piecewise quadratic

    c(q) = 1/2 q^T M q - q^T f + 1/2 sum_i D_i min(J_i q - a_i, 0)^2.

Its residual (the gradient) is r(q) = M q - f + J^T D act (J q - a) with act = [J q < a]; where act does not change, the
solution is a smooth function of (M, f, J, D, a) whose derivative is one linear solve with H = M + J^T D act J. `exact` states
it as one Newton correction around a solution that the differentiator takes as constant, so any converged solver will do.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Float

SOLUTION = "contact_solution"  # what a checkpoint policy keeps, so that a backward pass need not solve again
NEWTON_ITERATIONS = 6
LINE_SEARCH_ITERATIONS = 2


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rows:
    """One-sided constraint rows (contacts and joint limits): J, D and a of the module docstring."""

    jacobian: Float[Array, "rows nv"]
    stiffness: Float[Array, "rows"]
    reference: Float[Array, "rows"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
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
    hessian = lax.stop_gradient(_hessian(problem, _excess(problem, solution) < 0))  # H is held fixed: r(q*) = 0, so its derivative drops out
    return solution - solve(hessian, residual(problem, solution))


def newton(problem: ContactProblem, start: Float[Array, "nv"], iterations: int = NEWTON_ITERATIONS) -> Float[Array, "nv"]:
    """Minimises the contact cost by a fixed number of Newton steps, each with a bracketed search along its direction.

    A fixed count has no control flow, so the solve unrolls into straight-line arithmetic (`rtc_mjx.specialise`). It is
    exact once the active set is found; `relative_residual` says whether it was, and the tests hold it against MJX.

    Args:
        problem: the contact problem; its derivative is not taken here (see `exact`).
        start: where to begin, the unconstrained acceleration M^-1 f or the previous step's solution, rad/s^2 and m/s^2.
        iterations: number of Newton steps.
    """
    acceleration, excess = start, _excess(problem, start)
    for _ in range(iterations):
        force = problem.rows.stiffness * jnp.minimum(excess, 0)
        gradient = problem.mass @ acceleration - problem.force + problem.rows.jacobian.T @ force
        direction = -solve(_hessian(problem, excess < 0), gradient)
        change = problem.rows.jacobian @ direction
        length = _line_search(problem, direction, direction @ gradient, excess, change)
        acceleration, excess = acceleration + length * direction, excess + length * change
    return acceleration


def _excess(problem: ContactProblem, acceleration: Float[Array, "nv"]) -> Float[Array, "rows"]:
    return problem.rows.jacobian @ acceleration - problem.rows.reference


def _hessian(problem: ContactProblem, active: Float[Array, "rows"]) -> Float[Array, "nv nv"]:
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
