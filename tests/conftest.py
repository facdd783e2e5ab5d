"""Shared by all tests: shapes are checked at run time, and compiled programs are kept between runs."""

import jax
import pytest
from jaxtyping import install_import_hook

install_import_hook("rtc_mjx.physics", "beartype.beartype")  # before anything of the package is imported

from rtc_mjx import cache  # noqa: E402

cache.keep_compiled()


@pytest.fixture
def x64():
    """Double precision inside one test."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def quick_to_compile():
    """Without most optimisations: for programs that are compiled once and run for moments."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", before)
