"""A container's limit on the processors' time, such as that of `docker run --cpus=2`, which no affinity tells."""

from __future__ import annotations

import math
import os
from collections.abc import MutableMapping
from functools import cache

# Under cgroups of version 2, and of version 1: the time in a period, and the period, in us. No limit is "max", or -1.
_FILES = (("cpu.max",), ("cpu/cpu.cfs_quota_us", "cpu/cpu.cfs_period_us"))


@cache
def quota_cores(root: str = "/sys/fs/cgroup") -> int | None:
    """Return the cores whose time the container has, rounded up; None without a limit, and on other systems."""
    for names in _FILES:
        words: list[str] = []
        try:
            for name in names:
                with open(f"{root}/{name}", encoding="ascii") as file:
                    words += file.read().split()
            quota, period = (int(word) for word in words)
        except (OSError, ValueError):
            continue
        if quota > 0 and period > 0:
            return math.ceil(quota / period)
    return None


def limit_openmp(environment: MutableMapping[str, str]) -> None:
    """Have OpenMP, once it loads, start no more threads than that, unless OMP_NUM_THREADS says how many."""
    quota = quota_cores()
    if quota is not None and hasattr(os, "sched_getaffinity") and quota < len(os.sched_getaffinity(0)):
        environment.setdefault("OMP_NUM_THREADS", str(quota))
