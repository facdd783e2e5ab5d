"""Errors that a user can act on: each names the offending value, where it stands and what would be accepted."""

import contextlib
import gc
import sys
from collections.abc import Iterator


class UsageError(ValueError):
    """Wrong use of a command or of the library; commands exit with status 2 and print the one line."""


class UnsupportedWorldError(UsageError):
    """The world holds something the differentiable step does not cover; nothing is approximated in silence."""


class NonFiniteError(UsageError):
    """A state, control or surrounding handed to the simulator holds NaN or infinity."""


class RunError(RuntimeError):
    """A failure that is not the user's wrong use, in one line; commands exit with status 1."""


class DivergedError(RunError):
    """A training has diverged; processes that train together all find it at once."""


@contextlib.contextmanager
def quiet_destructors() -> Iterator[None]:
    """Around a library call that may fail: what it leaves half-made complains once more when it is freed, and says nothing new."""
    before, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        yield
    finally:
        gc.collect()
        sys.unraisablehook = before
