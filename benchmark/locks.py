"""A lock file: one process at a time works on a folder."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import writing

_RETRY_S = 0.05


@contextmanager
def locked(
    file: Path, where: Path | str, expected: str, wait_s: float = 0.0, temporary: bool = False
) -> Iterator[None]:
    """Hold the lock on `file`, which is created if need be, and with `temporary` removed at the end.

    The system releases the lock when the process ends, however it ends. Raises UserError where another process still
    holds it after `wait_s` seconds; `where` and `expected` name for the error what is locked, such as "a folder that no
    other run uses".
    """
    with writing(file.parent):
        file.parent.mkdir(parents=True, exist_ok=True)
        opened = open(file, "w")
    with opened:
        deadline = time.monotonic() + wait_s
        while not _take(opened.fileno()):
            if time.monotonic() >= deadline:
                found = "a run in progress" + (f" for {wait_s:.0f} s" if wait_s else "")
                raise problem(where, expected, found, "wait for it")
            time.sleep(_RETRY_S)
        try:
            yield
        finally:
            if temporary:
                file.unlink(missing_ok=True)


def _take(descriptor: int) -> bool:
    """Take the lock if nobody holds it; return whether it was taken."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return os.fstat(descriptor).st_nlink > 0  # else another process removed it since: who comes now locks another file
