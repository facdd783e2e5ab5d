"""Writing a file whole or not at all."""

import os
import tempfile
from pathlib import Path


def write_whole(file: Path, text: str) -> None:
    """Writes beside and renames: whoever reads sees the old text or the new one, never half of it."""
    part = file.with_name(f".{file.name}.part")
    part.write_text(text)
    os.replace(part, file)


def write_bytes_whole(file: Path, data: bytes) -> None:
    """The same for bytes, on the disk before anybody sees them, and with any number of writers at once.

    Raises:
        OSError: there is no room or no leave to write; nothing is left behind.
    """
    with tempfile.NamedTemporaryFile(dir=file.parent, prefix=".", suffix=".part", delete=False) as part:
        try:
            part.write(data)
            part.flush()
            os.fsync(part.fileno())
            os.replace(part.name, file)
        except OSError:
            os.unlink(part.name)
            raise
