"""Real-time priority during a capture, so that no other program delays a reading thread for longer than its reads last.

Beside programs that keep all cores busy an ordinary thread may wait for longer than the reads last, and a camera then
loses data unseen. A better nice value does not suffice.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_THREADS = Path("/proc/self/task")


@contextmanager
def real_time() -> Iterator[bool]:
    """Run all threads of this process, and those that they start, before ordinary programs.

    All of them, because any thread may hold the interpreter's lock. Yields whether the system permits it: it does for
    root, and for users with a limit `rtprio`. The kernel leaves a share of the time to other programs. A process that
    was started with another policy, by `chrt`, keeps it.
    """
    if hasattr(os, "sched_getscheduler") and os.sched_getscheduler(0) != os.SCHED_OTHER:
        yield os.sched_getscheduler(0) in (os.SCHED_FIFO, os.SCHED_RR)
        return
    permitted = _schedule("SCHED_RR", 1)
    try:
        yield permitted
    finally:
        if permitted:
            _schedule("SCHED_OTHER", 0)


def _schedule(policy: str, priority: int) -> bool:
    """Give all threads this policy. Return False where the system has none, or refuses it."""
    try:
        number = getattr(os, policy)
        for thread in _THREADS.iterdir():
            with suppress(ProcessLookupError):  # it has just ended
                os.sched_setscheduler(int(thread.name), number, os.sched_param(priority))
    except (AttributeError, OSError):
        return False
    return True
