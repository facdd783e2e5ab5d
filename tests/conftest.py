"""Shared by all tests: shapes are checked at run time, programs are compiled quickly and kept between runs, and long files begin first."""

import os

# Programs are compiled once and run for moments: without most optimisations, and by the emitters of XLA that take less time.
# Processes that tests start inherit both. What must be optimised asks for it (`optimised`).
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_use_fusion_emitters=false"

import jax  # noqa: E402
import pytest  # noqa: E402
from jaxtyping import install_import_hook  # noqa: E402

install_import_hook("rtc_mjx.physics", "beartype.beartype")  # before anything of the package is imported

from rtc_mjx import cache, cli  # noqa: E402

cache.keep_compiled()
cli.collect_garbage_less()

LONG = (
    "driving_trained", "driving", "runs", "several", "scenes", "recorded", "notebooks",
    "type_shift", "study", "blocks", "step", "scaling", "learning",
)  # fmt: skip


def pytest_collection_modifyitems(items):
    """Files that take longest first, so that no worker is left alone with one at the end."""
    places = {f"test_{name}": place for place, name in enumerate(LONG)}
    items.sort(key=lambda item: places.get(item.path.stem, len(LONG)))


@pytest.fixture
def x64():
    """Double precision inside one test."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def optimised():
    """Programs as users have them: for tests of how fast they are."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", before)
