"""One physics step, composed from MJX's parts so that it can be differentiated exactly, contacts included.

Values equal `mjx.step` with a converged solver, with one deliberate difference: an actuator whose force is clamped
contributes no velocity derivative to the implicit integrator, as in C MuJoCo and unlike MJX 3.17 (a car sliding
sideways would stop too late). Only the state travels from step to step; the rest of `mjx.Data` is rebuilt.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax
from jaxtyping import Array, Float
from mujoco import mjx

from rtc_mjx.errors import NonFiniteError, UsageError
from rtc_mjx.physics import contact
from rtc_mjx.physics.world import World

Solver = Literal["newton", "mjx"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PhysicsState:
    """What one step hands to the next.

    Attributes:
        qpos: joint positions, m and rad.
        qvel: joint velocities, m/s and rad/s.
        warmstart: the last acceleration, where the contact solver starts, m/s^2 and rad/s^2; empty without contacts.
    """

    qpos: Float[Array, "nv"]
    qvel: Float[Array, "nv"]
    warmstart: Float[Array, "warm"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Surroundings:
    """Bodies moved from outside (goals, replayed road users) during one step.

    Attributes:
        pose: x in m, y in m, heading in rad of each.
        size: length and width in m of each; ignored for bodies that do not collide.
    """

    pose: Float[Array, "users 3"]
    size: Float[Array, "users 2"]


def rest_state(world: World) -> PhysicsState:
    """The asset's own configuration, at rest."""
    warm = world.mj.nv if constraint_rows(world) else 0
    zeros = jnp.zeros(world.mj.nv)
    return PhysicsState(qpos=jnp.asarray(world.mj.qpos0, zeros.dtype), qvel=zeros, warmstart=jnp.zeros(warm))


def rest_surroundings(world: World) -> Surroundings:
    """Mocap bodies where the asset puts them, with the asset's sizes."""
    ids = np.flatnonzero(world.mj.body_mocapid >= 0)[np.argsort(world.mj.body_mocapid[world.mj.body_mocapid >= 0])]
    position, quaternion = world.mj.body_pos[ids], world.mj.body_quat[ids]
    heading = 2 * np.arctan2(quaternion[:, 3], quaternion[:, 0])
    pose = np.concatenate([position[:, :2], heading[:, None]], axis=1)
    return Surroundings(pose=jnp.asarray(pose), size=jnp.asarray(np.nan_to_num(world.default_sizes)))


