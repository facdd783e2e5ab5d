"""Worlds: an MJCF file, loaded, checked and given names. The first stage of the data flow.

`load` reads `assets/<name>.xml`, copies its car and its road user as often as asked for, refuses what the differentiable
step does not cover (`check_supported`), and returns a `World`: the compiled model plus the few indices the step needs.
"""

import copy
import functools
import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from jaxtyping import Float
from mujoco import mjx

from rtc_mjx.errors import UnsupportedWorldError, UsageError

MAX_COPIES = 256
RIDE_HEIGHT = 0.75  # m, the height at which vehicle bodies move; all motion is in the plane
COLLIDABLE = (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE)
JOINTS = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)


def double_precision() -> bool:
    """Whether JAX computes in double precision at the call."""
    return jax.dtypes.canonicalize_dtype(np.float64) == np.float64


@dataclass(frozen=True, eq=False)
class Part:
    """One compiled model of a world: the free bodies alone, or with one road user.

    Attributes:
        mj: the compiled model.
        planar: whether all that collides moves in one horizontal plane, with friction equal in all directions.
        user_body: the road user's body, or -1.
        user_geom: its collision capsule, or -1.
        user_rows: numbers of the constraint rows between it and the free bodies.
    """

    mj: mujoco.MjModel
    planar: bool
    user_body: int = -1
    user_geom: int = -1
    user_rows: tuple[int, ...] = ()

    def mjx_model(self) -> mjx.Model:
        """The model on the device, in the precision that JAX is set to at the call."""
        return _mjx_model(self, double_precision())

    def mjx_data(self) -> mjx.Data:
        """A template `mjx.Data`; the step rebuilds everything but the state from it."""
        return _mjx_data(self, double_precision())

    @functools.cached_property
    def rows(self) -> int:
        """Number of constraint rows."""
        return int(self.mjx_data()._impl.efc_J.shape[0])

    @functools.cached_property
    def dense(self) -> "Part":
        """The same with dense matrices, as the solver is handed them."""
        model = copy.copy(self.mj)
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        return Part(model, self.planar)


@dataclass(frozen=True, eq=False)
class World:
    """A compiled world with the parts and indices that the step reads.

    Attributes:
        name: what it was loaded as; error messages use it.
        spec: what it was compiled from; rendering adds to a copy of it.
        mj: the compiled model of everything, for C MuJoCo and for rendering.
        free: what moves by itself, and among itself collides.
        one_user: the same with one replayed road user; None where no mocap body collides.
        control_names: actuators that take a control, in control order; actuators of zero gain (tyres) take none.
        control_ids: their actuator ids.
        mocap_ids: bodies whose pose is given from outside, in mocap order.
        users: which of them collide.
    """

    name: str
    spec: mujoco.MjSpec
    mj: mujoco.MjModel
    free: Part
    one_user: Part | None
    control_names: tuple[str, ...]
    control_ids: tuple[int, ...]
    mocap_ids: tuple[int, ...]
    users: tuple[int, ...]

    @property
    def timestep(self) -> float:
        """Duration of one physics step in s."""
        return float(self.mj.opt.timestep)

    @functools.cached_property
    def fingerprint(self) -> str:
        """Hash of the compiled model: two worlds with the same fingerprint step alike."""
        return model_hash(self.mj)

    @property
    def default_sizes(self) -> Float[np.ndarray, "users 2"]:
        """Length and width in m of each mocap body as the asset gives them; NaN where it collides with nothing."""
        return np.array([_vehicle_size(self.mj, _collision_geom(self.mj, body)) for body in self.mocap_ids]).reshape(-1, 2)

    def joint(self, name: str) -> int:
        """Index of a joint in qpos and in qvel (the same: every joint has one degree of freedom)."""
        return int(self.mj.jnt_qposadr[_named(self, mujoco.mjtObj.mjOBJ_JOINT, name)])

    def site(self, name: str) -> int:
        """Id of a site."""
        return _named(self, mujoco.mjtObj.mjOBJ_SITE, name)

    def body(self, name: str) -> int:
        """Id of a body."""
        return _named(self, mujoco.mjtObj.mjOBJ_BODY, name)

    def control(self, name: str) -> int:
        """Index of an actuator in the control vector."""
        if name not in self.control_names:
            raise UsageError(f"world '{self.name}' has no control '{name}'; it has {', '.join(self.control_names)}")
        return self.control_names.index(name)


