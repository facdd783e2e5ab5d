"""Three free cars run into each other: how far a step and its gradient are from the truth.

The truth is C MuJoCo with a converged solver, in double precision, and central differences of it. `python -m rtc_mjx.benchmark`
prints ours beside `mjx.step` with one solver iteration, the usual way to get a gradient at all.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import lax
from jaxtyping import Float
from mujoco import mjx
from rich.table import Table

from rtc_mjx.physics import PhysicsState, World, load, rest_surroundings, simulate

STEPS = 50  # of 0.05 s
STEP = 1e-6  # of the central differences
Trajectory = Float[np.ndarray, "steps nv"]


def start(world: World) -> tuple[Float[np.ndarray, "nv"], Float[np.ndarray, "nv"]]:
    """Positions and velocities: a fast car into a slow one into a standing one, all askew."""
    qpos, qvel = np.zeros(world.mj.nv), np.zeros(world.mj.nv)
    qpos[4:7], qpos[8:11] = (7.0, 0.6, 0.4), (12.0, -0.7, -0.5)
    qvel[0], qvel[4] = 12.0, 3.0
    return qpos, qvel


def weights(world: World) -> Float[np.ndarray, "nv"]:
    """Of the final positions, in the scalar whose gradient is compared."""
    return np.cos(np.arange(world.mj.nv))


def c_trajectory(world: World, qpos: np.ndarray, qvel: np.ndarray) -> tuple[Trajectory, int]:
    """C MuJoCo to convergence: positions after every step, and the number of contact rows seen."""
    model = world.mj.__copy__()
    model.opt.tolerance, model.opt.iterations, model.opt.ls_iterations = 1e-15, 500, 200
    data, positions, rows = mujoco.MjData(model), [], 0
    data.qpos[:], data.qvel[:] = qpos, qvel
    for _ in range(STEPS):
        mujoco.mj_step(model, data)
        positions.append(data.qpos.copy())
        rows += data.nefc
    return np.array(positions), rows


def central_differences(world: World) -> Float[np.ndarray, "nv"]:
    """Gradient of the weighted final positions with respect to the initial velocities."""
    qpos, qvel = start(world)
    ends = [[c_trajectory(world, qpos, qvel + s * STEP * e)[0][-1] @ weights(world) for s in (1, -1)] for e in np.eye(world.mj.nv)]
    return np.array([(up - down) / (2 * STEP) for up, down in ends])


def ours(world: World) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """Our plain step: velocities to all positions."""
    around, controls = rest_surroundings(world), jnp.zeros((STEPS, len(world.control_ids)))
    return lambda qpos, qvel: simulate(world, PhysicsState(qpos, qvel, jnp.zeros_like(qvel)), controls, around)[1].qpos


def native(world: World) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """`mjx.step` with one solver iteration."""
    model = mjx.put_model(world.mj, impl="jax").tree_replace({"opt.iterations": 1})
    data = mjx.make_data(world.mj, impl="jax")

    def body(data: mjx.Data, _: None) -> tuple[mjx.Data, jax.Array]:
        data = mjx.step(model, data)
        return data, data.qpos

    return lambda qpos, qvel: lax.scan(body, data.replace(qpos=qpos, qvel=qvel), None, length=STEPS)[1]


def compare() -> dict[str, dict[str, float]]:
    """Errors of both, in the form of the benchmark's JSON."""
    with jax.enable_x64(True):
        world = load("driving", cars=3, road_users=0)
        qpos, qvel = (jnp.asarray(x) for x in start(world))
        truth, slope = c_trajectory(world, *start(world))[0], central_differences(world)
        errors = {}
        for name, rollout in (("ours", ours(world)), ("native_1_iteration", native(world))):

            def end(v: jax.Array, rollout: Callable[..., jax.Array] = rollout) -> tuple[jax.Array, jax.Array]:
                positions = rollout(qpos, v)
                return positions[-1] @ weights(world), positions

            # forward mode gives MJX's unrolled iteration the same derivative, and compiles much faster
            slope_of = jax.grad if name == "ours" else jax.jacfwd
            gradient, positions = jax.jit(slope_of(end, has_aux=True))(qvel)
            errors[name] = {
                "trajectory_error_m": float(np.max(np.abs(np.asarray(positions) - truth))),
                "gradient_relative_error": float(np.linalg.norm(np.asarray(gradient) - slope) / np.linalg.norm(slope)),
            }
    return errors


def table(errors: dict[str, dict[str, float]]) -> Table:
    """For the terminal."""
    out = Table(title=f"Three cars piling up, {STEPS} steps, against C MuJoCo and central differences")
    for column in ("step", "trajectory error m", "gradient relative error"):
        out.add_column(column)
    for name, error in errors.items():
        out.add_row(name, f"{error['trajectory_error_m']:.2e}", f"{error['gradient_relative_error']:.2e}")
    return out