def constraint_rows(world: World) -> int:
    """Number of constraint rows (contacts and joint limits) of the world."""
    return int(world.mjx_data()._impl.efc_J.shape[0])


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
        solver: 'newton', a fixed number of Newton steps (`contact.newton`), or 'mjx', MJX's own solver to convergence.

    Returns:
        The state after the step; its reverse-mode derivative is exact wherever no contact starts or ends.
    """
    model = _with_sizes(world, surroundings)
    data = _forward(world, model, state, control, surroundings)
    mass = mjx.full_m(model, data) if mjx.is_sparse(model) else data._impl.M
    if constraint_rows(world):
        problem = _problem(data, mass)
        acceleration = contact.exact(problem, _solve(model, data, problem, solver))
        force, warmstart = mass @ acceleration, acceleration
    else:
        force, warmstart = data.qfrc_smooth, state.warmstart
    return _integrate(world, model, data, mass, force, warmstart)


def contact_problem(
    world: World, state: PhysicsState, control: Float[Array, "controls"], surroundings: Surroundings
) -> contact.ContactProblem:
    """The contact problem that `step` solves in this state; for checks of a solver, not for stepping."""
    model = _with_sizes(world, surroundings)
    data = _forward(world, model, state, control, surroundings)
    return _problem(data, mjx.full_m(model, data) if mjx.is_sparse(model) else data._impl.M)


def simulate(
    world: World,
    state: PhysicsState,
    controls: Float[Array, "steps controls"],
    surroundings: Surroundings,
    *,
    substeps: int = 1,
    one_step: Callable[..., PhysicsState] | None = None,
) -> tuple[PhysicsState, PhysicsState]:
    """Rolls one world forward under given controls, each held for `substeps` physics steps.

    Args:
        world: the world.
        state: the first state.
        controls: one control vector per control step.
        surroundings: mocap bodies; leaves with a leading axis of `steps` are played back, others stand still.
        substeps: physics steps per control step.
        one_step: (state, control, surroundings) -> state, such as a specialised step; `step` on this world if None.

    Returns:
        The last state, and the states after each control step (leading axis `steps`).

    Raises:
        NonFiniteError: a concrete input holds NaN or infinity; the error names the field and the index.
        UsageError: the controls do not fit the world.
    """
    check_inputs(world, state, controls, surroundings)
    played = surroundings.pose.ndim == 3
    advance = one_step or (lambda *inputs: step(world, *inputs))

    def control_step(state: PhysicsState, inputs: tuple[Array, Surroundings | None]) -> tuple[PhysicsState, PhysicsState]:
        control, moved = inputs
        around = surroundings if moved is None else moved
        state = lax.scan(lambda s, _: (advance(s, control, around), None), state, length=substeps)[0]
        return state, state

    body = control_step if substeps == 1 and one_step is not None else jax.checkpoint(control_step)
    return lax.scan(body, state, (controls, surroundings if played else None))


def check_inputs(world: World, state: PhysicsState, controls: Array, surroundings: Surroundings) -> None:
    """Raises before anything is compiled where a control vector has the wrong width or a concrete input is not finite."""
    if controls.shape[-1] != len(world.control_ids):
        wanted = f"{len(world.control_ids)} ({', '.join(world.control_names)})"
        raise UsageError(f"controls have {controls.shape[-1]} columns; world '{world.name}' takes {wanted}")
    named = {"state.qpos": state.qpos, "state.qvel": state.qvel, "state.warmstart": state.warmstart}
    named |= {"controls": controls, "surroundings.pose": surroundings.pose, "surroundings.size": surroundings.size}
    for name, value in named.items():
        if isinstance(value, jax.core.Tracer):
            continue  # inside a compiled program values are not known; what computes them is checked there
        bad = np.argwhere(~np.isfinite(np.asarray(value)))
        if bad.size:
            index = tuple(int(i) for i in bad[0])
            raise NonFiniteError(f"{name}{list(index)} is {np.asarray(value)[index]} in world '{world.name}'; finite values are needed")


def _with_sizes(world: World, surroundings: Surroundings) -> mjx.Model:
    model = world.mjx_model()
    users = [(row, geom) for row, geom in enumerate(world.user_geoms) if geom >= 0]
    if not users:
        return model
    rows, geoms = np.array(users).T
    length, width = surroundings.size[rows, 0], surroundings.size[rows, 1]
    radius = 0.5 * jnp.minimum(length, width)
    half = 0.5 * jnp.maximum(length - width, 0)
    sizes = jnp.stack([radius, half, jnp.zeros_like(half)], axis=1)
    return model.replace(geom_size=jnp.asarray(model.geom_size).at[geoms].set(sizes))


def _forward(world: World, model: mjx.Model, state: PhysicsState, control: Array, surroundings: Surroundings) -> mjx.Data:
    """Everything up to the contact problem: positions, collisions, constraint rows, smooth forces."""
    ids = np.flatnonzero(world.mj.body_mocapid >= 0)[np.argsort(world.mj.body_mocapid[world.mj.body_mocapid >= 0])]
    x, y, heading = surroundings.pose.T
    nothing = jnp.zeros_like(x)
    data = world.mjx_data().replace(
        qpos=state.qpos,
        qvel=state.qvel,
        ctrl=jnp.zeros(world.mj.nu).at[np.array(world.control_ids, int)].set(control),
        mocap_pos=jnp.stack([x, y, jnp.asarray(world.mj.body_pos[ids, 2], x.dtype)], axis=1),
        mocap_quat=jnp.stack([jnp.cos(heading / 2), nothing, nothing, jnp.sin(heading / 2)], axis=1),
    )
    if state.warmstart.size:
        data = data.replace(qacc_warmstart=state.warmstart)
    data = mjx.fwd_velocity(model, _fwd_position(world, model, data))
    return mjx.fwd_acceleration(model, mjx.fwd_actuation(model, data))


def _fwd_position(world: World, model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.fwd_position` without cameras and tendons, and with contact frames that suit a planar world."""
    data = mjx.factor_m(model, mjx.crb(model, mjx.com_pos(model, mjx.kinematics(model, data))))
    data = mjx.collision(model, data)
    if world.planar and data._impl.ncon:
        data = data.tree_replace({"_impl.contact.frame": _planar_frames(data._impl.contact.frame)})
    return mjx.transmission(model, mjx.make_constraint(model, data))


