"""Files that are whole or absent: atomic writes, strict JSON, hashes, locks.

A killed process leaves at most a `*.part` file behind, never a half-written result under its final name.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout
from platformdirs import user_cache_path

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.json_values.text import json_text, parse_json

MOST_BYTES = 16 << 20  # of a text: a record of many scenes has some MB; parsed, JSON can take 25 times its size
_RUST_ERROR = re.compile(r"\(os error ([0-9]+)\)")

_ROOM = ("room for the file", "free some disk space, or choose another folder")
_ACCESS = ("a folder that may be written to", "change its permissions, or choose another folder")
_FOLDERS = ("folders on the way to the file", "remove what is there instead, or choose another folder")
_SYSTEM = ("/proc/", "/sys/")  # where nothing can be made, and the system says that there is no such file
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
    """Return the user's cache folder of this package, on Linux `spike4dgs` in XDG_CACHE_HOME or ~/.cache."""
    return Path(user_cache_path("spike4dgs", appauthor=False))


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn what the system says while `path` is written (disk full, no permission, ...) into a UserError."""
    try:
        yield
    except OSError as e:
        if (failure := failure_of(e, path)) is None:
            raise
        raise failure from e
    except Exception as e:
        told = _RUST_ERROR.search(str(e))  # safetensors raises errors of another kind
        if told is None or (failure := failure_of(OSError(int(told[1]), ""), path)) is None:
            raise
        raise failure from e


def check_writable(folder: Path) -> None:
    """Raise UserError where no file can be written into a folder, new or not: before long work, not after it.

    A new one is not made: what is still to be looked at may be wrong too.
    """
    with writing(folder):
        there = next(path for path in (folder, *folder.parents) if path.exists())
        trial = Path(tempfile.mkdtemp(".part", f".{os.getpid()}.", there))
        try:
            (trial / folder.relative_to(there)).mkdir(parents=True, exist_ok=True)
        finally:
            shutil.rmtree(trial, ignore_errors=True)


def check_file(out: Path) -> None:
    """Raise UserError where no file `out` can be written: before long work, not after it. No folder is made."""
    if out.is_dir():
        raise problem("--out", "the name of a file", f"the folder {out}", "name a file in it")
    check_writable(out.parent)


def failure_of(error: OSError, path: Path | str) -> UserError | None:
    """Return what the system said while `path` was written as a UserError; None for an error that is the program's."""
    nowhere = error.errno == errno.ENOENT and str(path).startswith(_SYSTEM)
    if error.errno is None or (error.errno not in _FAILURES and not nowhere):
        return None
    expected, fix = _ACCESS if nowhere else _FAILURES[error.errno]
    return problem(path, expected, os.strerror(error.errno).lower(), fix)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success fsync it and rename it into place.

    The temporary name keeps the suffix, because image writers choose the format by it. The file has the mode of any new
    file, whatever wrote it. Raises UserError where the system cannot write the file; whatever goes wrong, nothing half
    written stays behind.
    """
    part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield part
            with open(part, "rb+") as f:
                os.fsync(f.fileno())
            _open_up(part)
            os.replace(part, path)
        finally:
            part.unlink(missing_ok=True)


def _open_up(part: Path) -> None:
    """Give a file that only its owner may read the mode of any new file beside it, which the umask decides.

    Writers that go through a temporary file of their own, as safetensors does, leave 0600.
    """
    if os.name != "posix" or stat.S_IMODE(part.stat().st_mode) != 0o600:
        return
    probe = part.with_name(f"{part.name}.mode")
    try:
        probe.touch()
        part.chmod(stat.S_IMODE(probe.stat().st_mode))
    finally:
        probe.unlink(missing_ok=True)


def check_new(folder: Path) -> None:
    """Raise UserError unless `folder` is empty or does not exist yet: what is there is never overwritten."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise problem(folder, "a new or empty folder", "something there", "choose another --out or remove it")


@contextmanager
def filling(folder: Path) -> Iterator[None]:
    """Fill a new folder; where that fails nothing half written stays there. Raises UserError unless it is new or empty.

    An empty folder that was there stays. For copies alone: what was recorded is kept, whatever happened.
    """
    check_new(folder)
    there = folder.is_dir()
    try:
        yield
    except BaseException:
        with suppress(OSError):
            for path in folder.iterdir() if there else [folder]:
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                elif there:
                    path.unlink(missing_ok=True)
        raise


