"""Writing a file whole or not at all."""

import os
from pathlib import Path


def write_whole(file: Path, text: str) -> None:
    """Writes beside and renames: whoever reads sees the old text or the new one, never half of it."""
    part = file.with_name(f".{file.name}.part")
    part.write_text(text)
    os.replace(part, file)
