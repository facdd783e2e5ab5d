"""One physics step, composed from MJX's parts so that it can be differentiated exactly, contacts included.

    (state, control)          -> dynamics: mass, smooth force, integrator terms, rows among the free bodies
    (state, one road user)    -> contact rows of that user, for every user alike (vmap)
    problem = dynamics + rows -> solution (no derivative) -> exact derivative -> integrate -> state

Values equal `mjx.step` with a converged solver, with one deliberate difference: an actuator whose force is clamped
contributes no velocity derivative to the implicit integrator, as in C MuJoCo and unlike MJX 3.17 (a car sliding
sideways would stop too late). Only the state travels from step to step; the rest of `mjx.Data` is rebuilt.
"""

from typing import Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from mujoco import mjx

from rtc_mjx.errors import UsageError
from rtc_mjx.physics import contact
from rtc_mjx.physics.world import Part, World
from rtc_mjx.pytree import pytree

Solver = Literal["newton", "mjx"]


@pytree
class PhysicsState:
    """What one step hands to the next; leading axes are batch or time.

    Attributes:
        qpos: joint positions, m and rad.
        qvel: joint velocities, m/s and rad/s.
        warmstart: the last acceleration, where the contact solver starts, m/s^2 and rad/s^2; empty without contacts.
    """

    qpos: Float[Array, "*batch nv"]
    qvel: Float[Array, "*batch nv"]
    warmstart: Float[Array, "*batch warm"]


@pytree
class Surroundings:
    """Bodies moved from outside (goals, replayed road users) during one step.

    Attributes:
        pose: x in m, y in m, heading in rad of each.
        size: length and width in m of each; ignored for bodies that do not collide.
    """

    pose: Float[Array, "*batch users 3"]
    size: Float[Array, "*batch users 2"]


@pytree
class Dynamics:
    """What a state and a control determine without the road users.

    Attributes:
        mass: joint-space inertia M.
        force: all smooth forces, N and N m.
        implicit: M - h dforce/dvelocity, the matrix of the integrator.
        rows: constraint rows among the free bodies.
    """

    mass: Float[Array, "nv nv"]
    force: Float[Array, "nv"]
    implicit: Float[Array, "nv nv"]
    rows: contact.Rows


def rest_state(world: World) -> PhysicsState:
    """The asset's own configuration, at rest."""
    warm = world.mj.nv if constraint_rows(world) else 0
    zeros = jnp.zeros(world.mj.nv)
    return PhysicsState(qpos=jnp.asarray(world.mj.qpos0, zeros.dtype), qvel=zeros, warmstart=jnp.zeros(warm))


def rest_surroundings(world: World) -> Surroundings:
    """Mocap bodies where the asset puts them, with the asset's sizes; bodies that collide with nothing get size 0."""
    position, quaternion = world.mj.body_pos[list(world.mocap_ids)], world.mj.body_quat[list(world.mocap_ids)]
    heading = 2 * np.arctan2(quaternion[:, 3], quaternion[:, 0])
    pose = np.concatenate([position[:, :2], heading[:, None]], axis=1)
    dtype = jnp.zeros(()).dtype
    return Surroundings(pose=jnp.asarray(pose, dtype), size=jnp.asarray(np.nan_to_num(world.default_sizes), dtype))


def constraint_rows(world: World) -> int:
    """Number of constraint rows (contacts and joint limits) of the world."""
    return world.free.rows + len(world.users) * len(world.one_user.user_rows) if world.one_user else world.free.rows


def step(
    world: World,
    state: PhysicsState,
    control: Float[Array, "controls"],
    surroundings: Surroundings,
    solver: Solver = "newton",
) -> PhysicsState:
    """Advances one world by one timestep.

    Args:
        world: the world.
        state: state before the step.
        control: one value per `world.control_names`, in the actuator's units; clamped to its range as MuJoCo does.
        surroundings: mocap bodies during the step.
        solver: 'newton', ours (`contact.newton`), or 'mjx', MJX's own, run to convergence.

    Returns:
        The state after the step; its reverse-mode derivative is exact wherever no contact starts or ends.
    """
    terms = dynamics(world, state, control)
    if not constraint_rows(world):
        return integrate(world, state, terms, terms.force, state.warmstart)
    problem = assemble(terms, user_rows(world, state, surroundings))
    solution = _solution(world, problem, state.warmstart, solver)
    return finish(world, state, terms, problem, solution)


