"""TFRecord files: length (u64), masked crc32c of it, payload, masked crc32c of that, little endian; one record in memory at a time."""

import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import google_crc32c

from rtc_mjx.errors import UsageError
from rtc_mjx.logs.recording import refuse_if

HEADER, FOOTER = struct.Struct("<QI"), struct.Struct("<I")
LARGEST = 16 * 2**20  # bytes of a record; those of the Waymo Open Motion Dataset have one or two million


def masked(data: bytes) -> int:
    """The checksum as TFRecord files hold it: crc32c, turned by 15 bits and moved, so that checksums of checksums differ."""
    crc = int(google_crc32c.value(data))
    return (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF


def is_tfrecord(start: bytes) -> bool:
    """Whether a file that starts like this is one: the checksum of the first length is right."""
    return len(start) >= HEADER.size and HEADER.unpack_from(start)[1] == masked(start[:8])


def records(file: Path) -> Iterator[bytes]:
    """The payloads, one after the other; an empty file has none.

    Raises:
        UsageError: a checksum is wrong, the file ends within a record, or a record claims more bytes than there are.
    """
    with file.open("rb") as opened:
        end, number = os.fstat(opened.fileno()).st_size, 0
        while opened.tell() < end:
            yield _record(opened, end, f"{file}, record {number}")
            number += 1


def _record(opened: BinaryIO, end: int, source: str) -> bytes:
    at = opened.tell()
    head = opened.read(HEADER.size)
    refuse_if(len(head) < HEADER.size, source, f"the file ends within the record's head, at byte {at} of {end}")
    length, crc = HEADER.unpack(head)
    refuse_if(crc != masked(head[:8]), source, f"the checksum of its length is wrong, at byte {at}: damaged")
    left = end - opened.tell() - FOOTER.size
    refuse_if(length > left, source, f"it should have {length} bytes, but the file ends after {max(0, left)}: truncated")
    refuse_if(length > LARGEST, source, f"it has {length} bytes; more than {LARGEST} are not read")
    payload, foot = opened.read(length), opened.read(FOOTER.size)
    if len(payload) < length or len(foot) < FOOTER.size:
        raise UsageError(f"{source}: the file became shorter while it was read")
    refuse_if(FOOTER.unpack(foot)[0] != masked(payload), source, "its checksum is wrong: damaged")
    return payload
