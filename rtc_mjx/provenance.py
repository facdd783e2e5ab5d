"""What a result was made by: versions of the packages, and the commit of the code."""

import collections
import hashlib
import platform
import subprocess
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from rtc_mjx import __version__

PACKAGES = ("mujoco", "mujoco-mjx", "jax", "flax", "optax")  # that a result names
MEASURING = (
    "evaluate.py",
    "metrics.py",
    "geometry.py",
    "extrema.py",
    "reference.py",
    "recorded_realism.py",
    "type_shift.py",
    "carried.py",
    "realism.py",
    "probe.py",
    "scenes/*.py",
    "sim_agents/*.py",
)
NUMERIC = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy")  # that numbers depend on, to the last bit


def made_by() -> dict[str, Any]:
    """What `code` says, and `measured_by`."""
    return code() | {"measured_by": measured_by()}


def code() -> dict[str, Any]:
    """`versions` of the packages, and `commit` of the checkout that this code runs from (None where there is none)."""
    versions = {"python_package": __version__, **{name: metadata.version(name) for name in PACKAGES}}
    return {"versions": versions, "commit": _commit()}


def measured_by() -> str:
    """A hash of the code that measures what was trained: results under another hash are made again, not mixed with those under this one."""
    here, total = Path(__file__).parent, hashlib.sha256()
    for pattern in MEASURING:
        for file in sorted(here.glob(pattern)):
            total.update(file.read_bytes())
    return total.hexdigest()[:12]


def versions() -> dict[str, str]:
    """Of Python and of the packages that numbers depend on, and a hash of this package's own code, by name."""
    here = Path(__file__).parent
    code = hashlib.sha256(b"".join(file.read_bytes() for file in sorted(here.rglob("*.py")))).hexdigest()[:12]
    named = {name: metadata.version(name) for name in NUMERIC}
    return {"Python": platform.python_version(), **named, "rtc_mjx code": code}


def of_recordings(lines: Sequence[str]) -> dict[str, Any]:
    """How many recorded scenes each part has (`Scene.recordings`, a line each), and a `digest` that tells them from all others."""
    digest = hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]
    return {**collections.Counter(line.split()[0] for line in lines), "digest": digest}


def _commit() -> str | None:
    """The commit, with "-dirty" where code, worlds or settings differ from it; results that are being written do not count."""
    here = Path(__file__).parent
    try:
        done = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=here, capture_output=True, text=True, check=True)
        parts = [str(here), str(here.parent / "assets"), str(here.parent / "configs")]
        changed = subprocess.run(["git", "status", "--porcelain", "--", *parts], cwd=here, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip() + ("-dirty" if changed.stdout.strip() else "")
