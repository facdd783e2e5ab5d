"""Errors that a user can act on: each names the offending value, where it stands and what would be accepted."""


class UsageError(ValueError):
    """Wrong use of a command or of the library; commands exit with status 2 and print the one line."""


class UnsupportedWorldError(UsageError):
    """The world holds something the differentiable step does not cover; nothing is approximated in silence."""


class NonFiniteError(UsageError):
    """A state, control or surrounding handed to the simulator holds NaN or infinity."""


class RunError(RuntimeError):
    """A failure that is not the user's wrong use, in one line; commands exit with status 1."""
