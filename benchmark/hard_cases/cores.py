"""Results by number of cores: what is computed on one core and on several has to be equal bit for bit."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from spike4dgs.benchmark.hard_cases.case import Outcome


def core_counts() -> list[int]:
    """Return the numbers of cores to try: 1, 2, 4 ... and all that this process may use."""
    most = len(os.sched_getaffinity(0))
    return sorted({min(2**k, most) for k in range(most.bit_length())} | {most})


@contextmanager
def on_cores(count: int) -> Iterator[None]:
    """Run on the first `count` cores of this process only: parts that start a thread a core start that many."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(before)[:count])
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def bytes_by_cores(compute: Callable[[], bytes]) -> Outcome:
    """Return how many bytes of a result differ between one core and 2, 4 ... all cores, in the worst case."""
    results, counts = [], core_counts()
    for cores in counts:
        with on_cores(cores):
            results.append(compute())
    return equal_bytes(results, [f"{n} cores" for n in counts])


def equal_bytes(results: Sequence[bytes], names: Sequence[str]) -> Outcome:
    """Return how many bytes of each result differ from the first one's, in the worst case, and which results do.

    >>> equal_bytes([b"abc", b"abc", b"abd"], ["1 thread", "2 threads", "3 threads"])
    Outcome(came_out='3 bytes; 3 threads differ', error=1.0, finite=True)
    """
    first = np.frombuffer(results[0], np.uint8)
    wrong = {}
    for name, result in zip(names[1:], results[1:], strict=True):
        other = np.frombuffer(result, np.uint8)
        wrong[name] = int(np.count_nonzero(first != other)) if len(first) == len(other) else max(len(first), len(other))
    differ = [name for name, count in wrong.items() if count]
    text = f"{', '.join(differ)} differ" if differ else f"the same with {', '.join(names)}"
    return Outcome(f"{len(first):,} bytes; {text}", float(max(wrong.values(), default=0)))
