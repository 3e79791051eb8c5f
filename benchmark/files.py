"""Files that are whole or absent: atomic writes, strict JSON, hashes.

A killed process leaves at most a `*.part` file behind, never a half-written result under its final name.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.errors import problem

_ROOM = ("room for the file", "free some disk space, or choose another folder")
_ACCESS = ("a folder that may be written to", "change its permissions, or choose another folder")
_FOLDERS = ("folders on the way to the file", "remove what is there instead, or choose another folder")
_FAILURES = {  # what writing expected, and what to do; other errors are the program's
    errno.ENOSPC: _ROOM,
    errno.EDQUOT: _ROOM,
    errno.EFBIG: _ROOM,
    errno.EACCES: _ACCESS,
    errno.EPERM: _ACCESS,
    errno.EROFS: _ACCESS,
    errno.ENOTDIR: _FOLDERS,
    errno.EEXIST: _FOLDERS,
    errno.EISDIR: ("a file's name", "remove the folder of that name, or choose another name"),
    errno.ENAMETOOLONG: ("a name that the file system takes", "choose a shorter one"),
}


def user_cache() -> Path:
    """Return the user's cache folder of this package: `spike4dgs` in XDG_CACHE_HOME or ~/.cache."""
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(os.path.expanduser(base)) / "spike4dgs"


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn what the system says while `path` is written (disk full, no permission, ...) into a UserError."""
    try:
        yield
    except OSError as e:
        if e.errno not in _FAILURES:
            raise
        expected, fix = _FAILURES[e.errno]
        raise problem(path, expected, os.strerror(e.errno).lower(), fix) from e


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success fsync it and rename it into place.

    The temporary name keeps the suffix, because image writers choose the format by it. Raises UserError where the
    system cannot write the file; whatever goes wrong, nothing half written stays behind.
    """
    part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield part
            with open(part, "rb+") as f:
                os.fsync(f.fileno())
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)


def check_new(folder: Path) -> None:
    """Raise UserError unless `folder` is empty or does not exist yet: what is there is never overwritten."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise problem(folder, "a new or empty folder", "something there", "choose another --out or remove it")


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` atomically."""
    with atomic_path(path) as part:
        part.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically, with sorted keys; NaN and infinity are refused (ValueError), not written."""
    write_text(path, json.dumps(value, indent=2, sort_keys=True, allow_nan=False) + "\n")


def read_json(path: Path, what: str) -> dict[str, Any]:
    """Read a JSON object. `what` names the kind of file for the error.

    Raises UserError where the file is missing, is not JSON, or is not an object.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except FileNotFoundError:
        raise problem(path, what, "no such file", "check the path") from None
    except IsADirectoryError:
        raise problem(path, what, "a folder", "check the path") from None
    except (ValueError, RecursionError) as e:  # bad syntax, bad UTF-8, NaN or infinity
        raise problem(path, f"{what} (JSON)", f"damaged text ({e})", "restore the file or make it again") from None
    if not isinstance(value, dict):
        raise problem(path, f"{what} (a JSON object)", type(value).__name__, "check that it is the right file")
    return value


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON number")


def sha256_file(path: Path) -> str:
    """Return the SHA-256 of a file's bytes as hex digits, read in blocks."""
    with open(path, "rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


def sha256_json(value: Any) -> str:
    """Return the SHA-256 of a JSON value in canonical form (sorted keys, no spaces), for the runner's content keys."""
    return hashlib.sha256(
        json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    ).hexdigest()
