"""Converted recordings on disk, so that each file is read and converted once.

An entry is a folder named by a hash of the file's content, the options, this package's code and the versions of what it rests on: one
.npz a recording, and index.json, which is written last and holds the checksum of each and what the scenes are called. Without a whole
index there is no entry. Every file is written beside and renamed, and the same file gives the same bytes, so that two processes at once,
or a kill at any moment, can do no harm.
"""

import contextlib
import dataclasses
import hashlib
import io
import json
import logging
import time
from collections.abc import Callable, Container, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rtc_mjx import cache
from rtc_mjx.errors import UsageError
from rtc_mjx.files import write_bytes_whole
from rtc_mjx.logs.convert import Conversion, Converted, Options, convert
from rtc_mjx.logs.read import recorded, recordings
from rtc_mjx.logs.recording import Recording
from rtc_mjx.logs.road import Connectivity
from rtc_mjx.logs.scene import LoggedScene, RoadGraph

SOURCES = sorted(Path(__file__).parent.glob("*.py"))  # what reads and converts: where it changes, entries are others
INDEX = "index.json"
STALE = 3600.0  # s, after which a part that nobody finished is taken away
ROAD = tuple(f.name for f in dataclasses.fields(RoadGraph))
SCENE = tuple(f.name for f in dataclasses.fields(LoggedScene) if f.name != "road")
Told = Callable[[Recording, Conversion | UsageError], None]


@dataclass(frozen=True)
class Listed:
    """What one recording became, without its arrays.

    Attributes:
        file: where it was read.
        number: of the recording in its file.
        scenes: names of its scenes: scenario and track.
        connectivity: of its lanes.
        notes: as in `Conversion`.
        dropped: as in `Conversion`.
        refused: why nothing can be made of it.
    """

    file: Path
    number: int
    scenes: tuple[str, ...] = ()
    connectivity: Connectivity = "none"
    notes: dict[str, int] = dataclasses.field(default_factory=dict)
    dropped: dict[str, int] = dataclasses.field(default_factory=dict)
    refused: str = ""


def entry(file: Path, options: Options) -> Path:
    """Where the scenes of a file are kept; it reads the file for its hash."""
    with file.open("rb") as opened:
        content = hashlib.file_digest(opened, "sha256").hexdigest()
    made_by = {"options": dataclasses.asdict(options), "content": content}
    return cache.folder() / "recorded" / cache.fingerprint(made_by, SOURCES)


def scenes(paths: Iterable[str | Path], options: Options) -> Iterator[Converted]:
    """The scenes of all files, from their entries; entries that are not there or are damaged are made, and one recording is in memory.

    Raises:
        UsageError: as `read.stream`; or there is no scene in any of them.
    """
    count = 0
    for file in recorded(paths):
        for _, conversion in conversions(file, options):
            yield from conversion.scenes
            count += len(conversion.scenes)
    if not count:
        raise UsageError(none_of(paths, options))


def none_of(paths: Iterable[str | Path], options: Options) -> str:
    """What is said where there is no scene."""
    return f"{' '.join(str(p) for p in paths)}: no scene can be made of them with control '{options.control}'"


def listed(paths: Iterable[str | Path], options: Options) -> Iterator[Listed]:
    """What each recording of all files became, without arrays; entries that are not there are made, and what became nothing is said.

    Raises:
        UsageError: as `read.stream`.
    """
    for file in recorded(paths):
        folder = _kept(file, options)
        items = json.loads((folder / INDEX).read_text()) if folder else (_item(became) for _, became in converted(file, options))
        for number, item in enumerate(items):
            if "refused" in item:
                _log.warning("%s", item["refused"])
            yield Listed(file, number, tuple(item.pop("scenes", ())), **{k: v for k, v in item.items() if k not in ("file", "sha256")})


def conversions(file: Path, options: Options, wanted: Container[int] | None = None) -> Iterator[tuple[int, Conversion]]:
    """The recordings of a file that became something: the number of each and what; the others are said and passed over.

    Args:
        file: the file.
        options: of the conversion.
        wanted: the numbers that are asked for; all by default.

    Raises:
        UsageError: the file cannot be read as a recording.
    """
    if folder := _kept(file, options):
        for number, item in enumerate(json.loads((folder / INDEX).read_text())):
            if "refused" in item:
                _say(item["refused"], wanted)
            elif wanted is None or number in wanted:
                yield number, unpack((folder / item["file"]).read_bytes())
        return
    for number, (_, became) in enumerate(converted(file, options)):
        if isinstance(became, UsageError):
            _say(str(became), wanted)
        elif wanted is None or number in wanted:
            yield number, became


