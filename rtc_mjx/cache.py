"""What is kept between runs, under the user's cache folder: compiled programs and demonstrations."""

import os
import zipfile
from pathlib import Path

import jax

DAMAGED = zipfile.BadZipFile  # what numpy raises for a cut-off archive, beside OSError, ValueError, KeyError and EOFError


def folder() -> Path:
    """The cache folder: under XDG_CACHE_HOME, else in the home folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rtc_mjx"


def keep_compiled() -> Path:
    """Turns JAX's persistent compilation cache on, in JAX_COMPILATION_CACHE_DIR or in our folder; returns where."""
    kept = Path(os.environ.get("JAX_COMPILATION_CACHE_DIR") or folder() / "jax")
    jax.config.update("jax_compilation_cache_dir", str(kept))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    return kept
