"""Worlds written in MJCF, stepped by MuJoCo MJX and differentiated exactly, contacts included."""

from rtc_mjx.physics.contact import SOLUTION
from rtc_mjx.physics.fast import specialised_step
from rtc_mjx.physics.rollout import OneStep, check_inputs, control_step, simulate, substates
from rtc_mjx.physics.step import (
    PhysicsState,
    Surroundings,
    constraint_rows,
    contact_problem,
    rest_state,
    rest_surroundings,
    step,
)
from rtc_mjx.physics.world import World, asset_names, assets, from_spec, load, place_surroundings

__all__ = [
    "SOLUTION", "OneStep", "PhysicsState", "Surroundings", "World", "asset_names", "assets", "check_inputs", "constraint_rows",
    "contact_problem", "control_step", "from_spec", "load", "place_surroundings", "rest_state", "rest_surroundings", "simulate",
    "specialised_step", "step", "substates",
]  # fmt: skip
