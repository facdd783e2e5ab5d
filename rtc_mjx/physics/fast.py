"""The step of one world, specialised stage by stage: the same values and derivatives, many times faster.

The stages are those of `rtc_mjx.physics.step`. Each is folded to scalar arithmetic by `rtc_mjx.specialise`; the rows of a road user
are one small program run for all users and worlds at once. What a stage knows to be constant or equal (the zeros of a planar
world, the two pyramid edges along z) is handed to the next as such, not as data.
"""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array

from rtc_mjx import cache
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
from rtc_mjx.physics.world import Part, World, double_precision, model_hash
from rtc_mjx.specialise import Mode, Program, Specialised, compress, kept, specialise

PACKAGE = Path(__file__).resolve().parents[1]
SOURCES = [PACKAGE / "pytree.py", *(file for folder in ("physics", "specialise") for file in sorted((PACKAGE / folder).glob("*.py")))]


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
    programs = kept(_fingerprint(world), lambda: _folded(world, state, control))

    def stage(name: str, result: Any, *examples: Any) -> Specialised:
        return Specialised(programs[name], jax.tree.structure(result), jax.tree.structure(examples), mode)

    if "whole" in programs:
        whole = stage("whole", state, state, control)
        return lambda s, c, _: whole(s, c)
    pose, size, vector = jnp.zeros(3), jnp.zeros(2), jnp.zeros(0)
    terms, advance = stage("terms", vector, state, control), stage("advance", (vector, vector), vector, vector, vector)
    last = stage("last", state, state, vector, vector, vector)
    rows = jax.vmap(stage("rows", vector, state, pose, size), in_axes=(None, 0, 0)) if world.one_user else None
    index = np.array(world.users, int)  # not a device array: the step is kept, and may be made while another is traced

    def one_step(s: PhysicsState, c: Array, around: Surroundings) -> PhysicsState:
        free = terms(s, c)
        touching = rows(s, around.pose[index], around.size[index]) if rows else jnp.zeros((0, 0), s.qpos.dtype)
        start, held, near = lax.stop_gradient((s.warmstart, free, touching))  # the derivative is implicit: see contact.exact
        solution, _ = contact.iterate(lambda q: advance(q, held, near), start)
        return last(s, free, touching, checkpoint_name(solution, contact.SOLUTION))

    return one_step


def _fingerprint(world: World) -> str:
    """Hash of all that determines the programs of a world: what its step reads, and the code that makes and folds it."""
    parts = [part for part in (world.free, world.one_user) if part]
    made_by = {
        "models": [model_hash(model) for model in (world.mj, *(part.mj for part in parts))],
        "parts": [(part.planar, part.user_body, part.user_geom, part.user_rows) for part in parts],
        "world": (world.control_ids, world.mocap_ids, world.users),
        "device": jax.default_backend(),  # it evaluates what is constant
    }
    return cache.fingerprint(made_by, SOURCES)


def _folded(world: World, state: PhysicsState, control: Array) -> dict[str, Program]:
    """The stages of a world's step by name: the `whole`, or `terms`, `rows` of one user, `advance` (a Newton step) and `last`."""
    if not constraint_rows(world):
        return {"whole": specialise(lambda s, c: step(world, s, c, rest_surroundings(world)), state, control).program}
    compact, as_terms = compress(lambda s, c: dynamics(world, s, c), state, control)
    terms = compact.program
    rows, as_rows = _folded_rows(world, state)

    def problem(terms_vector: Array, rows_vectors: Array) -> tuple[Dynamics, contact.ContactProblem]:
        parts = [as_rows(rows_vectors[i]) for i in range(len(world.users))] or [_no_rows(world)]
        stacked = jax.tree.map(lambda *x: jnp.concatenate(x), *parts)
        return as_terms(terms_vector), assemble(as_terms(terms_vector), stacked)

    def newton_step(start: Array, terms_vector: Array, rows_vectors: Array) -> tuple[Array, Array]:
        return contact.newton_step(problem(terms_vector, rows_vectors)[1], start)

    def conclude(s: PhysicsState, terms_vector: Array, rows_vectors: Array, solution: Array) -> PhysicsState:
        return finish(world, s, *problem(terms_vector, rows_vectors), solution)

    given = jnp.zeros(terms.outputs[0].size), jnp.zeros((len(world.users), rows.outputs[0].size if rows else 0))
    advance, last = specialise(newton_step, state.warmstart, *given), specialise(conclude, state, *given, state.warmstart)
    made = {"terms": terms, "rows": rows, "advance": advance.program, "last": last.program}
    return {name: program for name, program in made.items() if program}


def _folded_rows(world: World, state: PhysicsState) -> tuple[Program | None, Callable[..., contact.Rows]]:
    """The program that gives one user's vector, and from the vector to the user's rows."""
    if not world.one_user:
        return None, lambda vector: _no_rows(world)
    halve, restore = (_halved, _restored) if _is_flat_pyramid(world.one_user) else (lambda rows: rows, lambda rows: rows)
    rows, expand = compress(lambda s, p, z: halve(one_user_rows(world, s, p, z)), state, jnp.zeros(3), jnp.zeros(2))
    return rows.program, lambda vector: restore(expand(vector))


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
