"""The header of a safetensors file, bounded before the library reads it: it is JSON."""

from __future__ import annotations

from pathlib import Path

MOST_BYTES = 16 << 20  # a model of many pieces has some kB


def check_header(path: Path) -> None:
    """Raise ValueError for a header of more than MOST_BYTES, and OSError where the file cannot be read."""
    if not path.is_file():
        raise OSError("no such file")
    with open(path, "rb") as file:
        if (size := int.from_bytes(file.read(8), "little")) > MOST_BYTES:
            raise ValueError(f"a header of {size} bytes; {MOST_BYTES} at most are read")
