"""Freed memory that stays with the process: counted by the pages that the system has to supply again."""

import platform
import subprocess
import sys

import pytest

_COUNT = """
import resource, sys
import numpy as np
from spike4dgs.benchmark.runs.apart.allocator import keep_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        _ = [np.ones(2**17) for _ in range(8)]  # of 1 MiB, 256 pages: too small for huge ones
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

before, kept, after = faults(), keep_freed_memory(), [faults(), faults()][1]
print(before, kept, after)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_what_was_freed_is_taken_again() -> None:
    done = subprocess.run([sys.executable, "-c", _COUNT], capture_output=True, text=True, check=True)
    before, kept, after = done.stdout.split()
    assert kept == "True" and int(after) < 256 and int(before) > 10 * 8 * 256


def test_another_library_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    from spike4dgs.benchmark.runs.apart import allocator

    monkeypatch.setattr(platform, "libc_ver", lambda: ("", ""))
    monkeypatch.setattr(allocator.ctypes, "CDLL", lambda name: pytest.fail("loaded"))
    assert not allocator.keep_freed_memory()
