"""A lock file: one process at a time works on a folder."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import writing


@contextmanager
def locked(file: Path, where: Path | str, expected: str) -> Iterator[None]:
    """Hold the lock on `file`, which is created if need be.

    The system releases the lock when the process ends, however it ends. Raises UserError where another process holds
    it; `where` and `expected` name for the error what is locked, such as "a folder that no other run uses".
    """
    with writing(file.parent):
        file.parent.mkdir(parents=True, exist_ok=True)
        opened = open(file, "w")
    with opened:
        try:
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise problem(where, expected, "a run in progress", "wait for it") from None
        yield
