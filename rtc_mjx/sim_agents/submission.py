"""Submissions to the Waymo Open Sim Agents Challenge: files of simulated scenes, told apart by the scenario they belong to.

file -> where each scenario's rollouts are -> on demand, one scenario at a time: ids and poses. A real file has hundreds of scenarios, two
million bytes each, so it is not read at once.
"""

import itertools
import mmap
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rtc_mjx.errors import UsageError
from rtc_mjx.logs.messages import declare
from rtc_mjx.logs.read import files
from rtc_mjx.logs.recording import refuse_if
from rtc_mjx.logs.window import FARTHEST
from rtc_mjx.logs.womd import parsed

FIELDS = ("center_x", "center_y", "center_z", "heading")
MESSAGES = declare({
    "ScenarioRollouts": {"scenario_id": (1, "bytes"), "joint_scenes": (2, "[JointScene]")},
    "JointScene": {"simulated_trajectories": (1, "[SimulatedTrajectory]")},
    "SimulatedTrajectory": {**{name: (2 + i, "[float]") for i, name in enumerate(FIELDS)}, "object_id": (6, "int32")},
    "Named": {"scenario_id": (1, "bytes")},
})  # fmt: skip
ROLLOUTS = 1  # field of a SimAgentsChallengeSubmission: one ScenarioRollouts each
VARINT, BYTES, FIXED = 0, 2, {1: 8, 5: 4}  # wire types; how many bytes those of a fixed length have
NONE = "a Sim Agents submission is expected (SimAgentsChallengeSubmission or ScenarioRollouts); this"
Buffer = bytes | mmap.mmap
MOST_ROLLOUTS = 1024  # of a scenario; the challenge asks for 32
MOST_FIELDS = 100_000  # of a file; those of the challenge have some hundred


@dataclass(frozen=True)
class Place:
    """Where a file has the rollouts of one scenario: bytes `start` to `end`."""

    file: Path
    start: int
    end: int


@dataclass(frozen=True)
class Rollouts:
    """What was simulated of one scenario.

    Attributes:
        source: the file, and the scenario in it.
        ids: of the agents.
        pose: x, y, z in m, in the recording's frame, and heading in rad.
    """

    source: str
    ids: tuple[str, ...]
    pose: Float[np.ndarray, "rollouts agents times 4"]


def places(paths: Iterable[str | Path]) -> dict[str, Place]:
    """Where the rollouts of each scenario are, by its id.

    Args:
        paths: files, folders or globs; each file a SimAgentsChallengeSubmission or a single ScenarioRollouts.

    Raises:
        UsageError: there is no such file, it is no submission, or two have the same scenario.
    """
    found: dict[str, Place] = {}
    for file, _ in files(paths):
        for name, place in _of_file(file):
            if name in found:
                raise UsageError(f"{file}: scenario {name} has rollouts already in {found[name].file}; one set of each is expected")
            found[name] = place
    return found


def rollouts(place: Place) -> Rollouts:
    """The rollouts of one scenario.

    Raises:
        UsageError: they are damaged, or do not hold together.
    """
    with place.file.open("rb") as opened:
        opened.seek(place.start)
        payload = opened.read(place.end - place.start)
    held = parsed(MESSAGES["ScenarioRollouts"], payload, str(place.file))
    name = held.scenario_id.decode("utf-8", "replace")
    source, count = f"{place.file}, scenario {name}", len(held.joint_scenes)
    refuse_if(not 0 < count <= MOST_ROLLOUTS, source, f"it has {count} rollouts; 1 to {MOST_ROLLOUTS} are read, the challenge asks for 32")
    scenes = [_scene(scene.simulated_trajectories, f"{source}, rollout {i}") for i, scene in enumerate(held.joint_scenes)]
    ids = tuple(sorted(scenes[0]))
    for i, scene in enumerate(scenes):
        other = sorted(scene.keys() ^ scenes[0].keys())
        refuse_if(bool(other), source, f"rollout {i} has other agents than the first: {', '.join(other[:5])}")
    lengths = sorted({len(track) for scene in scenes for track in scene.values()})
    refuse_if(len(lengths) > 1, source, f"trajectories have {lengths[0]} to {lengths[-1]} times; all need as many")
    return Rollouts(source, ids, np.array([[scene[name] for name in ids] for scene in scenes]))


