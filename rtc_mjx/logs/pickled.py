"""Pickles as data: dictionaries, lists, numbers, text and numpy arrays, and nothing else.

A pickle is a program: it may import and call anything. This reads its operations (`pickletools`) and carries out those that build
plain values; there is no import and no call among them. The names it may ask for stand in NAMES, each with a function of our own
in its place. Whatever else it wants is refused by name.

A pickle may name one value many times for two bytes each, so what is small in the file may be endless when it is written out. Nothing
here copies or prints a value without counting: see `Machine.charge`, and `Plain` for the readers.
"""

import io
import pickletools
import re
import warnings
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from rtc_mjx.errors import UsageError

MOST_OPERATIONS = 1_000_000  # real scenes have one or two hundred thousand
MOST_COPIES = 4  # of the whole file, that its arrays and byte strings may come to; real ones need two
MOST_MEMO = 2**32  # more than that, numbers of a memo can be chosen so that a dictionary of them is slow
MOST_KEY = 2**60  # likewise the whole numbers that are keys
LAST_CODE_POINT = 0x10FFFF  # of Unicode; numpy does not check
DTYPE = re.compile(r"[biuf][1248]|U[0-9]{1,4}|S[0-9]{1,4}|O8?")
LONGEST = 200  # characters of a message; those of pickletools may quote the file
MARK = object()
Key = str | int | float | bool | None


class Refused(Exception):
    """What a pickle holds that no scene does."""


def shown(value: Any) -> str:
    """A value for a message: text as it is, of anything else its type, as nested lists may take for ever to print."""
    return repr(value[:40]) if isinstance(value, str) else type(value).__name__


class DType:
    """Stands for a numpy dtype while a pickle is read."""

    def __init__(self, code: Any, *_: Any) -> None:
        if not isinstance(code, str) or not DTYPE.fullmatch(code):
            raise Refused(f"arrays of type {shown(code)}")
        self.code, self.order = code, "<"

    def build(self, state: Any) -> None:
        """Takes over the byte order."""
        if not isinstance(state, tuple) or len(state) < 2 or state[1] not in ("<", ">", "|", "=") or any(x is not None for x in state[2:5]):
            raise Refused("an array with a dtype of several fields")
        self.order = state[1]

    def array(self, shape: Any, fortran: Any, data: Any) -> np.ndarray:
        """The array of some bytes, or of a list of plain values; never larger than what was read."""
        if not isinstance(shape, tuple) or not all(isinstance(n, int) and 0 <= n < 2**32 for n in shape) or len(shape) > 4:
            raise Refused(f"an array of a shape that is none ({shown(shape)})")
        order: Literal["F", "C"] = "F" if fortran else "C"
        if self.code.startswith("O"):
            if not isinstance(data, list):
                raise Refused("an array of objects that is no list")
            flat = np.empty(len(data), object)
            for i, value in enumerate(data):  # at once, numpy would look into nested lists, which may be endless
                flat[i] = value
        else:
            dtype = np.dtype(self.order + self.code)
            if not isinstance(data, bytes | bytearray) or not dtype.itemsize:
                raise Refused("an array whose numbers are no bytes")
            flat = np.frombuffer(data, dtype)
            if self.code.startswith("U") and np.any(np.frombuffer(data, self.order + "u4") > LAST_CODE_POINT):
                raise Refused("text of characters that do not exist")
        return flat.reshape(shape, order=order)


class Array:
    """Stands for a numpy array while a pickle is read; `value` is the array."""

    def __init__(self, *_: Any) -> None:
        self.value = np.zeros(0)

    def build(self, state: Any) -> None:
        """Takes over shape and numbers: (version, shape, dtype, fortran, data)."""
        if not isinstance(state, tuple) or len(state) != 5 or not isinstance(state[2], DType):
            raise Refused("an array without shape and dtype")
        self.value = state[2].array(state[1], state[3], state[4])


def _from_buffer(data: Any = b"", dtype: Any = None, shape: Any = (), order: Any = "C") -> Array:
    """What newer pickles of arrays ask for."""
    out = Array()
    out.build((1, shape, dtype, order == "F", data))
    return out


def _scalar(dtype: Any = None, data: Any = b"") -> Any:
    """A numpy number."""
    if not isinstance(dtype, DType):
        raise Refused("a number without dtype")
    return dtype.array((), False, data)[()]


