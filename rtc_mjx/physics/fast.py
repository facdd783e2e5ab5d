"""The step of one world, specialised stage by stage: the same values and derivatives, many times faster.

The stages are those of `rtc_mjx.physics.step`. Each is folded to scalar arithmetic by `rtc_mjx.specialise`; the rows of a road user
are one small program run for all users and worlds at once. What a stage knows to be constant or equal (the zeros of a planar
world, the two pyramid edges along z) is handed to the next as such, not as data.
"""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array

from rtc_mjx.physics import contact
from rtc_mjx.physics.rollout import OneStep
from rtc_mjx.physics.step import (
    Dynamics,
    PhysicsState,
    Surroundings,
    assemble,
    constraint_rows,
    dynamics,
    finish,
    one_user_rows,
    rest_state,
    rest_surroundings,
    step,
)
from rtc_mjx.physics.world import Part, World, double_precision
from rtc_mjx.specialise import Mode, compress, specialise


def specialised_step(world: World, mode: Mode | None = None) -> OneStep:
    """Returns `step` of this world, specialised: (state, control, surroundings) -> state.

    Args:
        world: the world; tracing it takes a few seconds.
        mode: how to emit (`rtc_mjx.specialise.specialise`); None for what suits the device.

    Returns:
        A function to vmap over worlds, scan over time and differentiate in reverse mode. Inside `jax.checkpoint` with a policy
        that keeps `contact.SOLUTION`, a backward pass does not solve the contact problem again (`simulate` does this).
    """
    return _specialised_step(world, mode, double_precision())


@functools.lru_cache(maxsize=16)
def _specialised_step(world: World, mode: Mode | None, x64: bool) -> OneStep:
    del x64  # part of the key: programs are folded in one precision
    state, control = rest_state(world), jnp.zeros(len(world.control_ids))
    if not constraint_rows(world):
        whole = specialise(lambda s, c: step(world, s, c, rest_surroundings(world)), state, control, mode=mode)
        return lambda s, c, _: whole(s, c)
    terms, as_terms = compress(lambda s, c: dynamics(world, s, c), state, control, mode=mode)
    packed = jax.eval_shape(terms, state, control)
    as_rows, users = _rows_stage(world, state, mode)

    def problem(terms_vector: Array, rows_vectors: Array) -> tuple[Dynamics, contact.ContactProblem]:
        parts = [as_rows(rows_vectors[i]) for i in range(len(world.users))] or [_no_rows(world)]
        stacked = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
        return as_terms(terms_vector), assemble(as_terms(terms_vector), stacked)

    def newton_step(start: Array, terms_vector: Array, rows_vectors: Array) -> tuple[Array, Array]:
        return contact.newton_step(problem(terms_vector, rows_vectors)[1], start)

    def conclude(s: PhysicsState, terms_vector: Array, rows_vectors: Array, solution: Array) -> PhysicsState:
        return finish(world, s, *problem(terms_vector, rows_vectors), solution)

    row_shapes = jax.eval_shape(users, state, rest_surroundings(world))
    advance = specialise(newton_step, state.warmstart, packed, row_shapes, mode=mode)
    last = specialise(conclude, state, packed, row_shapes, state.warmstart, mode=mode)

    def one_step(s: PhysicsState, c: Array, around: Surroundings) -> PhysicsState:
        free, touching = terms(s, c), users(s, around)
        start, held, near = lax.stop_gradient((s.warmstart, free, touching))  # the derivative is implicit: see contact.exact
        solution, _ = contact.iterate(lambda q: advance(q, held, near), start)
        return last(s, free, touching, checkpoint_name(solution, contact.SOLUTION))

    return one_step


def _rows_stage(world: World, state: PhysicsState, mode: Mode | None) -> tuple[Callable[..., contact.Rows], Callable[..., Array]]:
    """From one user's vector to its rows, and the program that gives the vectors of all users."""
    if not world.one_user:
        return lambda vector: _no_rows(world), lambda s, around: jnp.zeros((0, 0), s.qpos.dtype)
    pose, size = jnp.zeros(3), jnp.zeros(2)
    halve, restore = (_halved, _restored) if _is_flat_pyramid(world.one_user) else (lambda rows: rows, lambda rows: rows)
    rows, expand = compress(lambda s, p, z: halve(one_user_rows(world, s, p, z)), state, pose, size, mode=mode)
    index = np.array(world.users, int)  # not a device array: the program is kept, and may be made while another is traced

    def over_users(s: PhysicsState, around: Surroundings) -> Array:
        return jax.vmap(rows, in_axes=(None, 0, 0))(s, around.pose[index], around.size[index])

    return lambda vector: restore(expand(vector)), over_users


def _is_flat_pyramid(part: Part) -> bool:
    """Whether a user's rows are the pyramids of planar contacts with sliding friction, four rows each."""
    contacts = part.mjx_data()._impl.contact
    return part.planar and bool(np.all(np.asarray(contacts.dim) == 3))


def _halved(rows: contact.Rows) -> dict[str, Array]:
    """Planar pyramids (n + t, n - t, n, n) as n and t: less than half the numbers to hand on."""
    jacobian, reference = rows.jacobian.reshape(-1, 4, rows.jacobian.shape[-1]), rows.reference.reshape(-1, 4)
    return {
        "normal": jacobian[:, 2],
        "tangent": jacobian[:, 0] - jacobian[:, 2],
        "reference_normal": reference[:, 2],
        "reference_tangent": reference[:, 0] - reference[:, 2],
        "stiffness": rows.stiffness.reshape(-1, 4)[:, 0],
    }


def _restored(parts: dict[str, Array]) -> contact.Rows:
    """The rows of `_halved`."""

    def edges(normal: Array, tangent: Array) -> Array:
        whole = jnp.stack([normal + tangent, normal - tangent, normal, normal], axis=1)
        return whole.reshape(-1, *whole.shape[2:])

    jacobian = edges(parts["normal"], parts["tangent"])
    reference = edges(parts["reference_normal"], parts["reference_tangent"])
    return contact.Rows(jacobian, jnp.repeat(parts["stiffness"], 4), reference)


def _no_rows(world: World) -> contact.Rows:
    return contact.Rows(jnp.zeros((0, world.mj.nv)), jnp.zeros(0), jnp.zeros(0))
