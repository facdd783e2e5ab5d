"""A small learner for tests: the double goal for a few steps, with narrow networks."""

import dataclasses
import functools

import jax
import jax.numpy as jnp

from rtc_mjx import dataset
from rtc_mjx import gradients as updating
from rtc_mjx.config import Config, Experts, Intervals
from rtc_mjx.learner import Learner, OptimiserOptions
from rtc_mjx.losses import LossWeights
from rtc_mjx.methods import METHODS
from rtc_mjx.models import ModelOptions
from rtc_mjx.scenes import DoubleGoal
from rtc_mjx.updates import start

SCENE = DoubleGoal(steps=16)
MODEL = ModelOptions(width=16, type_size=3, type_count=4, prior_components=3)
ON_SCENE = tuple(name for name, method in METHODS.items() if method.kind != "label" or SCENE.labels)
CLOSED_LOOP = tuple(name for name in ON_SCENE if any(b.closed_loop for b in METHODS[name].branches))
SCORED = tuple(name for name in ON_SCENE if "value" in METHODS[name].parts)  # learn by the score function
OPEN = OptimiserOptions(trajectory_clip=1e9)


def settings(method, folder=None, **changes):
    """A run that takes seconds."""
    base = Config(
        scene=SCENE, method=method, updates=40, batch=16, run=folder, model=MODEL,
        experts=Experts(train=256, test=64), every=Intervals(log=10, test=20, save=20),
    )  # fmt: skip
    return dataclasses.replace(base, **changes)


@functools.cache
def experts(double):
    """Demonstrations in single or double precision."""
    del double  # the key of the cache: JAX's precision at the call makes the difference
    return jax.tree.map(jnp.asarray, dataset.demonstrations(SCENE, 64, 11))


def learner(method, *, weights=None, optimiser=OPEN, share=0.5, batch=12):
    """A learner of a method on the small scene."""
    held = METHODS[method]
    demonstrations = experts(jnp.zeros(0).dtype == jnp.float64)
    return Learner(
        scene=SCENE, method=held, space=held.space(MODEL), statistics=dataset.statistics(SCENE, demonstrations), model=MODEL,
        weights=weights or LossWeights(adversarial_ramp=0), optimiser=optimiser, updates=100, batch=batch, encoder_share=share,
    )  # fmt: skip


def begin(learner, seed=0):
    """A fresh state, in the precision at hand, and a minibatch."""
    state = jax.jit(functools.partial(start, learner))(jnp.array(seed))
    demonstrations = experts(jnp.zeros(0).dtype == jnp.float64)
    batch = jax.tree.map(lambda x: x[: learner.batch], dataset.without_truth(demonstrations))
    wide = jax.tree.map(lambda x: x.astype(jnp.zeros(0).dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, state)
    return wide, batch


def gradients(learner, networks, batch, key, update):
    """What an update follows, as one program: by itself it is hundreds."""
    return jax.jit(functools.partial(updating.gradients, learner))(networks, batch, key, update)


def played(learner, networks, batch, types, key):
    """Types of each branch, drawn with one key, and the rollouts of those that are played, with another: as one program."""

    def both(networks):
        agent = learner.agent(networks)
        typed = updating.infer(learner, agent, batch, types)
        return typed, updating.play_together(learner, agent, batch, typed, key)[0]

    return jax.jit(both)(networks)