def model_hash(model: mujoco.MjModel) -> str:
    """Hash of every number and name in a compiled model, as they are at the call."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()


def place_surroundings(data: Any, pose: Float[np.ndarray, "users 3"]) -> None:
    """Puts the first mocap bodies of C MuJoCo's data at x in m, y in m, heading in rad, as the step does on the device."""
    x, y, heading = pose.T
    users = len(pose)
    data.mocap_pos[:users, 0], data.mocap_pos[:users, 1] = x, y
    data.mocap_quat[:users] = np.stack([np.cos(heading / 2), 0 * x, 0 * x, np.sin(heading / 2)], axis=1)


@functools.lru_cache(maxsize=32)
def _mjx_model(part: Part, x64: bool) -> mjx.Model:
    del x64  # part of the key: the arrays carry a precision
    with jax.ensure_compile_time_eval():
        return mjx.put_model(part.mj, impl="jax")


@functools.lru_cache(maxsize=32)
def _mjx_data(part: Part, x64: bool) -> mjx.Data:
    del x64
    with jax.ensure_compile_time_eval():
        return mjx.make_data(part.mj, impl="jax")


def assets() -> Path:
    """The folder of MJCF files: beside the package in a checkout, inside it in an installed wheel."""
    inside = Path(str(resources.files("rtc_mjx"))) / "assets"
    return inside if inside.is_dir() else Path(__file__).resolve().parents[2] / "assets"


def asset_names() -> tuple[str, ...]:
    """Worlds that `load` accepts by name."""
    return ("double_goal", "driving")


def load(name: str | Path, *, cars: int | None = None, road_users: int | None = None) -> World:
    """Loads a world by asset name ('double_goal', 'driving') or by the path of an MJCF file.

    Args:
        name: an asset's name or a path that ends in .xml.
        cars: how many free cars the world has (worlds with a `car0/` only); the file's own number if None.
        road_users: how many replayed road users it has (worlds with a `user0` only); the file's own number if None.

    Raises:
        UsageError: no such asset, or a number of copies it cannot have.
        UnsupportedWorldError: the model is outside what the differentiable step covers.
    """
    path = Path(name) if str(name).endswith(".xml") else assets() / f"{name}.xml"
    if not path.is_file():
        raise UsageError(f"no world '{name}': {path} is not a file; named worlds are {', '.join(asset_names())}")
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        _copy_cars(spec, path, cars)
        _copy_users(spec, path, road_users)
        return from_spec(spec, name=path.stem)
    except ValueError as error:
        raise error if isinstance(error, UsageError) else UsageError(f"{path}: {' '.join(str(error).split())}") from error


def from_spec(spec: mujoco.MjSpec, *, name: str = "model") -> World:
    """Makes a `World` of a model specification.

    Raises:
        UnsupportedWorldError: something in it is outside what the differentiable step covers.
    """
    model = spec.compile()
    check_supported(model, name)
    mocap = sorted((int(model.body_mocapid[b]), b) for b in range(model.nbody) if model.body_mocapid[b] >= 0)
    users = tuple(i for i, b in mocap if _collision_geom(model, b) >= 0)
    bodies = [model.body(mocap[i][1]).name for i in users]
    _check_alike(model, [_collision_geom(model, mocap[i][1]) for i in users], name)
    control_ids = tuple(int(i) for i in range(model.nu) if np.any(model.actuator_gainprm[i]))
    return World(
        name=name,
        spec=spec,
        mj=model,
        free=_free_part(spec, bodies),
        one_user=_one_user_part(spec, bodies) if bodies else None,
        control_names=tuple(model.actuator(i).name for i in control_ids),
        control_ids=control_ids,
        mocap_ids=tuple(b for _, b in mocap),
        users=users,
    )


def _without(spec: mujoco.MjSpec, bodies: Sequence[str]) -> mujoco.MjModel:
    spec = spec.copy()
    for body in bodies:
        spec.delete(spec.body(body))
    return spec.compile()


def _free_part(spec: mujoco.MjSpec, users: Sequence[str]) -> Part:
    model = _without(spec, users) if users else spec.compile()
    return Part(model, _is_planar(model))


