"""A lock file: one process at a time works on a folder."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import writing


@contextmanager
def locked(
    file: Path, where: Path | str, expected: str, wait_s: float = 0.0, temporary: bool = False
) -> Iterator[None]:
    """Hold the lock on `file`, which is created if need be, and with `temporary` removed at the end.

    The system releases the lock when the process ends, however it ends. Raises UserError where another process still
    holds it after `wait_s` seconds; `where` and `expected` name for the error what is locked, such as "a folder that no
    other run uses".
    """
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
        if temporary:
            file.unlink(missing_ok=True)
        lock.release()
