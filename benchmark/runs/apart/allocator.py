"""The C library's allocator in a process that fits: freed memory stays with the process.

A fit allocates and frees the same arrays thousands of times. By default glibc hands back large blocks and what is free
at the heap's top, and the system clears each page anew when it comes again.
"""

from __future__ import annotations

import ctypes
import platform

# Parameters of mallopt(3). The largest threshold that glibc takes is half a heap of a thread, 32 MiB.
_TRIM_THRESHOLD, _TOP_PAD, _MMAP_THRESHOLD = -1, -2, -3
_KEPT = ((_TRIM_THRESHOLD, 2**31 - 1), (_TOP_PAD, 2**26), (_MMAP_THRESHOLD, 2**25))


def keep_freed_memory() -> bool:
    """Keep freed memory for the next allocation, in this process and on glibc alone; return whether that is so."""
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    return all([mallopt(parameter, value) for parameter, value in _KEPT])