def contact_problem(
    world: World, state: PhysicsState, control: Float[Array, "controls"], surroundings: Surroundings
) -> contact.ContactProblem:
    """The contact problem that `step` solves in this state; for checks of a solver, not for stepping."""
    return assemble(dynamics(world, state, control), user_rows(world, state, surroundings))


def dynamics(world: World, state: PhysicsState, control: Float[Array, "controls"]) -> Dynamics:
    """Mass, smooth forces and rows of the free bodies (first line of the module docstring)."""
    part = world.free
    model, data = part.mjx_model(), _positioned(part, part.mjx_model(), state)
    data = data.replace(ctrl=jnp.zeros(part.mj.nu).at[np.array(world.control_ids, int)].set(control))
    data = mjx.fwd_velocity(model, mjx.transmission(model, mjx.factor_m(model, mjx.crb(model, data))))
    data = mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))
    mass = mjx.full_m(model, data) if mjx.is_sparse(model) else data._impl.M
    implicit = mass - world.timestep * _velocity_derivative(part.mj, model, data)
    return Dynamics(mass, data.qfrc_smooth, implicit, _rows(part, model, data, slice(None)))


def user_rows(world: World, state: PhysicsState, surroundings: Surroundings) -> contact.Rows:
    """Contact rows of every road user, user by user."""
    if not world.one_user:
        return contact.Rows(jnp.zeros((0, world.mj.nv)), jnp.zeros(0), jnp.zeros(0))
    users = jnp.array(world.users, int)
    rows = jax.vmap(lambda pose, size: one_user_rows(world, state, pose, size))(surroundings.pose[users], surroundings.size[users])
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rows)


def one_user_rows(world: World, state: PhysicsState, pose: Float[Array, "3"], size: Float[Array, "2"]) -> contact.Rows:
    """Contact rows between the free bodies and one road user at a pose, with a length and a width."""
    part = world.one_user
    if part is None:
        raise UsageError(f"world '{world.name}' has no road users")
    radius, half = 0.5 * jnp.minimum(size[0], size[1]), 0.5 * jnp.maximum(size[0] - size[1], 0)
    model = part.mjx_model()
    capsule = jnp.stack([radius, half, jnp.zeros_like(half)])
    model = model.replace(geom_size=jnp.asarray(model.geom_size).at[part.user_geom].set(capsule))
    data = _positioned(part, model, state, pose)
    return _rows(part, model, data, np.array(part.user_rows))


def assemble(terms: Dynamics, users: contact.Rows) -> contact.ContactProblem:
    """The contact problem of one step."""
    rows = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), terms.rows, users)
    return contact.ContactProblem(terms.mass, terms.force, rows)


def finish(world: World, state: PhysicsState, terms: Dynamics, problem: contact.ContactProblem, solution: Array) -> PhysicsState:
    """From a solution of the contact problem to the next state, with the exact derivative."""
    acceleration = contact.exact(problem, solution)
    return integrate(world, state, terms, terms.mass @ acceleration, acceleration)


def integrate(world: World, state: PhysicsState, terms: Dynamics, force: Array, warmstart: Array) -> PhysicsState:
    """Implicit in the velocity derivative that the integrator takes, semi-implicit in position."""
    qvel = state.qvel + world.timestep * contact.solve(terms.implicit, force)
    return PhysicsState(qpos=state.qpos + world.timestep * qvel, qvel=qvel, warmstart=warmstart)


def _positioned(part: Part, model: mjx.Model, state: PhysicsState, pose: Array | None = None) -> mjx.Data:
    """Kinematics of one part of the world."""
    data = part.mjx_data().replace(qpos=state.qpos, qvel=state.qvel)
    if pose is not None:
        height, nothing = jnp.asarray(part.mj.body_pos[part.user_body, 2], pose.dtype), jnp.zeros((), pose.dtype)
        turned = jnp.stack([jnp.cos(pose[2] / 2), nothing, nothing, jnp.sin(pose[2] / 2)])
        data = data.replace(mocap_pos=jnp.stack([pose[0], pose[1], height])[None], mocap_quat=turned[None])
    return mjx.com_pos(model, mjx.kinematics(model, data))


