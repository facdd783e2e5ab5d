"""The worlds that conformance tests run on, with states drawn so that bodies touch."""

import functools
from dataclasses import dataclass

import jax.numpy as jnp
import mujoco
import numpy as np

from rtc_mjx.physics import PhysicsState, Surroundings, World, load, rest_state, rest_surroundings

WORLDS = {
    "double_goal": ("double_goal", {}),
    "car": ("driving", {"road_users": 0}),
    "car_2": ("driving", {"road_users": 2}),
    "three_cars": ("driving", {"cars": 3, "road_users": 0}),
    "two_cars_and_user": ("driving", {"cars": 2, "road_users": 1}),
}
TOUCHING = ("car_2", "three_cars", "two_cars_and_user")  # worlds in which something can collide


@functools.cache
def make(name: str) -> World:
    """A world of the table; its solver tolerance is tightened so that C MuJoCo's answer is the converged one."""
    asset, options = WORLDS[name]
    world = load(asset, **options)
    for model in (world.mj, world.free.mj):
        model.opt.tolerance, model.opt.iterations, model.opt.ls_iterations = 1e-14, 200, 100
    return world


@dataclass(frozen=True)
class Inputs:
    """A batch of states, controls and surroundings as numpy arrays."""

    qpos: np.ndarray
    qvel: np.ndarray
    control: np.ndarray
    pose: np.ndarray
    size: np.ndarray

    def arguments(self, world: World, index: int | None = None) -> tuple[PhysicsState, jnp.ndarray, Surroundings]:
        """What `step` takes; of one world of the batch, or of all."""
        pick = (lambda x: jnp.asarray(x)) if index is None else (lambda x: jnp.asarray(x[index]))
        warm = rest_state(world).warmstart.size
        state = PhysicsState(pick(self.qpos), pick(self.qvel), pick(np.zeros((len(self.qpos), warm))))
        return state, pick(self.control), Surroundings(pick(self.pose), pick(self.size))


def draw(world: World, count: int, seed: int = 0, spread: float = 3.0) -> Inputs:
    """Random inputs; `spread` in m is small enough that most worlds with several bodies have contacts."""
    random = np.random.default_rng(seed)
    nv, users, nu = world.mj.nv, len(world.mocap_ids), len(world.control_ids)
    scale = np.tile([spread, spread, 1.5, 0.3], nv // 4) if nv % 4 == 0 else np.ones(nv)
    qpos = random.standard_normal((count, nv)) * scale
    qvel = random.standard_normal((count, nv)) * (np.tile([6, 3, 1, 0.5], nv // 4) if nv % 4 == 0 else 1.0)
    control = random.uniform(-0.5, 0.5, (count, nu))
    pose = random.standard_normal((count, users, 3)) * [spread, spread, 2]
    size = np.broadcast_to(np.asarray(rest_surroundings(world).size), (count, users, 2)) * random.uniform(0.8, 1.2, (count, users, 2))
    return Inputs(qpos, qvel, control, pose, size)


def c_data(world: World, inputs: Inputs, index: int) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """C MuJoCo in the same state, with the same surroundings; the model is a copy with the users' sizes."""
    model = world.mj.__copy__()
    for user in world.users:
        body = world.mocap_ids[user]
        geom = next(g for g in range(model.ngeom) if model.geom_bodyid[g] == body and model.geom_contype[g])
        length, width = inputs.size[index, user]
        model.geom_size[geom] = [min(length, width) / 2, max(length - width, 0) / 2, 0]
        model.geom_rbound[geom] = model.geom_size[geom][:2].sum()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = inputs.qpos[index], inputs.qvel[index]
    data.ctrl[list(world.control_ids)] = inputs.control[index]
    for user, (x, y, heading) in enumerate(inputs.pose[index]):
        data.mocap_pos[user, :2] = x, y
        data.mocap_quat[user] = [np.cos(heading / 2), 0, 0, np.sin(heading / 2)]
    return model, data
