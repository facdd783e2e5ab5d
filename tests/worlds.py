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


def draw(world: World, count: int, seed: int = 0, gap: tuple[float, float] = (-0.25, 0.15), speed: float = 6.0) -> Inputs:
    """Random inputs in which bodies nearly touch.

    Cars and road users stand around the first car at random bearings and headings, `gap` metres off (negative: pressed
    in). Deeper overlaps, with axes crossing, do not happen on a road, and MJX and C differ there by design of MJX.
    """
    random = np.random.default_rng(seed)
    nv, users, nu = world.mj.nv, len(world.mocap_ids), len(world.control_ids)
    control = random.uniform(-0.5, 0.5, (count, nu))
    size = np.broadcast_to(np.asarray(rest_surroundings(world).size), (count, users, 2)) * random.uniform(0.8, 1.2, (count, users, 2))
    if nv % 4:
        pose = random.standard_normal((count, users, 3))
        return Inputs(random.standard_normal((count, nv)), random.standard_normal((count, nv)), control, pose, size)
    cars = nv // 4
    qpos, pose = np.zeros((count, cars, 4)), np.zeros((count, users, 3))
    qpos[..., 2], qpos[..., 3] = random.uniform(-3, 3, (count, cars)), random.uniform(-0.4, 0.4, (count, cars))
    qpos[:, 0, :2] = random.standard_normal((count, 2))
    for i in range(count):
        others = [(qpos[i, k], np.array([4.6, 1.9])) for k in range(1, cars)] + [(pose[i, k], size[i, k]) for k in range(users)]
        first = random.uniform(-np.pi, np.pi)
        for k, (where, extent) in enumerate(others):
            where[2] = random.uniform(-3, 3)
            bearing = first + 2 * np.pi * k / max(len(others), 1) + random.uniform(-0.3, 0.3)
            where[:2] = beside(qpos[i, 0, :3], where[2], extent, bearing, random.uniform(*gap))
    qvel = random.standard_normal((count, cars, 4)) * [speed, speed / 2, 1, 0.5]
    return Inputs(qpos.reshape(count, nv), qvel.reshape(count, nv), control, pose, size)


def beside(car: np.ndarray, heading: float, size: np.ndarray, bearing: float, gap: float) -> np.ndarray:
    """Where a vehicle stands that is `gap` from the car in the direction of `bearing`; found by bisection."""
    toward, near, far = np.array([np.cos(bearing), np.sin(bearing)]), 0.0, 20.0
    own = axis(car[:2], car[2], np.array([4.6, 1.9]))
    for _ in range(60):
        middle = (near + far) / 2
        other = axis(car[:2] + middle * toward, heading, size)
        clear = distance(own, other) - 0.95 - min(size) / 2
        near, far = (middle, far) if clear < gap else (near, middle)
    return car[:2] + far * toward


def axis(centre: np.ndarray, heading: float, size: np.ndarray) -> np.ndarray:
    """End points of a capsule's axis."""
    half = max(size[0] - size[1], 0) / 2 * np.array([np.cos(heading), np.sin(heading)])
    return np.array([centre - half, centre + half])


def distance(one: np.ndarray, two: np.ndarray) -> float:
    """Between two segments in the plane; 0 where they cross."""

    def side(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    def to_point(segment: np.ndarray, point: np.ndarray) -> float:
        along = segment[1] - segment[0]
        share = np.clip((point - segment[0]) @ along / max(along @ along, 1e-12), 0, 1)
        return float(np.linalg.norm(segment[0] + share * along - point))

    if side(*one, two[0]) * side(*one, two[1]) < 0 and side(*two, one[0]) * side(*two, one[1]) < 0:
        return 0.0
    return min([to_point(one, p) for p in two] + [to_point(two, p) for p in one])


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
