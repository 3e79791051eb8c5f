"""Progress of long work in bytes: a bar at a terminal, elsewhere a line now and then."""

from __future__ import annotations

import time
from threading import Lock
from types import TracebackType

from rich.console import Console

_LINE_EVERY_S = 20.0


def size_text(n_bytes: float) -> str:
    """Return a size for people, in decimal units.

    >>> size_text(1_234_567)
    '1.2 MB'
    """
    for unit in ("B", "kB", "MB", "GB"):
        if n_bytes < 1000:
            return f"{n_bytes:.0f} {unit}" if unit == "B" else f"{n_bytes:.1f} {unit}"
        n_bytes /= 1000
    return f"{n_bytes:.1f} TB"


class ByteProgress:
    """Bytes done of a known number, with the rate and an estimate of the time left. Threads may share it."""

    def __init__(self, title: str, total: int) -> None:
        from rich.progress import BarColumn, DownloadColumn, Progress, TextColumn, TransferSpeedColumn
        from rich.progress import TimeRemainingColumn as Left

        self.title, self.total, self.done, self.skipped = title, total, 0, 0
        self._console = Console(stderr=True, highlight=False)
        columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
        self._bars = Progress(
            *columns, TextColumn("left"), Left(), console=self._console, disable=not self._console.is_terminal
        )
        self._task = self._bars.add_task(title, total=total)
        self._lock = Lock()

    def __enter__(self) -> ByteProgress:
        self._bars.start()
        self.started = self._said = time.monotonic()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.seconds = time.monotonic() - self.started
        self._bars.stop()

    def advance(self, n_bytes: int) -> None:
        """Count bytes that were just done."""
        with self._lock:
            self.done += n_bytes
            self._bars.advance(self._task, n_bytes)
            now = time.monotonic()
            if not self._console.is_terminal and now - self._said >= _LINE_EVERY_S:
                self._said = now
                rate = (self.done - self.skipped) / (now - self.started)
                left = f", about {(self.total - self.done) / rate:.0f} s left" if rate > 0 else ""
                rest = f"{size_text(self.done)} of {size_text(self.total)}, {size_text(rate)}/s{left}"
                self._console.print(f"{self.title}: {rest}", markup=False)

    def skip(self, n_bytes: int) -> None:
        """Count bytes that an earlier run did."""
        with self._lock:
            self.done += n_bytes
            self.skipped += n_bytes
            self._bars.advance(self._task, n_bytes)
