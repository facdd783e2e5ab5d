"""Converted recordings on disk, so that each file is read and converted once.

An entry is a folder named by a hash of the file's content, the options and FORMAT: one .npz a recording, and index.json, which is
written last and holds the checksum of each. Without a whole index there is no entry. Every file is written beside and renamed, and the
same file gives the same bytes, so that two processes at once, or a kill at any moment, can do no harm.
"""

import contextlib
import dataclasses
import hashlib
import io
import json
import logging
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rtc_mjx import cache
from rtc_mjx.errors import UsageError
from rtc_mjx.files import write_bytes_whole
from rtc_mjx.logs.convert import Conversion, Converted, Options, convert
from rtc_mjx.logs.read import recorded, recordings
from rtc_mjx.logs.recording import Recording
from rtc_mjx.logs.scene import LoggedScene, RoadGraph

FORMAT = 1  # of the entries; raise it when conversion or layout change
INDEX = "index.json"
STALE = 3600.0  # s, after which a part that nobody finished is taken away
ROAD = tuple(f.name for f in dataclasses.fields(RoadGraph))
SCENE = tuple(f.name for f in dataclasses.fields(LoggedScene) if f.name != "road")
Told = Callable[[Recording, Conversion | UsageError], None]


def entry(file: Path, options: Options) -> Path:
    """Where the scenes of a file are kept; it reads the file for its hash."""
    content = hashlib.sha256(json.dumps([FORMAT, dataclasses.asdict(options)], sort_keys=True).encode())
    with file.open("rb") as opened:
        while block := opened.read(2**20):
            content.update(block)
    return cache.folder() / "recorded" / content.hexdigest()[:32]


def scenes(paths: Iterable[str | Path], options: Options) -> Iterator[Converted]:
    """The scenes of all files, from their entries; entries that are not there or are damaged are made, and one recording is in memory.

    Raises:
        UsageError: as `read.stream`; or there is no scene in any of them.
    """
    count = 0
    for file in recorded(paths):
        for conversion in conversions(file, options):
            yield from conversion.scenes
            count += len(conversion.scenes)
    if not count:
        raise UsageError(f"{' '.join(str(p) for p in paths)}: no scene can be made of them with control '{options.control}'")


def conversions(file: Path, options: Options) -> Iterator[Conversion]:
    """What each recording of a file became; those that became nothing are said and passed over.

    Raises:
        UsageError: the file cannot be read as a recording.
    """
    folder = entry(file, options)
    if not whole(folder):
        try:
            build(file, options)
        except OSError as error:
            _log.warning("scenes of %s cannot be kept in %s, going on without: %s", file, folder.parent, error.strerror)
            yield from _unkept(file, options)
            return
    for item in json.loads((folder / INDEX).read_text()):
        if "refused" in item:
            _log.warning("%s", item["refused"])
        else:
            yield unpack((folder / item["file"]).read_bytes())


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
    folder, items = entry(file, options), list[dict[str, str]]()
    folder.mkdir(parents=True, exist_ok=True)
    _tidy(folder)
    for number, (recording, became) in enumerate(converted(file, options)):
        if isinstance(became, Conversion):
            data, name = pack(became), f"{number:06d}.npz"
            write_bytes_whole(folder / name, data)
            items.append({"file": name, "sha256": hashlib.sha256(data).hexdigest()})
        else:
            items.append({"refused": str(became)})
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


def _unkept(file: Path, options: Options) -> Iterator[Conversion]:
    for _, became in converted(file, options):
        if isinstance(became, Conversion):
            yield became
        else:
            _log.warning("%s", became)


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
