"""rtc_mjx: Robust Type Conditioning and its baselines, on worlds stepped and differentiated by MuJoCo MJX."""

import contextlib
import io
import sys

__version__ = "0.1.0"


def _import_mjx_quietly() -> None:
    """Imports MJX without its two lines about the optional Warp backend; anything else it prints still comes through."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(printed):
        import mujoco.mjx  # noqa: F401
    for line in printed.getvalue().splitlines():
        if "Failed to import" not in line or "warp" not in line:
            sys.stderr.write(f"{line}\n")


_import_mjx_quietly()
