"""Nested dictionaries and lists from outside, asked for with the shape they should have: an answer or one line that says what is wrong.

Nothing is handed to numpy before its shape is known: a list of lists may be small in the file and endless when it is spread out.
"""

import math
from typing import Any

import numpy as np

from rtc_mjx.logs.pickled import Array
from rtc_mjx.logs.recording import refuse_if

NUMBERS = (int, float, np.integer, np.floating, np.bool_)
INT64 = 2**63


def dictionary(value: Any, what: str, source: str) -> dict[Any, Any]:
    """A dictionary.

    Raises:
        UsageError: it is none.
    """
    refuse_if(not isinstance(value, dict), source, f"{what} should be a dictionary, not {type(value).__name__}")
    return value


def sequence(value: Any, what: str, source: str) -> list[Any]:
    """A list.

    Raises:
        UsageError: it is none.
    """
    refuse_if(not isinstance(value, list | tuple), source, f"{what} should be a list, not {type(value).__name__}")
    return list(value)


def number(value: Any) -> float:
    """A number as float; NaN for what is none or too large."""
    if isinstance(value, str) and len(value) < 40:
        try:
            return float(value)
        except ValueError:
            return math.nan
    return float(value) if isinstance(value, NUMBERS) and abs(value) < 1e300 else math.nan  # type: ignore[operator]  # numpy's are numbers


def whole(value: Any, default: int) -> int:
    """A whole number, or the default for what is none."""
    x = number(value)
    return int(x) if math.isfinite(x) and abs(x) < INT64 else default


def flat(value: Any, what: str, source: str) -> np.ndarray:
    """Numbers in one row; also of an array with a second axis of length one.

    Raises:
        UsageError: they are not.
    """
    if isinstance(value, Array):
        return _array(value, what, source).reshape(-1)
    return np.array([number(x) for x in sequence(value, what, source)], float)


def rows(value: Any, columns: int, what: str, source: str) -> np.ndarray:
    """Rows of numbers, cut or filled up with zeros to some columns.

    Raises:
        UsageError: they are not.
    """
    if isinstance(value, Array):
        held = _array(value, what, source)
        refuse_if(held.ndim != 2 and held.size > 0, source, f"{what} should be rows of numbers, not an array of shape {held.shape}")
        held = held[:, :columns] if held.ndim == 2 else np.zeros((0, columns))
        return np.pad(held, [(0, 0), (0, columns - held.shape[1])])
    out = np.zeros((len(sequence(value, what, source)), columns))
    for i, row in enumerate(value):
        told = list(flat(row, what, source)[:columns])
        out[i, : len(told)] = told
    return out


def name(value: Any) -> str:
    """An id as text: 7, 7.0 and "7" are the same."""
    if isinstance(value, bool) or not isinstance(value, str | int | float | np.integer | np.floating):
        return ""
    return f"{value:.0f}" if isinstance(value, float | np.floating) else str(value)[:80]


def names(value: Any) -> tuple[str, ...]:
    """A list of ids; empty for what is none."""
    if isinstance(value, Array):
        value = list(value.value.reshape(-1)) if value.value.ndim == 1 else []
    return tuple(name(x) for x in value) if isinstance(value, list | tuple) else ()


def _array(value: Array, what: str, source: str) -> np.ndarray:
    refuse_if(value.value.dtype.kind not in "biuf", source, f"{what} should be numbers, not an array of {value.value.dtype}")
    return value.value.astype(float)
