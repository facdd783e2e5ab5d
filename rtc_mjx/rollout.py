"""The one loop in which anybody acts: experts, policies and replays (`Actor`) in an episode of a scene.

A rollout is a deterministic, differentiable function of the actor, the episode and the noise drawn beforehand.
"""

from typing import Literal

import jax
import jax.numpy as jnp
from jax import lax

from rtc_mjx.physics import SOLUTION, OneStep, PhysicsState, control_step, specialised_step
from rtc_mjx.scenes import Actor, Scene
from rtc_mjx.trajectory import Episode, Trajectory

GradientMode = Literal["full", "dynamics_only", "none"]


def rollout(
    scene: Scene,
    actor: Actor,
    episode: Episode,
    *,
    gradient: GradientMode = "full",
    decay: float = 1.0,
    one_step: OneStep | None = None,
) -> Trajectory:
    """Lets an actor live one episode.

    Args:
        scene: where.
        actor: who, with the noise of all T steps; where the scene has several agents, all of them (`scenes.several.crew`).
        episode: s_0 and xi.
        gradient: what a backward pass follows from step to step: everything ('full'), the physics but not how the actor
            reacts to what it sees ('dynamics_only'), or nothing ('none'). The observations that the trajectory holds can be
            differentiated by the states in all modes: a discriminator tells how to reach better ones. Values are the same.
        decay: the backward signal shrinks by this factor at every step back in time; values are the same.
        one_step: physics in place of the scene's own, such as hand-written equations.
    """
    episode = jax.tree.map(jnp.asarray, episode)
    advance = control_step(scene.world, scene.substeps, one_step or specialised_step(scene.world))

    def body(carry, inputs):  # type: ignore[no-untyped-def]  # scan's carry is any pytree
        memory, state = carry
        time, before, after, noise = inputs
        seen = scene.observe(episode, time, state)
        memory, action = actor.act(memory, seen if gradient == "full" else lax.stop_gradient(seen), noise)
        reached = advance(damp(state, 0.0 if gradient == "none" else decay), action.reshape(-1), before, after)
        return (memory, reached), (state, seen, action)

    # A backward pass keeps what steps hand on and the contact solutions; what the actor computed is computed again: it is cheaper
    # than writing and reading all activations of all episodes.
    body = jax.checkpoint(body, policy=jax.checkpoint_policies.save_only_these_names(SOLUTION))
    before, after = (jax.tree.map(lambda x, part=part: x[part], episode.surroundings) for part in (slice(None, -1), slice(1, None)))
    inputs = (jnp.arange(scene.steps), before, after, actor.noise)
    (_, last), (states, seen, actions) = lax.scan(body, (actor.memory, episode.start), inputs)
    end = scene.observe(episode, jnp.array(scene.steps), last)
    states, seen = jax.tree.map(lambda xs, x: jnp.concatenate([xs, x[None]]), (states, seen), (last, end))
    return Trajectory(states, seen, actions)


def damp(state: PhysicsState, factor: float) -> PhysicsState:
    """The same values; what flows back through them is multiplied by `factor`."""
    if factor == 1.0:
        return state
    return jax.tree.map(lambda x: lax.stop_gradient(x) + factor * (x - lax.stop_gradient(x)), state)
