"""What a result was made by: versions of the packages, and the commit of the code."""

import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

from rtc_mjx import __version__

PACKAGES = ("mujoco", "mujoco-mjx", "jax", "flax", "optax")


def made_by() -> dict[str, Any]:
    """`versions` of the packages and `commit` of the checkout that this code runs from (None where there is none)."""
    versions = {"python_package": __version__, **{name: metadata.version(name) for name in PACKAGES}}
    return {"versions": versions, "commit": _commit()}


def _commit() -> str | None:
    try:
        done = subprocess.run(
            ["git", "describe", "--always", "--dirty"], cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()