def _one_user_part(spec: mujoco.MjSpec, users: Sequence[str]) -> Part:
    model = _without(spec, users[1:])
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, users[0])
    geom = _collision_geom(model, body)
    with jax.ensure_compile_time_eval():  # a world may be asked for first while a program is traced
        device = mjx.put_model(model, impl="jax")
        contacts = jax.jit(lambda data: mjx.collision(device, data)._impl.contact)(mjx.make_data(model, impl="jax"))
    rows = [
        int(first) + k
        for first, dim, pair in zip(*(np.asarray(x) for x in (contacts.efc_address, contacts.dim, contacts.geom)), strict=True)
        if geom in pair
        for k in range(1 if dim == 1 else 2 * (int(dim) - 1))
    ]
    return Part(model, _is_planar(model), body, geom, tuple(rows))


def _check_alike(model: mujoco.MjModel, geoms: Sequence[int], name: str) -> None:
    fields = ("friction", "solref", "solimp", "condim", "margin", "gap", "contype", "conaffinity", "pos", "quat", "priority", "solmix")
    for field in fields:
        values = getattr(model, f"geom_{field}")[list(geoms)]
        if len(geoms) and not np.all(values == values[0]):
            raise UnsupportedWorldError(f"world '{name}': colliding mocap bodies differ in {field}; only their sizes may differ")


def check_supported(model: mujoco.MjModel, name: str) -> None:
    """Raises `UnsupportedWorldError`, naming every element outside what the exact derivative and the tests cover."""
    bad = [
        *(["cone: elliptic friction cones; pyramidal is covered"] if model.opt.cone != mujoco.mjtCone.mjCONE_PYRAMIDAL else []),
        *_integrator(model),
        *_elements(model, mujoco.mjtObj.mjOBJ_JOINT, ~np.isin(model.jnt_type, JOINTS), "ball or free joint"),
        *_elements(model, mujoco.mjtObj.mjOBJ_JOINT, model.dof_frictionloss[model.jnt_dofadr] > 0, "joint with friction loss"),
        *_elements(model, mujoco.mjtObj.mjOBJ_JOINT, model.jnt_actfrclimited > 0, "joint with actuator force limit"),
        *_elements(model, mujoco.mjtObj.mjOBJ_EQUALITY, np.ones(model.neq, bool), "equality constraint"),
        *_elements(model, mujoco.mjtObj.mjOBJ_TENDON, np.ones(model.ntendon, bool), "tendon"),
        *_elements(model, mujoco.mjtObj.mjOBJ_FLEX, np.ones(model.nflex, bool), "flex"),
        *_elements(model, mujoco.mjtObj.mjOBJ_GEOM, _uncovered_geoms(model), "colliding geom that is neither sphere nor capsule"),
        *_elements(
            model,
            mujoco.mjtObj.mjOBJ_ACTUATOR,
            _uncovered_actuators(model),
            "actuator with state or of a muscle, user or servo-to-site kind",
        ),
        *(
            [f"fluid forces (density {model.opt.density}, viscosity {model.opt.viscosity})"]
            if model.opt.density or model.opt.viscosity
            else []
        ),
    ]
    if bad:
        raise UnsupportedWorldError(f"world '{name}' is outside what the differentiable step covers: {'; '.join(bad)}")


def _integrator(model: mujoco.MjModel) -> list[str]:
    names = {mujoco.mjtIntegrator.mjINT_EULER: "Euler", mujoco.mjtIntegrator.mjINT_IMPLICITFAST: "implicitfast"}
    if model.opt.integrator in names:
        return []
    return [f"integrator {mujoco.mjtIntegrator(model.opt.integrator).name}; {' and '.join(names.values())} are covered"]


def _elements(model: mujoco.MjModel, kind: mujoco.mjtObj, mask: np.ndarray, what: str) -> list[str]:
    names = [mujoco.mj_id2name(model, kind, int(i)) or f"#{i}" for i in np.flatnonzero(mask)]
    return [f"{what}: {', '.join(names)}"] if names else []


def _uncovered_geoms(model: mujoco.MjModel) -> np.ndarray:
    return ((model.geom_contype | model.geom_conaffinity) != 0) & ~np.isin(model.geom_type, COLLIDABLE)


