"""Memory that this process takes, as tests bound it."""

import tracemalloc
from collections.abc import Callable
from pathlib import Path

STATUS = Path("/proc/self/status")


def resident_bytes(kind: str) -> int:
    """Return the bytes in memory of a kind of pages that Linux counts: RssFile of files, RssAnon of nothing else."""
    return 1024 * int(next(line for line in STATUS.read_text().splitlines() if line.startswith(kind)).split()[1])


def peak_bytes(call: Callable[[], object]) -> int:
    """Return the most bytes that a call holds at a time, of Python's and NumPy's."""
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
