"""Files, folders and globs -> a stream of recordings. What a file is, is told by its content, never by its name."""

import contextlib
import glob
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from rtc_mjx.errors import UsageError
from rtc_mjx.logs import gpudrive, messages, scenarionet, tf_example, tfrecord, womd
from rtc_mjx.logs.recording import Kind, Recording, refuse_if

KINDS: tuple[Kind, ...] = get_args(Kind)
LARGEST = 64 * 2**20  # bytes of a file that is read at once (JSON, pickle); real ones have up to twenty million
SHOWN = 64  # bytes of a file that tell what it is
UNFORESEEN = "it is damaged in a way that no reader has foreseen"
SHOWN_OF_CAUSE = 200  # characters
RECORDS = {"womd_scenario": womd.read, "womd_tf_example": tf_example.read}  # kinds of records in a TFRecord
WHOLE = {"gpudrive_json": gpudrive.read, "scenarionet": scenarionet.read}
MAGIC = {
    b"\x1f\x8b": "a gzip archive (unpack it first)", b"PK\x03\x04": "a zip archive", b"\x89PNG": "a PNG image", b"\x89HDF": "an HDF5 file",
    b"%PDF": "a PDF document", b"\x93NUMPY": "a numpy array", b"\xff\xd8\xff": "a JPEG image", b"BZh": "a bzip2 archive (unpack it first)",
    b"\xfd7zXZ": "an xz archive (unpack it first)", b"PAR1": "a Parquet file",
}  # fmt: skip


@dataclass(frozen=True)
class Foreign:
    """What a file is that is no recording; `certain` where its content says so, and not merely nothing we know."""

    what: str
    certain: bool


def files(paths: Iterable[str | Path]) -> list[tuple[Path, bool]]:
    """The files that paths name, each once, and whether somebody asked for just that file: not so for those that a folder or glob led to.

    Args:
        paths: files, folders (searched to the bottom, hidden files left out) or globs.

    Raises:
        UsageError: there is no such file, nothing matches, or a folder holds no file.
    """
    found: dict[Path, bool] = {}
    for path in paths:
        text = str(path)
        matches = [Path(text)] if os.path.exists(text) else [Path(m) for m in sorted(glob.glob(text, recursive=True))]
        if not matches:
            raise UsageError(f"{text}: {'no file matches' if glob.has_magic(text) else 'there is no such file or folder'}")
        for match in matches:
            if not match.is_dir():
                found[match] = os.path.exists(text) or found.get(match, False)
                continue
            inside = [f for f in sorted(match.rglob("*")) if f.is_file() and not _hidden(f.relative_to(match))]
            if not inside:
                raise UsageError(f"{match}: the folder holds no files")
            for file in inside:
                found.setdefault(file, False)
    return list(found.items())


def _hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def kind_of(file: Path) -> Kind | Foreign:
    """What a file is, by its content.

    Raises:
        UsageError: it cannot be read, or is empty.
    """
    with _reading(file):
        return _kind_of(file)


@contextlib.contextmanager
def _reading(file: Path) -> Iterator[None]:
    """One line where the disk or the permissions fail.

    Raises:
        UsageError: the file cannot be read.
    """
    try:
        yield
    except OSError as error:
        raise UsageError(f"{file}: it cannot be read: {error.strerror or error}") from error


def _kind_of(file: Path) -> Kind | Foreign:
    refuse_if(not file.is_file(), str(file), "it is no file")
    with file.open("rb") as opened:
        start = opened.read(SHOWN)
    refuse_if(not start, str(file), "the file is empty")
    if tfrecord.is_tfrecord(start):
        return _record_kind(file)
    known = next((what for magic, what in MAGIC.items() if start.startswith(magic)), None)
    if known:
        return Foreign(known, True)
    if start[:1] == b"\x80" and start[1:2] in (b"\x02", b"\x03", b"\x04", b"\x05"):
        return "scenarionet"
    text = start.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text.startswith(b"{"):
        return _json_kind(file)
    return Foreign("text", True) if _is_text(start) else _binary_kind(file)


