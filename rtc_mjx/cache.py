"""What is kept between runs, under the user's cache folder: compiled programs, folded programs and demonstrations."""

import hashlib
import io
import json
import logging
import os
import tempfile
from collections.abc import Iterable, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rtc_mjx.provenance import NUMERIC

DIGEST_BYTES = 32


def folder() -> Path:
    """The cache folder: under XDG_CACHE_HOME, else in the home folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rtc_mjx"


def keep_compiled() -> Path:
    """Turns JAX's persistent compilation cache on, in JAX_COMPILATION_CACHE_DIR or in our folder; returns where."""
    kept = Path(os.environ.get("JAX_COMPILATION_CACHE_DIR") or folder() / "jax")
    jax.config.update("jax_compilation_cache_dir", str(kept))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    return kept


def fingerprint(made_by: Mapping[str, Any], code: Iterable[Path]) -> str:
    """Hash of what determines a result: what it was made by, the code that made it, versions of packages, precision."""
    everything = {
        **made_by,
        "code": hashlib.sha256(b"".join(file.read_bytes() for file in code)).hexdigest(),
        "versions": [metadata.version(name) for name in NUMERIC],
        "type": str(jnp.zeros(0).dtype),
    }
    return hashlib.sha256(json.dumps(everything, sort_keys=True).encode()).hexdigest()[:32]


def read_arrays(file: Path) -> dict[str, np.ndarray] | None:
    """The arrays of a cache file; None where it is absent, or damaged, which is said (they are then made again)."""
    try:
        content = file.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        logging.getLogger("rtc_mjx").warning("%s cannot be read: %s", file, error.strerror)
        return None
    if hashlib.sha256(content[:-DIGEST_BYTES]).digest() != content[-DIGEST_BYTES:]:
        logging.getLogger("rtc_mjx").warning("%s is damaged; what it held is made again", file)
        return None
    with np.load(io.BytesIO(content), allow_pickle=False) as held:  # an archive may have something behind it
        return dict(held)


def write_arrays(file: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes an archive and its digest beside and renames: neither a reader nor a second writer ever sees half a file.

    Without a place to write it says so and goes on.
    """
    archive = io.BytesIO()
    np.savez(archive, allow_pickle=False, **arrays)
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=file.parent, suffix=".part", delete=False) as part:
            try:
                part.write(archive.getbuffer())
                part.write(hashlib.sha256(archive.getbuffer()).digest())
                part.flush()
            except OSError:
                os.unlink(part.name)
                raise
        os.replace(part.name, file)
    except OSError as error:
        logging.getLogger("rtc_mjx").warning("nothing can be kept in %s: %s", file.parent, error.strerror)
