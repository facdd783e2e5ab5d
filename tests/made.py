"""Scenes and their demonstrations, made once for all tests."""

import dataclasses
import functools
from pathlib import Path

import jax
import pytest

from rtc_mjx import dataset, reference
from rtc_mjx.scenes import SCENES

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"  # real recordings; they are not part of the project


def recordings(*kinds):
    """A glob of real recordings; skips the test where they are not there."""
    if not all((SHARED / kind).is_dir() for kind in kinds):
        pytest.skip(f"recordings are needed in ../shared/data: {', '.join(kinds)}")
    return str(SHARED / (kinds[0] if len(kinds) == 1 else "*"))


@functools.cache
def made(name):
    """The scene with its default settings; that of recordings on a few of them."""
    scene = SCENES[name]()
    return dataclasses.replace(scene, data=recordings("scenarionet_waymo")) if name == "womd" else scene


@functools.cache
def demonstrated(name, count=512):
    """Demonstrations and their features, in single precision whatever the test's."""
    scene = made(name)
    with jax.enable_x64(False):
        held = dataset.drive(scene, *dataset.begun(scene, count, 5))
        return held, reference.expert_features(scene, held)