def _uncovered_actuators(model: mujoco.MjModel) -> np.ndarray:
    gains = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE)
    biases = (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)
    site = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_SITE) & (model.actuator_trnid[:, 1] >= 0)
    stateless = model.actuator_dyntype == mujoco.mjtDyn.mjDYN_NONE
    return ~stateless | ~np.isin(model.actuator_gaintype, gains) | ~np.isin(model.actuator_biastype, biases) | site


def _is_planar(model: mujoco.MjModel) -> bool:
    axes = model.jnt_axis[:, 2]
    flat = np.where(model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE, axes == 0, np.abs(axes) == 1)
    colliding = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    upright = np.all(data.xmat.reshape(-1, 3, 3)[:, 2, 2] > 1 - 1e-12)
    level = np.ptp(data.geom_xpos[colliding, 2]) < 1e-12 if colliding.size else True
    lying = np.abs(data.geom_xmat.reshape(-1, 3, 3)[colliding, 2, 2]) < 1e-12  # a capsule's axis is its z
    sphere = model.geom_type[colliding] == mujoco.mjtGeom.mjGEOM_SPHERE
    one_friction = np.all(np.isin(model.geom_condim[colliding], (1, 3))) and model.npair == 0
    return bool(np.all(flat) and upright and level and np.all(lying | sphere) and one_friction)


def _named(world: World, kind: mujoco.mjtObj, name: str) -> int:
    found = mujoco.mj_name2id(world.mj, kind, name)
    if found < 0:
        label = mujoco.mju_type2Str(kind)
        count = {"joint": world.mj.njnt, "site": world.mj.nsite, "body": world.mj.nbody}[label]
        known = [mujoco.mj_id2name(world.mj, kind, i) or f"#{i}" for i in range(count)]
        raise UsageError(f"world '{world.name}' has no {label} '{name}'; it has {', '.join(known)}")
    return int(found)


def _collision_geom(model: mujoco.MjModel, body: int) -> int:
    first, count = int(model.body_geomadr[body]), int(model.body_geomnum[body])
    found = [g for g in range(first, first + count) if model.geom_contype[g] | model.geom_conaffinity[g]]
    if len(found) > 1 or any(model.geom_type[g] != mujoco.mjtGeom.mjGEOM_CAPSULE for g in found):
        raise UnsupportedWorldError(f"mocap body '{model.body(body).name}' needs exactly one colliding geom, a capsule, or none")
    return found[0] if found else -1


def _vehicle_size(model: mujoco.MjModel, geom: int) -> tuple[float, float]:
    radius, half = model.geom_size[geom][:2] if geom >= 0 else (math.nan, math.nan)
    return 2 * float(radius + half), 2 * float(radius)


def _copies(spec: mujoco.MjSpec, path: Path, option: str, wanted: int | None, first: str, minimum: int) -> range:
    if wanted is None:
        return range(0)
    if spec.body(first) is None:
        raise UsageError(f"{path}: {option}={wanted} given, but the world has no body '{first}' to copy")
    if not minimum <= wanted <= MAX_COPIES:
        raise UsageError(f"{option}={wanted} is not between {minimum} and {MAX_COPIES}")
    return range(1, wanted)


def _copy_cars(spec: mujoco.MjSpec, path: Path, cars: int | None) -> None:
    for index in _copies(spec, path, "cars", cars, "car0/chassis", 1):
        car = mujoco.MjSpec.from_file(str(path.parent / "car.xml"))
        spec.attach(car, prefix=f"car{index}/", frame=spec.worldbody.add_frame(pos=[0, 0, RIDE_HEIGHT]))


def _copy_users(spec: mujoco.MjSpec, path: Path, road_users: int | None) -> None:
    copies = _copies(spec, path, "road_users", road_users, "user0", 0)
    original = spec.body("user0")
    for index in copies:
        body = spec.worldbody.add_body(name=f"user{index}", mocap=True, pos=original.pos)
        for geom in original.geoms:
            body.add_geom(
                name=geom.name.replace("user0", f"user{index}"), type=geom.type, size=geom.size, quat=geom.quat,
                friction=geom.friction, rgba=geom.rgba, group=geom.group, material=geom.material,
                contype=geom.contype, conaffinity=geom.conaffinity,
            )  # fmt: skip
    if road_users == 0:
        spec.delete(original)