def _encode(text: Any = "", coding: Any = "latin1") -> bytes:
    """How pickles of protocol 2 hold bytes."""
    if not isinstance(text, str) or coding != "latin1":
        raise Refused(f"an encoding {shown(coding)}")
    return text.encode("latin1")


def _plain_dictionary(*_: Any) -> dict[Any, Any]:
    return {}


def _collection(*items: Any) -> list[Any]:
    return list(items[0]) if items and isinstance(items[0], list) else []


def _is_key(value: Any) -> bool:
    return isinstance(value, Key) and not (isinstance(value, int) and abs(value) > MOST_KEY)


NAMES: dict[str, Callable[..., Any]] = {
    "numpy.core.multiarray _reconstruct": Array, "numpy._core.multiarray _reconstruct": Array,
    "numpy.core.multiarray scalar": _scalar, "numpy._core.multiarray scalar": _scalar,
    "numpy.core.numeric _frombuffer": _from_buffer, "numpy._core.numeric _frombuffer": _from_buffer,
    "numpy ndarray": Array, "numpy dtype": DType, "_codecs encode": _encode,
    "collections defaultdict": _plain_dictionary, "collections OrderedDict": _plain_dictionary,
    "builtins int": int, "builtins float": float, "builtins list": _collection, "builtins dict": _plain_dictionary,
    "builtins set": _collection, "builtins frozenset": _collection,
}  # fmt: skip
CALLED = frozenset(NAMES) - {"numpy ndarray", "builtins int", "builtins float"}  # these are only handed on


class Machine:
    """Stack and memo of a pickle; one method for each kind of operation.

    Args:
        size: bytes of the file.
    """

    def __init__(self, size: int) -> None:
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}
        self.left = MOST_COPIES * size

    def charge(self, arguments: Any) -> None:
        """Counts what a function may copy of its arguments."""
        held = arguments if isinstance(arguments, tuple) else ()
        self.left -= sum(len(x) for x in held if isinstance(x, str | bytes | bytearray | list))
        if self.left < 0:
            raise Refused("the same values over and over")

    def since_mark(self) -> list[Any]:
        """Takes everything off the stack down to the mark."""
        at = len(self.stack) - 1
        while at >= 0 and self.stack[at] is not MARK:
            at -= 1
        if at < 0:
            raise Refused("operations without a mark")
        taken = self.stack[at + 1 :]
        del self.stack[at:]
        return taken

    def take(self, count: int) -> list[Any]:
        """Takes the last few off the stack."""
        if len(self.stack) < count or any(x is MARK for x in self.stack[-count:]):
            raise Refused("operations without operands")
        taken = self.stack[-count:]
        del self.stack[-count:]
        return taken

    def put_into(self, container: type, items: list[Any]) -> None:
        """Adds to the list, set or dictionary on top of the stack."""
        target = self.stack[-1]
        if not isinstance(target, container):
            raise Refused("items of what is no container")
        if isinstance(target, dict):
            if not all(map(_is_key, items[::2])) or len(items) % 2:
                raise Refused("dictionary keys that are neither text nor common numbers")
            target.update(zip(items[::2], items[1::2], strict=True))
        elif isinstance(target, list):
            target.extend(items)

    def call(self) -> None:
        """One of our functions in place of what the pickle names."""
        function, arguments = self.take(2)
        name = getattr(function, "name", None)
        if name not in CALLED or not isinstance(arguments, tuple):
            raise Refused(f"a call of {name or type(function).__name__}")
        self.charge(arguments)
        self.stack.append(NAMES[name](*arguments))

    def build(self) -> None:
        """State of an array or a dtype."""
        target, state = self.take(2)
        if not isinstance(target, Array | DType):
            raise Refused(f"state of a {type(target).__name__}")
        self.charge(state)
        target.build(state)
        self.stack.append(target)


class Name:
    """A name that a pickle asks for; only NAMES exist."""

    def __init__(self, module: Any, name: Any) -> None:
        if not isinstance(module, str) or not isinstance(name, str):
            raise Refused(f"a name made of {type(module).__name__} and {type(name).__name__}")
        self.name = f"{module} {name}"
        if self.name not in NAMES:
            raise Refused(f"{module[:40]}.{name[:40]}")


def _memoized(machine: Machine, argument: Any) -> None:
    place = len(machine.memo) if argument is None else argument
    if not 0 <= place < MOST_MEMO:
        raise Refused("a memo without bounds")
    machine.memo[place] = machine.stack[-1]