def write_bytes(path: Path, data: bytes) -> None:
    """Write `data` atomically."""
    with atomic_path(path) as part:
        part.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically, with sorted keys; NaN and infinity are refused (ValueError), not written."""
    write_text(path, json_text(value))


def read_text(path: Path, what: str, most_bytes: int = MOST_BYTES) -> str:
    """Read UTF-8 text. `what` names the kind of file for the error.

    Raises UserError where `read_bytes` does, and ValueError (UnicodeError) for bytes that are no UTF-8.
    """
    return read_bytes(path, what, most_bytes).decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")


def read_bytes(path: Path, what: str, most_bytes: int = MOST_BYTES) -> bytes:
    """Read a file. `what` names its kind for the error.

    Raises UserError where the file is missing, unreadable or no plain file, and where it has more than `most_bytes`.
    """
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise problem(path, what, "a folder", "check the path")
        if not stat.S_ISREG(status.st_mode):
            raise problem(path, what, "no plain file", "check the path")
        if status.st_size > most_bytes:
            raise problem(path, f"{what}, {most_bytes} bytes at most", f"{status.st_size}", "check the path")
        return path.read_bytes()
    except FileNotFoundError:
        raise problem(path, what, "no such file", "check the path") from None
    except OSError as e:
        raise problem(path, what, (e.strerror or "an unreadable file").lower(), "check the path") from None


def read_json(path: Path, what: str, most_bytes: int = MOST_BYTES) -> dict[str, Any]:
    """Read a JSON object. `what` names the kind of file for the error.

    Raises UserError where the file is missing, is not JSON, is not an object, has more than `most_bytes`, or breaks a
    bound of `parse_json`.
    """
    return json_object(read_bytes(path, what, most_bytes), path, what)


def json_object(data: bytes, path: Path, what: str) -> dict[str, Any]:
    """Return the JSON object that the bytes of the file `path` are, as `read_json` does."""
    try:
        value = parse_json(data.decode("utf-8"))
    except ValueError as e:
        raise problem(path, f"{what} (JSON)", f"damaged text ({e})", "restore the file or make it again") from None
    if not isinstance(value, dict):
        raise problem(path, f"{what} (a JSON object)", type(value).__name__, "check that it is the right file")
    return value


def sha256_file(path: Path) -> str:
    """Return the SHA-256 of a file's bytes as hex digits, read in blocks."""
    with open(path, "rb") as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


def sha256_json(value: Any) -> str:
    """Return the SHA-256 of a JSON value in canonical form (sorted keys, no spaces), for the runner's content keys."""
    return hashlib.sha256(
        json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    ).hexdigest()


@contextmanager
def locked(
    file: Path, where: Path | str, expected: str, wait_s: float = 0.0, temporary: bool = False
) -> Iterator[None]:
    """Hold the lock on `file`, which is created if need be, and with `temporary` removed at the end.

    The system releases the lock when the process ends, however it ends. `where` and `expected` name for the error what
    is locked, such as "a folder that no other run uses". Raises UserError where another process still holds it after
    `wait_s` seconds, and where `file` is no plain file.
    """
    _check_lock(file)
    lock = FileLock(file, timeout=wait_s)
    try:
        with writing(file.parent):
            file.parent.mkdir(parents=True, exist_ok=True)
            lock.acquire()
    except Timeout:
        found = "a run in progress" + (f" for {wait_s:.0f} s" if wait_s else "")
        raise problem(where, expected, found, "wait for it") from None
    try:
        yield
    finally:
        if temporary and os.name != "nt":  # while it is held: later it may be another's
            file.unlink(missing_ok=True)
        lock.release()
        if temporary and os.name == "nt":  # where no open file can be removed
            with suppress(PermissionError):
                file.unlink(missing_ok=True)


def _check_lock(file: Path) -> None:
    """Raise UserError for a lock that is no plain file: a link's target would be emptied, a FIFO would wait forever."""
    try:
        mode = os.lstat(file).st_mode
    except OSError:  # none yet; what else is wrong shows when it is made
        return
    if not stat.S_ISREG(mode):
        found = "a symbolic link" if stat.S_ISLNK(mode) else "something else"
        raise problem(file, "a plain file, which is the folder's lock", found, "remove it")


_PART = re.compile(r"\..+\.[0-9]+\.part(\.[^.]+)?(\.mode)?")  # as in `atomic_path` and `SpikeWriter`


def visible(folder: Path, pattern: str) -> list[Path]:
    """Return a folder's files that fit a pattern, sorted, without hidden ones: those may be half written."""
    return sorted(path for path in folder.glob(pattern) if not path.name.startswith("."))


def remove_parts(folder: Path) -> None:
    """Remove what killed processes left half written in a folder and below it. The caller holds the folder's lock.

    Folders below it with a `.lock` of their own belong to other runs, which may be writing. A fit's process, which ends
    after its caller was killed, may remove folders meanwhile: `Path.rglob` would raise.
    """
    for inside, folders, names in os.walk(folder):
        folders[:] = [name for name in folders if not Path(inside, name, ".lock").exists()]
        for path in (Path(inside, name) for name in names if _PART.fullmatch(name)):
            if path.is_file():
                path.unlink(missing_ok=True)
