"""Changes that tests make to files, and a folder's files as bytes, to see that nothing else changed."""

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.files import write_json


def edit_json(path: Path, change: Callable[[Any], object]) -> None:
    """Change the value of a JSON file in place."""
    value = json.loads(path.read_text())
    change(value)
    write_json(path, value)


def flip_bit(path: Path, byte: int, bit: int = 0) -> None:
    """Flip one bit of a file; negative bytes count from its end."""
    data = bytearray(path.read_bytes())
    data[byte] ^= 1 << bit
    path.write_bytes(data)


def leave_part(folder: Path) -> Path:
    """Leave in a folder what a killed process leaves of a file that it wrote; return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / ".half.1.part.json"
    path.write_bytes(b"{")
    return path


def files_in(folder: Path) -> dict[str, bytes]:
    """Return relative path -> bytes of every file, hidden ones included."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def exchange(scene: Path, name: str, write: Callable[[Path], object]) -> None:
    """Put another file in the place of a scene's. The manifest gets its bytes and keeps the first content."""
    write(scene / name)
    data = (scene / name).read_bytes()
    facts = {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    edit_json(scene / "manifest.json", lambda manifest: manifest["files"][name].update(facts))