def _recalled(machine: Machine, argument: Any) -> None:
    if argument not in machine.memo:
        raise Refused("what it has not read")
    machine.stack.append(machine.memo[argument])


def _pushed(machine: Machine, argument: Any) -> None:
    machine.stack.append(argument)


def _constant(make: Callable[[], Any]) -> Callable[[Machine, Any], None]:
    return lambda machine, _: machine.stack.append(make())


def _tuple_of(count: int) -> Callable[[Machine, Any], None]:
    return lambda machine, _: machine.stack.append(tuple(machine.take(count)))


def _dictionary(machine: Machine, _: Any) -> None:
    items = machine.since_mark()
    machine.stack.append({})
    machine.put_into(dict, items)


def _nothing(machine: Machine, _: Any) -> None:
    """Frames and protocol numbers say nothing about the values."""


OPERATIONS: dict[str, Callable[[Machine, Any], None]] = {
    "PROTO": _nothing, "FRAME": _nothing, "STOP": _nothing,
    "NONE": _constant(lambda: None), "NEWTRUE": _constant(lambda: True), "NEWFALSE": _constant(lambda: False),
    **dict.fromkeys(
        ("BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "SHORT_BINBYTES",
         "BINBYTES", "BINBYTES8", "BYTEARRAY8", "INT", "FLOAT", "LONG", "UNICODE"), _pushed,
    ),
    "MARK": lambda machine, _: machine.stack.append(MARK),
    "EMPTY_DICT": _constant(dict), "EMPTY_LIST": _constant(list), "EMPTY_SET": _constant(list), "EMPTY_TUPLE": _constant(tuple),
    "TUPLE1": _tuple_of(1), "TUPLE2": _tuple_of(2), "TUPLE3": _tuple_of(3),
    "TUPLE": lambda machine, _: machine.stack.append(tuple(machine.since_mark())),
    "LIST": lambda machine, _: machine.stack.append(machine.since_mark()),
    "FROZENSET": lambda machine, _: machine.stack.append(machine.since_mark()), "DICT": _dictionary,
    "APPEND": lambda machine, _: machine.put_into(list, machine.take(1)),
    "APPENDS": lambda machine, _: machine.put_into(list, machine.since_mark()),
    "ADDITEMS": lambda machine, _: machine.put_into(list, machine.since_mark()),
    "SETITEM": lambda machine, _: machine.put_into(dict, machine.take(2)),
    "SETITEMS": lambda machine, _: machine.put_into(dict, machine.since_mark()),
    "MEMOIZE": _memoized, "BINPUT": _memoized, "LONG_BINPUT": _memoized, "PUT": _memoized,
    "BINGET": _recalled, "LONG_BINGET": _recalled, "GET": _recalled,
    "GLOBAL": lambda machine, name: machine.stack.append(Name(*name.split(" ", 1))),
    "STACK_GLOBAL": lambda machine, _: machine.stack.append(Name(*machine.take(2))),
    "REDUCE": lambda machine, _: machine.call(), "BUILD": lambda machine, _: machine.build(),
}  # fmt: skip


def _carry_out(machine: Machine, data: bytes) -> None:
    for count, (operation, argument, _) in enumerate(pickletools.genops(io.BytesIO(data))):
        if operation.name not in OPERATIONS:
            raise Refused(f"the operation {operation.name}")
        if count > MOST_OPERATIONS:
            raise Refused(f"more than {MOST_OPERATIONS} operations")
        OPERATIONS[operation.name](machine, argument)


def load(data: bytes, source: str) -> Any:
    """The value of a pickle; arrays in it are `Array`, sets are lists.

    Args:
        data: the whole pickle.
        source: the file, for messages.

    Raises:
        UsageError: it is cut off or damaged, or holds more than plain values and arrays.
    """
    machine = Machine(len(data))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # pickletools, of odd escapes in names that are refused anyway
            _carry_out(machine, data)
    except Refused as why:
        raise UsageError(f"{source}: its pickle holds {why}, which no recorded scene needs; it was not carried out") from why
    except (ValueError, IndexError, TypeError, OverflowError) as error:
        cause = str(error).splitlines()[0][:LONGEST] if str(error) else type(error).__name__
        raise UsageError(f"{source}: its pickle is damaged: {cause}") from error
    if len(machine.stack) != 1:
        raise UsageError(f"{source}: its pickle is damaged: {len(machine.stack)} values are left on its stack")
    return machine.stack[0]
