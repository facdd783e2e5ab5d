"""Scenes and their demonstrations, made once for all tests."""

import functools

import jax
from jax import random

from rtc_mjx import dataset
from rtc_mjx.scenes import SCENES


@functools.cache
def made(name):
    """The scene with its default settings."""
    return SCENES[name]()


@functools.cache
def demonstrated(name, count=512):
    """Demonstrations and their features."""
    scene = made(name)
    held = jax.jit(jax.vmap(lambda key: dataset.demonstrate(scene, key)))(random.split(random.key(5), count))
    features = jax.jit(jax.vmap(lambda one: scene.features(one, one.trajectory)))(dataset.without_truth(held))
    return jax.device_get(held), jax.device_get(features)
