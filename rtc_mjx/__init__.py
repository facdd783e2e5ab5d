"""rtc_mjx: Robust Type Conditioning and its baselines, on worlds stepped and differentiated by MuJoCo MJX."""

import contextlib
import ctypes.util
import io
import os
import sys

__version__ = "0.1.0"


def _choose_gl() -> None:
    """Without a display and a choice of the user's, MuJoCo would try a window system: choose what renders offscreen, if anything.

    MuJoCo reads MUJOCO_GL when it is imported, so this cannot wait until someone renders.
    """
    if "MUJOCO_GL" in os.environ or "DISPLAY" in os.environ or sys.platform != "linux":
        return
    there = [backend for backend, library in (("egl", "EGL"), ("osmesa", "OSMesa")) if ctypes.util.find_library(library)]
    os.environ["MUJOCO_GL"] = there[0] if there else "disable"


def _import_mjx_quietly() -> None:
    """Imports MJX without its two lines about the optional Warp backend; anything else it prints still comes through."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        import mujoco.mjx  # noqa: F401
    for line in printed.getvalue().splitlines():
        if "Failed to import" not in line or "warp" not in line:
            sys.stderr.write(f"{line}\n")


_choose_gl()
_import_mjx_quietly()