def _say(refused: str, wanted: Container[int] | None) -> None:
    """Why there is nothing of a recording; who asks for some of them has been told (`listed`)."""
    if wanted is None:
        _log.warning("%s", refused)


def _kept(file: Path, options: Options) -> Path | None:
    """The whole entry of a file, made if need be; None where nothing can be kept, which is said."""
    folder = entry(file, options)
    try:
        return folder if whole(folder) else build(file, options)
    except OSError as error:
        _log.warning("scenes of %s cannot be kept in %s, going on without: %s", file, folder.parent, error.strerror)
        return None


def whole(folder: Path) -> bool:
    """Whether there is an entry and none of it is damaged; damage is said."""
    index = folder / INDEX
    if not index.exists():
        return False
    try:
        held = [item for item in json.loads(index.read_bytes()) if "refused" not in item]
        damaged = [item["file"] for item in held if hashlib.sha256((folder / item["file"]).read_bytes()).hexdigest() != item["sha256"]]
    except (OSError, ValueError, KeyError, TypeError):
        damaged = [INDEX]
    if damaged:
        _log.warning("cache entry %s is damaged (%s); it is made anew", folder, damaged[0])
    return not damaged


def build(file: Path, options: Options, told: Told = lambda recording, became: None) -> Path:
    """Reads and converts a file and keeps its scenes.

    Args:
        file: the file.
        options: of the conversion.
        told: what is told about each recording as it is done.

    Returns:
        The entry's folder.

    Raises:
        UsageError: the file cannot be read as recordings; no entry is made.
        OSError: the entry cannot be written.
    """
    folder, items = entry(file, options), list[dict[str, Any]]()
    folder.mkdir(parents=True, exist_ok=True)
    _tidy(folder)
    for number, (recording, became) in enumerate(converted(file, options)):
        items.append(_item(became))
        if isinstance(became, Conversion):
            data, name = pack(became), f"{number:06d}.npz"
            write_bytes_whole(folder / name, data)
            items[-1] |= {"file": name, "sha256": hashlib.sha256(data).hexdigest()}
        told(recording, became)
    write_bytes_whole(folder / INDEX, json.dumps(items).encode())
    return folder


def converted(file: Path, options: Options) -> Iterator[tuple[Recording, Conversion | UsageError]]:
    """Each recording of a file with what it becomes, or why nothing."""
    for recording in recordings(file):
        try:
            yield recording, convert(recording, options)
        except UsageError as error:
            yield recording, error


def _item(became: Conversion | UsageError) -> dict[str, Any]:
    """What the index says of a recording: the fields of `Listed`."""
    if not isinstance(became, Conversion):
        return {"refused": str(became)}
    told = {"scenes": [held.name for held in became.scenes], "notes": became.notes, "dropped": became.dropped}
    return told | ({"connectivity": became.scenes[0].connectivity} if became.scenes else {})


def _tidy(folder: Path) -> None:
    """Takes away what a killed process left behind; another may do so at the same time."""
    for part in folder.glob(".*.part"):
        with contextlib.suppress(FileNotFoundError):
            if time.time() - part.stat().st_mtime > STALE:
                part.unlink()


def pack(conversion: Conversion) -> bytes:
    """The bytes of an .npz: the arrays of all scenes with a leading axis, and the rest as JSON."""
    rest = {
        "notes": conversion.notes,
        "dropped": conversion.dropped,
        "scenes": [
            {"name": s.name, "connectivity": s.connectivity, "users": s.users, "origin": s.origin.tolist()} for s in conversion.scenes
        ],
    }
    arrays: dict[str, Any] = {"rest": np.frombuffer(json.dumps(rest).encode(), np.uint8)}
    if conversion.scenes:
        arrays |= {name: np.stack([getattr(s.scene, name) for s in conversion.scenes]) for name in SCENE}
        arrays |= {f"road.{name}": np.stack([getattr(s.scene.road, name) for s in conversion.scenes]) for name in ROAD}
    out = io.BytesIO()
    np.savez(out, allow_pickle=False, **arrays)
    return out.getvalue()


def unpack(data: bytes) -> Conversion:
    """What was packed."""
    with np.load(io.BytesIO(data), allow_pickle=False) as held:
        arrays = dict(held)
    rest = json.loads(arrays["rest"].tobytes())
    made = []
    for i, one in enumerate(rest["scenes"]):
        road = RoadGraph(**{name: arrays[f"road.{name}"][i] for name in ROAD})
        scene = LoggedScene(road=road, **{name: arrays[name][i] for name in SCENE})
        made.append(Converted(scene, one["name"], np.array(one["origin"]), one["connectivity"], tuple(one["users"])))
    return Conversion(tuple(made), rest["notes"], rest["dropped"])


_log = logging.getLogger("rtc_mjx")