def _planar_frames(frames: Float[Array, "contacts 3 3"]) -> Float[Array, "contacts 3 3"]:
    """Contact frames (normal, in-plane tangent, z).

    MJX picks the tangents by the normal's direction; up to order and sign they are these, and with equal friction along
    both the friction pyramid is the same set of rows. Fixed, the rows along z fold away when the step is specialised.
    """
    x, y = frames[:, 0, 0], frames[:, 0, 1]
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    rows = ([x, y, zero], [-y, x, zero], [zero, zero, one])
    return jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)


def _problem(data: mjx.Data, mass: Array) -> contact.ContactProblem:
    rows = data._impl
    return contact.ContactProblem(mass, data.qfrc_smooth, rows.efc_J, rows.efc_D, rows.efc_aref)


def _solve(model: mjx.Model, data: mjx.Data, problem: contact.ContactProblem, solver: Solver) -> Array:
    if solver == "mjx":
        return mjx.solve(*lax.stop_gradient((model, data))).qacc
    if solver == "newton":
        problem = lax.stop_gradient(problem)
        return contact.newton(problem, contact.warm_start(problem, lax.stop_gradient(data.qacc_warmstart)))
    raise UsageError(f"solver '{solver}' is not one of newton, mjx")


def _integrate(world: World, model: mjx.Model, data: mjx.Data, mass: Array, force: Array, warmstart: Array) -> PhysicsState:
    """Implicit in the velocity derivative that the integrator takes, semi-implicit in position."""
    h = world.timestep
    rate = _velocity_derivative(world, model, data)
    acceleration = contact._solve(mass - h * rate, force)
    qvel = data.qvel + h * acceleration
    return PhysicsState(qpos=data.qpos + h * qvel, qvel=qvel, warmstart=warmstart)


def _velocity_derivative(world: World, model: mjx.Model, data: mjx.Data) -> Float[Array, "nv nv"]:
    """d force / d velocity as the integrator uses it: joint damping, and for implicitfast the actuators not clamped."""
    damping = jnp.diag(-jnp.asarray(model.dof_damping))
    if world.mj.opt.integrator == mujoco.mjtIntegrator.mjINT_EULER:
        off = world.mj.opt.disableflags & (mujoco.mjtDisableBit.mjDSBL_EULERDAMP | mujoco.mjtDisableBit.mjDSBL_DAMPER)
        return jnp.zeros_like(damping) if off else damping
    if not world.mj.nu:
        return damping
    affine = world.mj.actuator_gaintype == mujoco.mjtGain.mjGAIN_AFFINE
    per_control = np.where(affine, world.mj.actuator_gainprm[:, 2], 0.0)
    biased = world.mj.actuator_biastype == mujoco.mjtBias.mjBIAS_AFFINE
    slope = np.where(biased, world.mj.actuator_biasprm[:, 2], 0.0) + per_control * data.ctrl
    low, high = world.mj.actuator_forcerange.T
    limited = world.mj.actuator_forcelimited.astype(bool)
    clamped = limited & ((data.actuator_force <= low) | (data.actuator_force >= high))
    slope = jnp.where(clamped, 0, slope)  # C MuJoCo skips these in its derivative, MJX 3.17 does not
    moment = data._impl.actuator_moment
    return damping + (moment.T * slope) @ moment
