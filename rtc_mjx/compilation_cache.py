"""The persistent compilation cache: what was compiled once is read back in the next process."""

import os
from pathlib import Path

import jax


def enable() -> Path:
    """Turns JAX's persistent cache on, in JAX_COMPILATION_CACHE_DIR or under the user's cache folder; returns the folder."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = Path(os.environ.get("JAX_COMPILATION_CACHE_DIR") or base / "rtc_mjx" / "jax")
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    return folder
