"""Updates of what is learned: one of one seed, and many of all seeds as one program.

demonstrations -> minibatch, drawn by seed and update -> `rtc_mjx.gradients` -> optimiser -> the next state
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax import lax, random
from jaxtyping import Array, Int

from rtc_mjx.gradients import gradients
from rtc_mjx.keys import stream
from rtc_mjx.learner import Learner
from rtc_mjx.models import Networks, make_networks
from rtc_mjx.pytree import pytree
from rtc_mjx.sharding import ONE_DEVICE, Grid
from rtc_mjx.trajectory import Demonstration


@pytree
class TrainState:
    """What one update hands to the next; of one seed, or with a leading axis of seeds.

    Attributes:
        networks: what is learned.
        optimiser: Adam's moments.
        seed: of the training; all randomness is a function of it and the update.
        update: number of updates made.
    """

    networks: Networks
    optimiser: Any
    seed: Int[Array, "*seeds"]
    update: Int[Array, "*seeds"]


def start(learner: Learner, seed: Array) -> TrainState:
    """The state before the first update."""
    features = learner.statistics.observation_mean.shape[-1]
    networks = make_networks(stream("networks", seed), learner.scene, features, learner.space, learner.model, learner.method.parts)
    return TrainState(networks, transformation(learner).init(networks), seed, jnp.zeros((), int))


def start_all(learner: Learner, seeds: Sequence[int]) -> TrainState:
    """The states of all seeds before the first update, along a leading axis."""
    return jax.jit(jax.vmap(functools.partial(start, learner)))(jnp.asarray(seeds))


def start_shapes(learner: Learner, seeds: Sequence[int]) -> TrainState:
    """Shapes and types of the states of all seeds: what a checkpoint is restored into."""
    return jax.eval_shape(functools.partial(start_all, learner, seeds))


def transformation(learner: Learner) -> optax.GradientTransformation:
    """Adam with clipping; policy and encoder, prior, discriminator and Q, V apart."""
    options = learner.optimiser

    def adam(rate: float | optax.Schedule, b1: float = 0.9) -> optax.GradientTransformation:
        return optax.chain(optax.clip_by_global_norm(options.clip), optax.adam(rate, b1=b1))

    def falling(rate: float) -> optax.Schedule:
        return optax.cosine_decay_schedule(rate, learner.updates, alpha=options.final_rate)

    sides = {
        "agent": adam(falling(options.learning_rate)),
        "prior": adam(falling(options.prior_rate)),
        "critic": adam(options.discriminator_rate, b1=0.5),
    }
    if "value" in learner.method.parts:  # only then: checkpoints of methods without V hold no place for it
        sides["value"] = adam(options.value_rate)
    return optax.multi_transform(sides, Networks("agent", "agent", "prior", "critic", "critic", "value" if "value" in sides else None))


def train_step(learner: Learner, state: TrainState, expert: Demonstration) -> tuple[TrainState, dict[str, Array]]:
    """One update of one seed; `expert` holds all demonstrations. Returns the next state and what to log."""
    draw, key = random.split(random.fold_in(stream("updates", state.seed), state.update))
    rows = random.randint(draw, (learner.batch,), 0, jax.tree.leaves(expert)[0].shape[0])
    batch = jax.tree.map(lambda x: x[rows], expert)
    gradient, report = gradients(learner, state.networks, batch, key, state.update)
    step, optimiser = transformation(learner).update(gradient, state.optimiser, state.networks)
    parts = {part: value for part, value in vars(gradient).items() if value is not None}
    report |= {f"gradient_norm_{part}": optax.tree.norm(value) for part, value in parts.items()}  # raw: before any clipping
    return TrainState(optax.apply_updates(state.networks, step), optimiser, state.seed, state.update + 1), report


def compiled_chunk(learner: Learner, length: int, grid: Grid = ONE_DEVICE) -> jax.stages.Wrapped:
    """`length` updates of all seeds as one program on the devices of a grid; returns the means of what the updates report.

    On a CPU one seed already fills the matrix units, and all seeds' activations together would not fit its caches: there seeds take
    turns within the program. Elsewhere they are one more axis.
    """
    learner = dataclasses.replace(learner, shared=dataclasses.replace(grid.rows, agents=learner.scene.agents))

    def all_seeds(states: TrainState, expert: Demonstration) -> tuple[TrainState, dict[str, Array]]:
        def one_seed(state: TrainState) -> tuple[TrainState, dict[str, Array]]:
            state, seen = lax.scan(lambda s, _: train_step(learner, s, expert), state, length=length)
            return state, jax.tree.map(jnp.mean, seen)

        return lax.map(one_seed, states) if jax.default_backend() == "cpu" else jax.vmap(one_seed)(states)

    return jax.jit(grid.over_seeds(all_seeds), donate_argnums=0)