def _record_kind(file: Path) -> Kind | Foreign:
    """Of a TFRecord, by its first record: field 1 of an Example holds named features."""
    payload = next(tfrecord.records(file))
    features = _parses(messages.Example, payload)
    if features is not None and any(e.key.startswith((b"state/", b"roadgraph_samples/")) for e in features.features.feature):
        return "womd_tf_example"
    if features is not None and any(len(e.key) for e in features.features.feature):
        return Foreign("a TFRecord of tf.Examples that are not those of the Waymo motion dataset", True)
    scenario = _parses(messages.Scenario, payload)
    if scenario is not None and (len(scenario.tracks) or len(scenario.map_features)):
        return "womd_scenario"
    return Foreign("a TFRecord, but neither of Scenario protos nor of tf.Examples", True)


def _parses(message: Any, payload: bytes) -> Any:
    try:
        return womd.parsed(message, payload, "")
    except UsageError:
        return None


def _json_kind(file: Path) -> Kind | Foreign:
    """JSON that somebody wrote for something else names neither objects nor roads."""
    data = _whole(file)
    return "gpudrive_json" if b'"objects"' in data or b'"roads"' in data else Foreign("JSON without objects and roads", True)


def _binary_kind(file: Path) -> Foreign:
    """A bare protocol buffer, such as a Sim Agents submission, or nothing we know."""
    data = file.read_bytes() if file.stat().st_size < LARGEST else b""
    if data and _parses(messages.Anything, data) is not None:
        what = "a protocol buffer on its own, not in a TFRecord (a Sim Agents submission is scored by python -m rtc_mjx.challenge)"
        return Foreign(what, True)
    return Foreign("none of them (or damaged at its start)", False)


def _is_text(start: bytes) -> bool:
    try:
        return start.decode("utf-8").replace("\n", "").replace("\t", "").replace("\r", "").isprintable()
    except UnicodeDecodeError as error:
        return error.start > SHOWN - 4 and start[: error.start].decode("utf-8").isprintable()


def _whole(file: Path) -> bytes:
    size = file.stat().st_size
    refuse_if(size > LARGEST, str(file), f"it has {size} bytes; files of this kind are read up to {LARGEST}")
    return file.read_bytes()


def recordings(file: Path, kind: Kind | None = None) -> Iterator[Recording]:
    """The recordings of a file, one after the other; one is in memory at a time.

    Args:
        file: the file.
        kind: what it has to be; by default whatever it is.

    Raises:
        UsageError: it is no recording, of another kind, or damaged; recordings before the damage have been given by then.
    """
    found = kind_of(file)
    if isinstance(found, Foreign):
        raise UsageError(f"{file}: a recording is expected ({', '.join(KINDS)}); this is {found.what}")
    refuse_if(kind is not None and kind != found, str(file), f"{kind} is expected; this is {found}")
    with _reading(file):
        if found in WHOLE:
            yield _made(WHOLE[found], _whole(file), str(file))
            return
        for number, payload in enumerate(tfrecord.records(file)):
            yield _made(RECORDS[found], payload, f"{file}, record {number}")


def _made(reader: Callable[[bytes, str], Recording], data: bytes, source: str) -> Recording:
    """What a reader makes of a file or record.

    The readers say what is wrong wherever they have thought of it. What they have not, still has to name the file and must not end a
    conversion of thousands of files; the traceback stays below the error. `MemoryError` is passed on: it is the machine's and not
    necessarily the file's, and to go on from there helps nobody.

    Raises:
        UsageError: the data are no recording.
    """
    try:
        return reader(data, source)
    except (UsageError, MemoryError):
        raise
    except Exception as error:
        cause = (str(error).splitlines() or [""])[0][:SHOWN_OF_CAUSE]
        raise UsageError(f"{source}: {UNFORESEEN} ({type(error).__name__}: {cause})") from error


def stream(paths: Iterable[str | Path]) -> Iterator[Recording]:
    """The recordings of all files that paths name; what a folder holds beside recordings is passed over.

    Raises:
        UsageError: as `files` and `recordings`.
    """
    for file in recorded(paths):
        yield from recordings(file)


def recorded(paths: Iterable[str | Path]) -> Iterator[Path]:
    """The files that paths name, without those in folders that are plainly something else.

    Raises:
        UsageError: as `files` and `kind_of`.
    """
    for file, asked in files(paths):
        found = kind_of(file)
        if asked or not (isinstance(found, Foreign) and found.certain):
            yield file