def _rows(part: Part, model: mjx.Model, data: mjx.Data, wanted: slice | np.ndarray) -> contact.Rows:
    """Collides and makes constraint rows, in contact frames that suit a planar world."""
    data = mjx.collision(model, data)
    if part.planar and data._impl.ncon:
        data = data.tree_replace({"_impl.contact.frame": _planar_frames(data._impl.contact.frame)})
    rows = mjx.make_constraint(model, data)._impl
    return contact.Rows(rows.efc_J[wanted], rows.efc_D[wanted], rows.efc_aref[wanted])


def _planar_frames(frames: Float[Array, "contacts 3 3"]) -> Float[Array, "contacts 3 3"]:
    """Contact frames (normal, in-plane tangent, z).

    MJX picks the tangents by the normal's direction; up to order and sign they are these, and with equal friction along
    both the friction pyramid is the same set of rows. Fixed, the rows along z fold away when the step is specialised.
    """
    x, y = frames[:, 0, 0], frames[:, 0, 1]
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    rows = ([x, y, zero], [-y, x, zero], [zero, zero, one])
    return jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)


def _solution(world: World, problem: contact.ContactProblem, start: Array, solver: Solver) -> Array:
    """A converged solution without derivative."""
    problem, start = lax.stop_gradient((problem, start))
    if solver == "newton":
        return contact.newton(problem, start)[0]
    if solver == "mjx":
        return _mjx_solution(world.free, problem, start)
    raise UsageError(f"solver '{solver}' is not one of newton, mjx")


def _mjx_solution(part: Part, problem: contact.ContactProblem, start: Array) -> Array:
    """MJX's solver, handed our rows through the `mjx.Data` it reads."""
    model, data, rows = part.dense.mjx_model(), part.dense.mjx_data(), problem.rows
    nothing = jnp.zeros_like(rows.stiffness)
    data = data.replace(qfrc_smooth=problem.force, qacc_smooth=contact.solve(problem.mass, problem.force), qacc_warmstart=start)
    factor = jax.scipy.linalg.cho_factor(problem.mass)[0]
    data = data.tree_replace({
        "_impl.M": problem.mass, "_impl.qLD": factor, "_impl.efc_J": rows.jacobian, "_impl.efc_D": rows.stiffness,
        "_impl.efc_aref": rows.reference, "_impl.efc_frictionloss": nothing, "_impl.efc_force": nothing,
        "_impl.nefc": rows.reference.shape[0],
    })  # fmt: skip
    return mjx.solve(model, data).qacc


def _velocity_derivative(mj: mujoco.MjModel, model: mjx.Model, data: mjx.Data) -> Float[Array, "nv nv"]:
    """D force / d velocity as the integrator uses it: joint damping, and for implicitfast the actuators not clamped."""
    damping = jnp.diag(-jnp.asarray(model.dof_damping))
    if mj.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        off = mj.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_EULERDAMP | mujoco.mjtDisableBit.mjDSBL_DAMPER)
        return jnp.zeros_like(damping) if off else damping
    if not mj.nu:
        return damping
    affine = mj.actuator_gaintype == mujoco.mjtGain.mjGAIN_AFFINE
    per_control = np.where(affine, mj.actuator_gainprm[:, 2], 0.0)
    biased = mj.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    slope = np.where(biased, mj.actuator_biasprm[:, 2], 0.0) + per_control * data.ctrl
    low, high = mj.actuator_forcerange.T
    limited = mj.actuator_forcelimited.astype(bool)
    clamped = limited & ((data.actuator_force <= low) | (data.actuator_force >= high))
    slope = jnp.where(clamped, 0, slope)  # C MuJoCo skips these in its derivative, MJX 3.17 does not
    moment = data._impl.actuator_moment
    return damping + (moment.T * slope) @ moment
