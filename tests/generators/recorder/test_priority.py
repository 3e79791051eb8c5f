"""Real-time priority: of every thread while it lasts, and never required."""

from __future__ import annotations

import os
import subprocess
import sys
import threading

import pytest

from spike4dgs.generators.recorder.resources import real_time


def policy_of(thread: threading.Thread) -> int:
    return os.sched_getscheduler(thread.native_id or 0)


def test_all_threads_have_it_while_it_lasts() -> None:
    end = threading.Event()
    before = threading.Thread(target=end.wait)
    before.start()
    try:
        with real_time() as permitted:
            if not permitted:
                pytest.skip("this user may not have real-time priority")
            within = threading.Thread(target=end.wait)
            within.start()
            assert [policy_of(t) for t in (threading.main_thread(), before, within)] == 3 * [os.SCHED_RR]
        assert [policy_of(t) for t in (threading.main_thread(), before, within)] == 3 * [os.SCHED_OTHER]
    finally:
        end.set()


REFUSED = """
import os, resource
from spike4dgs.generators.recorder.resources import real_time
if os.getuid() == 0:
    os.setuid(65534)
resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
with real_time() as permitted:
    print(permitted, os.sched_getscheduler(0) == os.SCHED_OTHER)
"""


def test_a_system_that_refuses_it_is_no_error() -> None:
    done = subprocess.run([sys.executable, "-c", REFUSED], capture_output=True, text=True, timeout=60)
    assert done.stdout == "False True\n", done.stderr
