"""The car drives like one: closed forms of straight running, cornering, sliding and braking."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from worlds import make

from rtc_mjx.physics import PhysicsState, assets, rest_state, rest_surroundings, simulate
from rtc_mjx.physics.car import WHEELBASE

pytestmark = pytest.mark.usefixtures("x64")
MASS, FRICTION, GRAVITY = 1500.0, 0.9, 9.81  # of assets/car.xml


def drive(speed, acceleration, steer, steps):
    """States of the car under constant controls."""
    world = make("car")
    state = rest_state(world)
    state = PhysicsState(state.qpos, state.qvel.at[0].set(speed), state.warmstart)
    controls = jnp.tile(jnp.array([acceleration, steer]), (steps, 1))
    return jax.jit(lambda s, u: simulate(world, s, u, rest_surroundings(world))[1])(state, controls)


def test_the_wheelbase_is_that_of_the_asset():
    car = mujoco.MjModel.from_xml_path(str(assets() / "car.xml"))
    data = mujoco.MjData(car)
    mujoco.mj_kinematics(car, data)
    assert np.isclose(data.site("front_axle").xpos[0] - data.site("rear_axle").xpos[0], WHEELBASE)


def test_it_runs_straight_without_drift():
    run = drive(15.0, 0.0, 0.0, 200)
    assert np.allclose(run.qpos[-1], [15.0 * 200 * 0.05, 0, 0, 0], atol=1e-9)


def test_full_throttle_accelerates_by_its_limit():
    run = drive(0.0, 10.0, 0.0, 40)  # clamped to 4 m/s^2
    assert np.isclose(run.qvel[-1, 0], 4.0 * 40 * 0.05, rtol=1e-6)


@pytest.mark.parametrize("steer", [0.05, 0.1, 0.2, -0.2])
def test_steady_turning_radius_is_that_of_the_bicycle(steer):
    world = make("car")
    state = rest_state(world)
    state = PhysicsState(state.qpos, state.qvel.at[0].set(5.0), state.warmstart)
    step_on = jax.jit(lambda s, u: simulate(world, s, u, rest_surroundings(world))[1])
    run = step_on(state, jnp.tile(jnp.array([0.0, steer]), (60, 1)))
    speed, rate = np.hypot(run.qvel[:, 0], run.qvel[:, 1]), run.qvel[:, 2]
    radius = speed[-1] / rate[-1]
    assert abs(radius - WHEELBASE / np.tan(steer)) < 0.1 * abs(WHEELBASE / np.tan(steer))


def test_beyond_the_friction_limit_it_understeers():
    run = drive(20.0, 0.0, 0.25, 30)
    speed, rate = np.hypot(run.qvel[:, 0], run.qvel[:, 1]), np.asarray(run.qvel[:, 2])
    kinematic = WHEELBASE / np.tan(0.25)  # 11 m: would need v^2 / R = 36 m/s^2
    assert speed[-1] / rate[-1] > 1.5 * kinematic
    sideways = np.diff(run.qvel[:, :2], axis=0)[5:] / 0.05
    assert np.max(np.hypot(*sideways.T)) < 1.1 * FRICTION * GRAVITY


def test_a_car_thrown_sideways_slides_to_a_stop_by_friction():
    world = make("car")
    state = rest_state(world)
    state = PhysicsState(state.qpos, state.qvel.at[1].set(5.0), state.warmstart)
    run = simulate(world, state, jnp.zeros((60, 2)), rest_surroundings(world))[1]
    grip = (6621.75 + 6290.66) / MASS  # both axles at their limit
    assert abs(run.qpos[-1, 1] - 25.0 / (2 * grip)) < 0.2 * 25.0 / (2 * grip)
    heading = run.qpos[-1, 2]
    across = run.qvel[-1, 1] * np.cos(heading) - run.qvel[-1, 0] * np.sin(heading)
    assert abs(across) < 0.02  # it may roll on along its wheels


@pytest.mark.parametrize("speed", [10.0, 20.0])
def test_full_braking_takes_the_distance_friction_allows(speed):
    run = drive(speed, -20.0, 0.0, 100)
    stop = int(np.argmax(np.asarray(run.qvel[:, 0]) <= 0))
    assert stop > 0
    assert abs(run.qpos[stop, 0] - speed**2 / (2 * FRICTION * GRAVITY)) < 0.1 * speed**2 / (2 * FRICTION * GRAVITY)
