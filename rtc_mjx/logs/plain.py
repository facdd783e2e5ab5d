"""Nested dictionaries and lists from outside, asked for with the shape they should have: an answer or one line that says what is wrong.

Nothing is handed to numpy, copied or printed before its shape is known and counted: in a pickle one list may stand in many places, so
that a file of some kilobytes is endless when it is spread out.
"""

import math
from collections import Counter
from typing import Any

import numpy as np

from rtc_mjx.logs.pickled import Array
from rtc_mjx.logs.recording import refuse_if

NUMBERS = (int, float, np.integer, np.floating, np.bool_)
INT64 = 2**63
MOST_VALUES = 5_000_000  # numbers that a file comes to; real ones have up to half a million
EACH = 10  # numbers that asking for anything is counted as, and as which an id is: about the time and memory that it takes
LONGEST = 80  # characters of an id or a type


class Plain:
    """What is asked of one file, and what had to be mended.

    Args:
        source: the file, for messages.
    """

    def __init__(self, source: str) -> None:
        self.source, self.left = source, MOST_VALUES
        self.repairs: Counter[str] = Counter()

    def refuse_if(self, bad: bool, why: str) -> None:
        """One line that names file and cause.

        Raises:
            UsageError: it is bad.
        """
        refuse_if(bad, self.source, why)

    def spend(self, count: int, what: str) -> None:
        """Counts values before they are taken out.

        Raises:
            UsageError: there are more than any recording has.
        """
        self.left -= count + EACH
        self.refuse_if(self.left < 0, f"with {what} it comes to more than {MOST_VALUES} values; so many are not read")

    def dictionary(self, value: Any, what: str) -> dict[Any, Any]:
        """A dictionary.

        Raises:
            UsageError: it is none.
        """
        self.refuse_if(not isinstance(value, dict), f"{what} should be a dictionary, not {type(value).__name__}")
        return value

    def sequence(self, value: Any, what: str) -> list[Any] | tuple[Any, ...]:
        """A list, not copied.

        Raises:
            UsageError: it is none.
        """
        self.refuse_if(not isinstance(value, list | tuple), f"{what} should be a list, not {type(value).__name__}")
        return value

    def flat(self, value: Any, what: str) -> np.ndarray:
        """Numbers in one row; also of an array with a second axis of length one.

        Raises:
            UsageError: they are not.
        """
        if isinstance(value, Array):
            self.refuse_if(not _in_a_row(value.value), f"{what} should stand in a row, not in an array of shape {value.value.shape}")
            return self._array(value, what).reshape(-1)
        held = self.sequence(value, what)
        self.spend(len(held), what)
        return np.array([number(x) for x in held], float)

    def rows(self, value: Any, columns: int, what: str) -> np.ndarray:
        """Rows of numbers, cut or filled up with zeros to some columns.

        Raises:
            UsageError: they are not.
        """
        if isinstance(value, Array):
            return self._columns(value, columns, what)
        held = self.sequence(value, what)
        self.spend(len(held) * (columns + EACH), what)
        out = np.zeros((len(held), columns))
        out[:, :2] = np.nan  # a row without x and y is nowhere
        for i, row in enumerate(held):
            told = self.flat(row, what) if isinstance(row, Array) else self.sequence(row, what)
            cut = [number(x) for x in told[:columns]]
            out[i, : len(cut)] = cut
        return out

    def _columns(self, value: Array, columns: int, what: str) -> np.ndarray:
        shape = value.value.shape
        if not value.value.size:
            return np.zeros((0, columns))
        odd = len(shape) != 2 or shape[1] < 2
        self.refuse_if(odd, f"{what} should be rows of two numbers or more, not an array of shape {shape}")
        held = self._array(value, what)[:, :columns]
        return np.pad(held, [(0, 0), (0, columns - held.shape[1])])

    def _array(self, value: Array, what: str) -> np.ndarray:
        self.refuse_if(value.value.dtype.kind not in "biuf", f"{what} should be numbers, not an array of {value.value.dtype}")
        self.spend(value.value.size, what)
        with np.errstate(invalid="ignore"):  # a signalling NaN becomes a quiet one
            return value.value.astype(float)

    def items(self, value: Any, what: str) -> list[Any]:
        """What stands in a list, or in an array as `flat` reads it, text cut to LONGEST; nothing for what is neither, and that is counted.

        Raises:
            UsageError: there is more than any recording has.
        """
        if isinstance(value, Array) and _in_a_row(value.value):
            row = value.value.reshape(-1)
            self.spend(EACH * len(row), what)
            return list(row.astype(f"U{LONGEST}") if row.dtype.kind == "U" and row.itemsize > 4 * LONGEST else row)
        told = isinstance(value, list | tuple)
        self.repairs[f"what should be {what} but is no list, dropped"] += not told and value is not None
        self.spend(EACH * len(value) if told else 0, what)
        return list(value) if told else []

    def names(self, value: Any, what: str) -> tuple[str, ...]:
        """A list of ids; empty for what is none.

        Raises:
            UsageError: there are more than any recording has.
        """
        return tuple(name(x) for x in self.items(value, what))


def _in_a_row(array: np.ndarray) -> bool:
    return array.size == (array.shape[0] if array.ndim else 1)


def number(value: Any) -> float:
    """A number as float; NaN for what is none or too large."""
    if isinstance(value, str) and len(value) < 40:
        try:
            return float(value)
        except ValueError:
            return math.nan
    if isinstance(value, int) and not -INT64 * INT64 < value < INT64 * INT64:
        return math.nan  # may be too large for a float, and slow
    out = float(value) if isinstance(value, NUMBERS) else math.nan
    return out if abs(out) < 1e300 else math.nan


def whole(value: Any, default: int) -> int:
    """A whole number, or the default for what is none."""
    x = number(value)
    return int(x) if math.isfinite(x) and abs(x) < INT64 else default


def name(value: Any) -> str:
    """An id as text: 7, 7.0 and "7" are the same."""
    if isinstance(value, bool) or not isinstance(value, str | int | float | np.integer | np.floating):
        return ""
    return f"{value:.0f}"[:LONGEST] if isinstance(value, float | np.floating) else text(value if isinstance(value, str) else str(value))


def text(value: Any) -> str:
    """Text in one line that can be printed anywhere; empty for what is none."""
    held = str(value[:LONGEST]) if isinstance(value, str) else ""
    return held if held.isprintable() else held.encode("unicode_escape").decode("ascii")
