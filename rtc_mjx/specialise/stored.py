"""Folded programs on disk, as plain arrays: a world that was folded once need not be traced and folded again.

An entry holds all programs of one world and precision, and the fingerprint of all that made them: another number in the
world, another version or a changed source is another entry.
"""

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from rtc_mjx import cache
from rtc_mjx.specialise.graph import Graph
from rtc_mjx.specialise.program import Program

ARGUMENTS = 3  # of a scalar operation, at most
NUMBER_BYTES = 16  # of a constant of any type
Arrays = dict[str, np.ndarray]


def kept(fingerprint: str, make: Callable[[], Mapping[str, Program]]) -> dict[str, Program]:
    """Programs by name, read from the cache or made and put there.

    Args:
        fingerprint: hash of all that determines them.
        make: traces and folds them.

    Returns:
        The same programs either way, node for node. Those that bind an operation of JAX natively hold functions and are
        never stored: then all are made again in each process.
    """
    file = cache.folder() / "programs" / f"{fingerprint}.npz"
    arrays = cache.read_arrays(file)
    if arrays is not None:
        return _unpacked(arrays)
    programs = make()
    if any(p.graph.natives for p in programs.values()):
        return dict(programs)
    arrays = _packed(programs)
    cache.write_arrays(file, arrays)
    return _unpacked(arrays)


def _packed(programs: Mapping[str, Program]) -> Arrays:
    return {f"{name}/{part}": array for name, program in programs.items() for part, array in to_arrays(program).items()}


def _unpacked(arrays: Arrays) -> dict[str, Program]:
    programs: dict[str, Arrays] = {}
    for path, array in arrays.items():
        name, part = path.split("/")
        programs.setdefault(name, {})[part] = array
    return {name: to_program(held) for name, held in programs.items()}


def to_arrays(program: Program) -> Arrays:
    """A program as arrays; only what its outputs need, in the same order.

    Raises:
        ValueError: it binds operations natively; a function cannot be stored.
    """
    graph = program.graph
    if graph.natives:
        raise ValueError(f"{len(graph.natives)} operations are bound natively")
    nodes = sorted({*program.input_nodes, *graph.live(program.output_nodes)})
    number = {node: i for i, node in enumerate(nodes)}
    names, dtypes = sorted({graph.ops[n] for n in nodes}), sorted({graph.dtypes[n].name for n in nodes})
    arguments = np.full((len(nodes), ARGUMENTS), -1, np.int32)
    for i, node in enumerate(nodes):
        arguments[i, : len(graph.args[node])] = [number[a] for a in graph.args[node]]
    constants = b"".join(graph.values[n].tobytes().ljust(NUMBER_BYTES, b"\0") for n in nodes if graph.ops[n] == "const")
    about = {
        "ops": names,
        "dtypes": dtypes,
        "inputs": [(shape, dtype.name) for shape, dtype in program.inputs],
        "outputs": [(nodes.shape, dtype.name) for nodes, dtype in zip(program.outputs, program.types, strict=True)],
    }
    return {
        "about": np.array(json.dumps(about)),
        "ops": np.array([names.index(graph.ops[n]) for n in nodes], np.uint8),
        "dtypes": np.array([dtypes.index(graph.dtypes[n].name) for n in nodes], np.uint8),
        "arguments": arguments,
        "constants": np.frombuffer(constants, np.uint8).reshape(-1, NUMBER_BYTES),
        "input_numbers": np.array([graph.values[n] for n in nodes if graph.ops[n] == "input"], np.int32),
        "outputs": np.array([number[n] for n in program.output_nodes], np.int32),
    }


def to_program(arrays: Arrays) -> Program:
    """The program of `to_arrays`."""
    about: dict[str, Any] = json.loads(str(arrays["about"]))
    dtypes = [np.dtype(d) for d in about["dtypes"]]
    constants, numbers = iter(arrays["constants"]), iter(arrays["input_numbers"].tolist())
    graph = Graph()
    for op, dtype, arguments in zip(arrays["ops"].tolist(), arrays["dtypes"].tolist(), arrays["arguments"].tolist(), strict=True):
        name, kind = about["ops"][op], dtypes[dtype]
        if name == "const":
            graph.constant(next(constants)[: kind.itemsize].view(kind)[0], kind)
        elif name == "input":
            graph.input(next(numbers), kind)
        else:
            graph.add(name, tuple(a for a in arguments if a >= 0), kind)
    shapes = [tuple(shape) for shape, _ in about["outputs"]]
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    outputs = np.split(arrays["outputs"].astype(np.int64), ends[:-1])
    return Program(
        graph,
        tuple((tuple(shape), np.dtype(d)) for shape, d in about["inputs"]),
        tuple(nodes.reshape(shape) for nodes, shape in zip(outputs, shapes, strict=True)),
        tuple(np.dtype(d) for _, d in about["outputs"]),
    )
