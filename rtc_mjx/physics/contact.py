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
class ContactProblem:
    """What the solver sees; all rows are one-sided (contacts and joint limits)."""

    mass: Float[Array, "nv nv"]
    force: Float[Array, "nv"]
    jacobian: Float[Array, "rows nv"]
    stiffness: Float[Array, "rows"]
    reference: Float[Array, "rows"]


def violation(problem: ContactProblem, acceleration: Float[Array, "nv"]) -> Float[Array, "rows"]:
    """J q - a where negative, else 0: by how much each active row falls short of its reference acceleration."""
    return jnp.minimum(problem.jacobian @ acceleration - problem.reference, 0)


def residual(problem: ContactProblem, acceleration: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """r(q): the gradient of the contact cost, in N and N m; zero at the solution."""
    forces = problem.stiffness * violation(problem, acceleration)
    return problem.mass @ acceleration - problem.force + problem.jacobian.T @ forces


def relative_residual(problem: ContactProblem, acceleration: Float[Array, "nv"]) -> Float[Array, ""]:
    """Norm of the residual, in units of acceleration (M^-1 r), over 1 + the norm of the acceleration itself."""
    change = _solve(problem.mass, residual(problem, acceleration))
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
    hessian = lax.stop_gradient(_hessian(problem, solution))  # H is held fixed: r(q*) = 0, so its derivative drops out
    return solution - _solve(hessian, residual(problem, solution))


def newton(problem: ContactProblem, start: Float[Array, "nv"], iterations: int = NEWTON_ITERATIONS) -> Float[Array, "nv"]:
    """Minimises the contact cost by a fixed number of Newton steps, each with a bracketed search along its direction.

    A fixed count has no control flow, so the solve unrolls into straight-line arithmetic (`rtc_mjx.specialise`). It is
    exact once the active set is found; `relative_residual` says whether it was, and the tests hold it against MJX.

    Args:
        problem: the contact problem; its derivative is not taken here (see `exact`).
        start: where to begin, the unconstrained acceleration M^-1 f or the previous step's solution, rad/s^2 and m/s^2.
        iterations: number of Newton steps.
    """
    acceleration = start
    for _ in range(iterations):
        direction = -_solve(_hessian(problem, acceleration), residual(problem, acceleration))
        acceleration = acceleration + _line_search(problem, acceleration, direction) * direction
    return acceleration


def warm_start(problem: ContactProblem, previous: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """The cheaper of the previous step's acceleration and the unconstrained one, as MuJoCo starts its solvers."""
    smooth = _solve(problem.mass, problem.force)
    return jnp.where(_cost(problem, previous) < _cost(problem, smooth), previous, smooth)


def _cost(problem: ContactProblem, acceleration: Float[Array, "nv"]) -> Float[Array, ""]:
    short = violation(problem, acceleration)
    smooth = acceleration @ (0.5 * (problem.mass @ acceleration) - problem.force)
    return smooth + 0.5 * jnp.sum(problem.stiffness * short * short)


def _hessian(problem: ContactProblem, acceleration: Float[Array, "nv"]) -> Float[Array, "nv nv"]:
    active = problem.jacobian @ acceleration < problem.reference
    weight = jnp.where(active, problem.stiffness, 0)
    return problem.mass + (problem.jacobian.T * weight) @ problem.jacobian


def _line_search(problem: ContactProblem, start: Float[Array, "nv"], direction: Float[Array, "nv"]) -> Float[Array, ""]:
    """Step length whose slope along the direction is nearly zero; Newton from 1, held in its bracket."""
    row, row_slope = problem.jacobian @ start - problem.reference, problem.jacobian @ direction
    linear = direction @ (problem.mass @ start - problem.force)
    quadratic = direction @ (problem.mass @ direction)
    low, high, length = jnp.zeros_like(linear), jnp.full_like(linear, 2), jnp.ones_like(linear)
    for _ in range(LINE_SEARCH_ITERATIONS):
        force = problem.stiffness * row_slope
        active = row + length * row_slope < 0
        slope = linear + length * quadratic + jnp.sum(jnp.where(active, force * (row + length * row_slope), 0))
        curvature = quadratic + jnp.sum(jnp.where(active, force * row_slope, 0))
        low, high = jnp.where(slope < 0, length, low), jnp.where(slope < 0, high, length)
        proposal = length - slope / jnp.where(curvature > 0, curvature, 1)
        inside = (proposal >= low) & (proposal <= high)
        length = jnp.where(inside, proposal, 0.5 * (low + high))
    return length


def _solve(matrix: Float[Array, "nv nv"], vector: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """Solves a symmetric positive definite system."""
    return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(matrix, symmetrize_input=False), True), vector)
