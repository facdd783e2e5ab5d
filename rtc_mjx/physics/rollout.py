"""Rolling one world forward under given controls, differentiably and in little memory."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from rtc_mjx.errors import NonFiniteError, UsageError
from rtc_mjx.physics.contact import SOLUTION
from rtc_mjx.physics.step import PhysicsState, Surroundings, constraint_rows, step
from rtc_mjx.physics.world import World

JUMP = 20.0  # m in a control step: nothing drives that far, it appears or goes
OneStep = Callable[[PhysicsState, Array, Surroundings], PhysicsState]


def simulate(
    world: World,
    state: PhysicsState,
    controls: Float[Array, "steps controls"],
    surroundings: Surroundings,
    *,
    substeps: int = 1,
    one_step: OneStep | None = None,
) -> tuple[PhysicsState, PhysicsState]:
    """Rolls one world forward under given controls, each held for `substeps` physics steps.

    A backward pass keeps the state before each control step and the contact solution of each physics step in one control
    step at a time; the rest is computed again.

    Args:
        world: the world.
        state: the first state.
        controls: one control vector per control step.
        surroundings: mocap bodies; leaves with a leading axis of `steps` are played back, others stand still.
        substeps: physics steps per control step.
        one_step: (state, control, surroundings) -> state, such as `specialised_step(world)`; `step` on this world if None.

    Returns:
        The last state, and the states after each control step (leading axis `steps`).

    Raises:
        NonFiniteError: a concrete input holds NaN or infinity; the error names the field and the index.
        UsageError: the controls do not fit the world.
    """
    check_inputs(world, state, controls, surroundings)
    played = surroundings.pose.ndim == 3
    advance = control_step(world, substeps, one_step or (lambda *inputs: step(world, *inputs)), one_step is None)

    def body(state: PhysicsState, inputs: tuple[Array, Surroundings | None]) -> tuple[PhysicsState, PhysicsState]:
        control, moved = inputs
        state = advance(state, control, surroundings if moved is None else moved)
        return state, state

    return lax.scan(body, state, (controls, surroundings if played else None))


def control_step(world: World, substeps: int, one_step: OneStep, plain: bool = False) -> Callable[..., PhysicsState]:
    """One control step: physics steps under one control, so checkpointed that a backward pass keeps little.

    The function returned takes the state, the control, the surroundings before the step and, where they move, those after it.

    Kept are the state before each control step and, while one control step is gone back through, the contact solutions of its
    physics steps. A specialised step in one piece (no constraint rows, not `plain`) keeps its inputs only as it is.
    """
    advance = one_step
    if plain or constraint_rows(world):
        advance = jax.checkpoint(advance, policy=jax.checkpoint_policies.save_only_these_names(SOLUTION))
    if substeps == 1:
        return lambda state, control, before, after=None: advance(state, control, before)

    def several(state: PhysicsState, control: Array, before: Surroundings, after: Surroundings | None = None) -> PhysicsState:
        return lax.scan(lambda s, share: (advance(s, control, between(before, after, share)), None), state, shares(substeps))[0]

    return jax.checkpoint(several)


def substates(world: World, substeps: int, one_step: OneStep) -> Callable[..., tuple[PhysicsState, Surroundings]]:
    """Like `control_step`, but gives the states before each physics step, and the surroundings that it had."""

    def several(state: PhysicsState, control: Array, before: Surroundings, after: Surroundings) -> tuple[PhysicsState, Surroundings]:
        def body(state: PhysicsState, share: Array) -> tuple[PhysicsState, tuple[PhysicsState, Surroundings]]:
            around = between(before, after, share)
            return one_step(state, control, around), (state, around)

        return lax.scan(body, state, shares(substeps))[1]

    return several


def shares(substeps: int) -> Float[Array, "substeps"]:
    """How much of a control step has passed before each of its physics steps."""
    return jnp.arange(substeps) / substeps


def between(before: Surroundings, after: Surroundings | None, share: Array) -> Surroundings:
    """Surroundings within a control step: bodies move straight on; one that is somewhere else altogether afterwards jumps at the end."""
    if after is None:
        return before
    way = after.pose - before.pose
    jumps = jnp.any(jnp.abs(way[..., :2]) > JUMP, axis=-1, keepdims=True)
    return Surroundings(before.pose + jnp.where(jumps, 0.0, share * way), before.size)


def check_inputs(world: World, state: PhysicsState, controls: Array, surroundings: Surroundings) -> None:
    """Raises before anything is compiled where shapes do not fit the world or a concrete input is not finite."""
    if controls.shape[-1] != len(world.control_ids):
        wanted = f"{len(world.control_ids)} ({', '.join(world.control_names)})"
        raise UsageError(f"controls have {controls.shape[-1]} columns; world '{world.name}' takes {wanted}")
    if surroundings.pose.shape[-2] != len(world.mocap_ids):
        raise UsageError(f"surroundings have {surroundings.pose.shape[-2]} bodies; world '{world.name}' has {len(world.mocap_ids)}")
    named = {"state.qpos": state.qpos, "state.qvel": state.qvel, "state.warmstart": state.warmstart}
    named |= {"controls": controls, "surroundings.pose": surroundings.pose, "surroundings.size": surroundings.size}
    for name, value in named.items():
        if isinstance(value, jax.core.Tracer):
            continue  # inside a compiled program values are not known; what computes them is checked there
        numbers = np.asarray(value)
        bad = np.argwhere(~np.isfinite(numbers))
        if bad.size:
            index = tuple(int(i) for i in bad[0])
            raise NonFiniteError(f"{name}{list(index)} is {numbers[index]} in world '{world.name}'; finite values are needed")
