"""Derivatives in double precision against central differences, on random states of every world and in corner cases."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from worlds import TOUCHING, WORLDS, draw, make

from rtc_mjx import pile_up
from rtc_mjx.physics import (
    PhysicsState,
    Surroundings,
    contact,
    contact_problem,
    load,
    rest_state,
    rest_surroundings,
    simulate,
    specialised_step,
    step,
)

pytestmark = pytest.mark.usefixtures("x64")
STATES = 100
VARIANTS = {"plain": lambda world: lambda *x: step(world, *x), "specialised": specialised_step}


def scalar_of(world, one_step):
    """A step as a function of all it can be differentiated by, reduced to one number."""
    weight = jnp.cos(1.0 + jnp.arange(2 * world.mj.nv))

    def value(flat, control, around, warm):
        qpos, qvel = jnp.split(flat, 2)
        after = one_step(PhysicsState(qpos, qvel, warm), control, around)
        return weight @ jnp.concatenate([after.qpos, after.qvel])

    return value


def active_rows(world, *arguments):
    """Which rows the solution pushes with, as bits: where they differ within a difference's step, there is a kink."""
    problem = contact_problem(world, *arguments)
    solution = contact.newton(problem, contact.solve(problem.mass, problem.force))[0]
    return (contact.violation(problem, solution) < 0) & (jnp.sum(jnp.abs(problem.rows.jacobian), axis=1) > 0)


@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_gradient_equals_central_differences(name, variant):
    world = make(name)
    value = scalar_of(world, VARIANTS[variant](world))
    inputs = draw(world, STATES, seed=11)
    inputs.qvel[:5] = 0  # at v = 0
    state, control, around = inputs.arguments(world)
    flat = jnp.concatenate([state.qpos, state.qvel], axis=1)
    parts = (flat, control, around.pose)

    def batched(flat, control, pose):
        return jax.vmap(value)(flat, control, Surroundings(pose, around.size), state.warmstart)

    random, evaluate = np.random.default_rng(0), jax.jit(batched)
    directions = [jnp.asarray(random.standard_normal(x.shape)) for x in parts]
    if variant == "specialised":
        gradients = jax.jit(jax.grad(lambda *x: jnp.sum(batched(*x)), argnums=(0, 1, 2)))(*parts)
        analytic = sum(jnp.sum((g * d).reshape(STATES, -1), axis=1) for g, d in zip(gradients, directions, strict=True))
    else:  # forward mode compiles in a tenth of the time; reverse mode of the plain step is tested in the pile-up
        analytic = jax.jit(lambda *x: jax.jvp(batched, x, tuple(directions))[1])(*parts)

    def difference(h):
        up, down = (evaluate(*(x + s * h * d for x, d in zip(parts, directions, strict=True))) for s in (1, -1))
        return np.asarray((up - down) / (2 * h))

    rows = jax.jit(jax.vmap(lambda f, u, p, z, w: active_rows(world, PhysicsState(*jnp.split(f, 2), w), u, Surroundings(p, z))))
    smooth, touched = np.ones(STATES, bool), np.zeros(STATES, bool)
    if name in TOUCHING:
        here, *there = (
            rows(*(x + s * 4e-6 * d for x, d in zip(parts, directions, strict=True)), around.size, state.warmstart) for s in (0, 1, -1)
        )
        smooth = np.all([np.all(here == t, axis=1) for t in there], axis=0)
        touched = np.any(here, axis=1)
        assert np.mean(touched) >= 0.5
        assert np.mean(smooth) > 0.9
    coarse, fine = difference(4e-6), difference(2e-6)
    best = (4 * fine - coarse) / 3  # Richardson: the differences' own error is fourth order
    error = np.abs(np.asarray(analytic) - best) / np.maximum(np.abs(best), 1.0)
    limited = np.asarray(error > 1e-5)
    assert np.max(np.where(smooth, error, 0)) <= 1e-5, f"{np.sum(limited & smooth)} states of {STATES}"
    assert np.all(np.isfinite(analytic))


CORNERS = {
    "rest": (30.0, 0.0, 0.0),
    "touching": (0.0, 1.9, 0.0),
    "same place": (0.0, 0.0, 0.0),
    "parallel": (0.5, 1.8, 0.0),
    "end to end": (4.6, 0.0, 0.0),
    "crossed": (0.0, 0.0, np.pi / 2),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_gradients_are_finite_in_corner_cases(variant):
    """At rest, exactly touching, on top of each other: reverse mode of the plain step too, where zero norms bite."""
    world = make("car_2")
    gradient = jax.jit(jax.grad(scalar_of(world, VARIANTS[variant](world)), argnums=(0, 1, 2)))
    for case, pose in CORNERS.items():
        around = Surroundings(jnp.array([pose, (60.0, 0.0, 0.0)]), rest_surroundings(world).size)
        found = gradient(jnp.zeros(8), jnp.zeros(2), around, jnp.zeros(4))
        assert all(np.all(np.isfinite(g)) for g in jax.tree.leaves(found)), case


def test_pile_up_is_right_where_one_iteration_is_not():
    errors = pile_up.compare()
    assert errors["ours"]["trajectory_error_m"] < 1e-6
    assert errors["ours"]["gradient_relative_error"] <= 1e-4
    assert errors["native_1_iteration"]["trajectory_error_m"] > 1e-2
    assert errors["native_1_iteration"]["gradient_relative_error"] > 1e-2


@pytest.mark.parametrize("name", ["double_goal", "car", "car_2"])
def test_memory_of_a_backward_pass_grows_by_little_more_than_the_state(name):
    """At most four times the state's size per control step, at six physics steps each."""
    world = make(name)
    one_step = specialised_step(world)
    around = rest_surroundings(world)

    def temporary(steps):
        def loss(controls, state):
            return jnp.sum(simulate(world, state, controls, around, substeps=6, one_step=one_step)[0].qpos)

        batch = 64
        state = jax.tree.map(lambda x: jnp.tile(x, (batch, 1)), rest_state(world))
        controls = jnp.zeros((batch, steps, len(world.control_ids)))
        compiled = jax.jit(jax.vmap(jax.grad(loss))).lower(controls, state).compile()
        return compiled.memory_analysis().temp_size_in_bytes / batch

    size = sum(x.nbytes for x in jax.tree.leaves(rest_state(world)))
    assert (temporary(200) - temporary(100)) / 100 <= 4 * size


def test_derivatives_by_sizes_and_initial_state_flow_through_a_rollout():
    world = load("driving", road_users=1)
    around = Surroundings(jnp.array([[6.0, 0.2, 0.1]]), jnp.array([[4.6, 1.9]]))
    state, one_step = rest_state(world), specialised_step(world)

    @jax.jit
    def end(speed, size):
        moving = PhysicsState(state.qpos, state.qvel.at[0].set(speed), state.warmstart)
        return simulate(world, moving, jnp.zeros((20, 2)), Surroundings(around.pose, size), one_step=one_step)[0].qpos[0]

    by_speed, by_size = jax.grad(end, argnums=(0, 1))(10.0, around.size)
    h = 1e-6
    assert np.isclose(by_speed, (end(10 + h, around.size) - end(10 - h, around.size)) / (2 * h), rtol=1e-4)
    longer, shorter = (end(10.0, around.size.at[0, 0].add(s * h)) for s in (1, -1))
    assert np.isclose(by_size[0, 0], (longer - shorter) / (2 * h), rtol=1e-4)
    assert by_size[0, 0] != 0
