"""The step against C MuJoCo and against `mjx.step`, on every world."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from worlds import TOUCHING, WORLDS, c_data, draw, make

from rtc_mjx.errors import NonFiniteError, UsageError
from rtc_mjx.physics import PhysicsState, contact, contact_problem, load, rest_state, rest_surroundings, simulate, specialised_step, step

pytestmark = pytest.mark.usefixtures("x64")


def c_trajectory(world, inputs, index, controls):
    """Positions and velocities of C MuJoCo, and how many contacts it saw."""
    model, data = c_data(world, inputs, index)
    states, contacts = [], 0
    for control in controls:
        data.ctrl[list(world.control_ids)] = control
        mujoco.mj_step(model, data)
        states.append(np.r_[data.qpos, data.qvel])
        contacts += data.ncon
    return np.array(states), contacts


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("solver", ["newton", "mjx"])
def test_trajectory_matches_c_mujoco(name, solver):
    world = make(name)
    inputs = draw(world, 3, seed=1, gap=(0.3, 1.5))
    controls = np.random.default_rng(2).uniform(-1, 1, (200, len(world.control_ids)))
    seen = 0
    run = jax.jit(lambda s, u, a: simulate(world, s, u, a, one_step=lambda *x: step(world, *x, solver=solver))[1])
    for index in range(3):
        state, _, around = inputs.arguments(world, index)
        ours = run(state, jnp.asarray(controls), around)
        truth, contacts = c_trajectory(world, inputs, index, controls)
        seen += contacts
        # MJX adds 1e-6 to a denominator when it looks for the closest points of two capsules; cars that touch feel it
        assert np.max(np.abs(np.c_[ours.qpos, ours.qvel] - truth)) < (1e-6 if name in TOUCHING else 1e-9)
    assert seen > 0 or name not in TOUCHING


@pytest.mark.parametrize("name", WORLDS)
def test_step_equals_mjx_step_where_no_actuator_is_clamped(name):
    world = make(name)
    inputs = draw(world, 1, seed=3)
    model, data = c_data(world, inputs, 0)
    data.qvel[:] *= 0.02  # slow: the tyres stay below their limits
    state, control, around = inputs.arguments(world, 0)
    state = PhysicsState(state.qpos, jnp.asarray(data.qvel), state.warmstart)
    native = jax.jit(mjx.step)(mjx.put_model(model, impl="jax"), mjx.put_data(model, data, impl="jax"))
    ours = jax.jit(lambda *x: step(world, *x))(state, control, around)
    assert np.allclose(ours.qpos, native.qpos, rtol=0, atol=1e-9)
    assert np.allclose(ours.qvel, native.qvel, rtol=0, atol=1e-8)


def test_a_sliding_car_stops_where_c_mujoco_stops_it_and_not_where_mjx_does():
    world = make("car")
    state = rest_state(world)
    state = PhysicsState(state.qpos, state.qvel.at[1].set(5.0), state.warmstart)
    controls = jnp.zeros((60, 2))
    ours = simulate(world, state, controls, rest_surroundings(world))[1]
    data = mujoco.MjData(world.mj)
    data.qvel[1] = 5.0
    truth = []
    for _ in range(60):
        mujoco.mj_step(world.mj, data)
        truth.append(data.qpos.copy())
    assert np.allclose(ours.qpos, truth, rtol=0, atol=1e-9)
    model = mjx.put_model(world.mj, impl="jax")
    native = mjx.make_data(world.mj, impl="jax").replace(qvel=state.qvel)
    native = jax.jit(lambda d: jax.lax.scan(lambda d, _: (mjx.step(model, d), None), d, length=60)[0])(native)
    assert native.qpos[1] > 1.2 * truth[-1][1]  # the reason for our own integrator; drop it once MJX agrees with C


@pytest.mark.parametrize("name", TOUCHING)
def test_newton_reaches_the_solution_that_mjx_converges_to(name):
    world = make(name)
    inputs = draw(world, 200, seed=4)
    problems = jax.jit(jax.vmap(lambda *x: contact_problem(world, *x)))(*inputs.arguments(world))
    solutions, converged = jax.jit(jax.vmap(lambda p: contact.newton(p, contact.solve(p.mass, p.force))))(problems)
    assert converged.all()
    assert np.max(jax.vmap(contact.relative_residual)(problems, solutions)) < 1e-9
    ours, native = (jax.jit(jax.vmap(lambda *x, s=s: step(world, *x, solver=s)))(*inputs.arguments(world)) for s in ("newton", "mjx"))
    assert np.allclose(ours.warmstart, native.warmstart, rtol=1e-6, atol=1e-5)
    assert np.mean(np.asarray(contact.violation(jax.tree.map(lambda x: x[0], problems), solutions[0])) <= 0) == 1


def test_newton_converges_in_single_precision_too():
    with jax.enable_x64(False):
        world = load("driving", cars=2, road_users=2)
        inputs = draw(world, 300, seed=5)
        arguments = jax.tree.map(lambda x: x.astype(jnp.float32), inputs.arguments(world))
        problems = jax.jit(jax.vmap(lambda *x: contact_problem(world, *x)))(*arguments)
        solutions, converged = jax.jit(jax.vmap(lambda p: contact.newton(p, contact.solve(p.mass, p.force))))(problems)
        assert converged.all()
        exact = jax.vmap(contact.exact)(problems, solutions)
        assert np.max(jax.vmap(contact.relative_residual)(problems, exact)) < 1e-3


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("wide", [True, False])
def test_specialised_step_equals_the_plain_one(name, wide):
    with jax.enable_x64(wide):
        world = make(name)
        inputs = draw(world, 64, seed=6)
        arguments = jax.tree.map(lambda x: x.astype(jnp.zeros(()).dtype), inputs.arguments(world))
        plain, fast = (jax.jit(jax.vmap(f))(*arguments) for f in (lambda *x: step(world, *x), specialised_step(world)))
        tolerance = 1e-9 if wide else 2e-4
        for a, b in zip(jax.tree.leaves(plain), jax.tree.leaves(fast), strict=True):
            assert np.allclose(a, b, rtol=tolerance, atol=tolerance * (1 + np.max(np.abs(a), initial=0)))


def test_smaller_road_users_are_touched_later():
    world = make("car_2")
    state, control, around = draw(world, 1, seed=7).arguments(world, 0)
    state = PhysicsState(jnp.zeros(4), jnp.zeros(4).at[0].set(10.0), state.warmstart)
    pose = jnp.array([[4.5, 0.0, 0.0], [100.0, 0.0, 0.0]])
    speed = jax.jit(lambda around: step(world, state, control * 0, around).qvel[0])
    for length, hit in ((4.6, True), (1.9, False)):
        assert bool(speed(type(around)(pose, jnp.array([[length, 1.9]] * 2))) < 9.5) == hit


@pytest.mark.parametrize("field", ["qpos", "qvel", "controls", "pose"])
def test_non_finite_inputs_are_named_before_anything_runs(field):
    world = make("car_2")
    state, control, around = draw(world, 1).arguments(world, 0)
    broken = {"qpos": state.qpos, "qvel": state.qvel, "controls": jnp.tile(control, (3, 1)), "pose": around.pose}
    broken[field] = broken[field].at[(0,) * broken[field].ndim].set(jnp.nan)
    state = PhysicsState(broken["qpos"], broken["qvel"], state.warmstart)
    with pytest.raises(NonFiniteError, match=rf"{field}\[0.*nan"):
        simulate(world, state, broken["controls"], type(around)(broken["pose"], around.size))


def test_controls_and_surroundings_that_do_not_fit_are_refused():
    world = make("car_2")
    state, _, around = draw(world, 1).arguments(world, 0)
    with pytest.raises(UsageError, match="3 columns.*car0/drive, car0/steer"):
        simulate(world, state, jnp.zeros((5, 3)), around)
    with pytest.raises(UsageError, match="1 bodies.*has 2"):
        simulate(world, state, jnp.zeros((5, 2)), type(around)(around.pose[:1], around.size[:1]))


def test_played_back_surroundings_move():
    world = make("car_2")
    state, _, around = draw(world, 1).arguments(world, 0)
    state = PhysicsState(jnp.zeros(4), jnp.zeros(4), state.warmstart)
    path = jnp.zeros((20, 2, 3)).at[:, 0, 0].set(jnp.linspace(-6.0, -3.0, 20)).at[:, 1, 0].set(50.0)
    played = type(around)(path, jnp.tile(jnp.array([4.6, 1.9]), (20, 2, 1)))
    last, _ = simulate(world, state, jnp.zeros((20, 2)), played)
    assert last.qpos[0] > 0.5  # pushed from behind by a body that was not there at first