def _scene(tracks: Any, source: str) -> dict[str, np.ndarray]:
    """The trajectories of one rollout, by the agent's id."""
    out: dict[str, np.ndarray] = {}
    for track in tracks:
        name, lengths = str(track.object_id), {field: len(getattr(track, field)) for field in FIELDS}
        refuse_if(name in out, source, f"agent {name} is there twice")
        told = ", ".join(f"{field} {count}" for field, count in lengths.items())
        refuse_if(len(set(lengths.values())) > 1, source, f"agent {name} has coordinates of different lengths: {told}")
        out[name] = np.stack([np.array(getattr(track, field), np.float64) for field in FIELDS], axis=-1)
        refuse_if(not np.all(np.abs(out[name]) < FARTHEST), source, f"agent {name} has poses that are not finite or beyond 1,000 km")
    refuse_if(not out, source, "it has no agents")
    return out


def _of_file(file: Path) -> Iterator[tuple[str, Place]]:
    """The scenarios of one file, and where it has them.

    Raises:
        UsageError: it is no submission.
    """
    try:
        with file.open("rb") as opened:
            refuse_if(not os.fstat(opened.fileno()).st_size, str(file), "the file is empty")
            with mmap.mmap(opened.fileno(), 0, access=mmap.ACCESS_READ) as data:
                fields = list(itertools.islice(_fields(data, str(file)), MOST_FIELDS + 1))
                refuse_if(len(fields) > MOST_FIELDS, str(file), f"{NONE} has more than {MOST_FIELDS} fields")
                # field 2 is one rollout in a ScenarioRollouts, and a number in a submission
                single = any(number == 2 and kind == BYTES for number, kind, _, _ in fields)
                spans = [(0, len(data))] if single else [span for number, kind, *span in fields if (number, kind) == (ROLLOUTS, BYTES)]
                refuse_if(not spans, str(file), f"{NONE} has no rollouts")
                for start, end in spans:
                    yield _name(data[start:end], str(file)), Place(file, start, end)
    except OSError as error:
        raise UsageError(f"{file}: it cannot be read: {error.strerror}") from error


def _name(payload: bytes, source: str) -> str:
    """The scenario that rollouts are of."""
    try:
        name = parsed(MESSAGES["Named"], payload, source).scenario_id.decode("utf-8")
    except (UsageError, UnicodeDecodeError) as error:
        raise UsageError(f"{source}: {NONE} holds something else") from error
    refuse_if(not name, source, f"{NONE} does not name the scenario of its rollouts")
    return str(name)


def _fields(data: Buffer, source: str) -> Iterator[tuple[int, int, int, int]]:
    """The fields of a message, none of them read: number, wire type, where its content begins and ends.

    Raises:
        UsageError: it is no message.
    """
    at = 0
    while at < len(data):
        begun = at
        key, at = _varint(data, at)
        number, kind = key >> 3, key & 7
        if kind == VARINT:
            start, (_, at) = at, _varint(data, at)
        elif kind == BYTES:
            length, start = _varint(data, at)
            at = start + length
        else:
            start, at = at, at + FIXED.get(kind, len(data))
        broken = at > len(data) or number < 1
        refuse_if(broken, source, f"{NONE} does not hold together at byte {begun} of {len(data)}: damaged, or another file")
        yield number, kind, start, at


def _varint(data: Buffer, at: int) -> tuple[int, int]:
    """A number of up to ten bytes, and where it ends; beyond the data where there is none."""
    value = 0
    for i in range(10):
        if at + i >= len(data):
            break
        byte = data[at + i]
        value |= (byte & 0x7F) << (7 * i)
        if byte < 0x80:
            return value, at + i + 1
    return 0, len(data) + 1
