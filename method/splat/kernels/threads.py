"""A few threads of our own. Kernels release the GIL and take work items from an atomic counter until none is left.

OpenMP (numba's prange, torch) makes waiting threads spin: on a busy machine that cost 63 ms where this costs 14.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from queue import SimpleQueue
from typing import Any

import numpy as np

from spike4dgs.benchmark.environment import available_cores
from spike4dgs.benchmark.errors import problem

ITEM = 1024  # Gaussians that a thread takes at a time, where they are small work
_threads = min(available_cores(), 16)
_tasks: SimpleQueue[_Task | None] | None = None  # of the helpers, which are started with the first of them
_lock = threading.Lock()
_caller = threading.local()


def set_threads(count: int) -> None:
    """Use this many threads for the CPU kernels (default: the cores this process may use, at most 16).

    The results are the same bits for any number.
    """
    global _threads, _tasks
    if count < 1:
        raise problem("set_threads", "at least 1", str(count), "pass the number of cores to use")
    with _lock:
        if _tasks is not None:
            for _ in range(_threads - 1):
                _tasks.put(None)
        _threads, _tasks = count, None


def get_threads() -> int:
    """Return the number of threads that the CPU kernels use when called from this thread."""
    return 1 if getattr(_caller, "works_alone", False) else _threads


def work_alone() -> None:
    """Let kernels that this thread calls from now on run on it alone: for work beside a thread that has helpers."""
    _caller.works_alone = True


def useful_threads(items: int, each: int) -> int:
    """Return how many threads to use for `items` small pieces of work: one for every `each`, which pay its start."""
    return max(1, min(get_threads(), items // each))


def work_counter() -> np.ndarray:
    """Return a fresh counter [1] int64 for one `run`, on a cache line of its own."""
    return np.zeros(8, np.int64)


def aligned(shape: tuple[int, ...], dtype: type) -> np.ndarray:
    """Return an uninitialised array that begins on a cache line."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    raw = np.empty(size + 64, np.uint8)
    start = -raw.__array_interface__["data"][0] % 64  # ctypes.data takes 30 times as long
    return raw[start : start + size].view(dtype).reshape(shape)


def run_items(kernel: Any, arguments: Sequence[Any], items: int) -> None:
    """Call `kernel(*arguments, counter)` on as many threads as `items` are worth; it takes `ITEM` at a time."""
    run(kernel, arguments, [()] * useful_threads(items, 4 * ITEM))


def run(kernel: Any, arguments: Sequence[Any], scratch: Sequence[Sequence[Any]]) -> None:
    """Call `kernel(*arguments, counter, *scratch[t])` on len(scratch) threads, this one included, until all return.

    A helper thread that has not started when the work is done is not waited for.
    """
    counter = work_counter()
    tasks = [_Task(kernel, (*arguments, counter, *own)) for own in scratch[1:]]
    if tasks:
        queue = _helpers()
        for task in tasks:
            queue.put(task)
    kernel(*arguments, counter, *scratch[0])
    for task in tasks:
        task.finish()


class _Task:
    """A call that a helper thread makes, unless it is withdrawn first. A pool's futures cost 3 % of an image more."""

    __slots__ = ("arguments", "begun", "done", "error", "kernel")

    def __init__(self, kernel: Any, arguments: tuple[Any, ...]) -> None:
        self.kernel, self.arguments = kernel, arguments
        self.begun, self.done = threading.Lock(), threading.Lock()
        self.error: BaseException | None = None
        self.done.acquire()

    def call(self) -> None:
        """Make the call on this thread, unless it was withdrawn."""
        if not self.begun.acquire(blocking=False):
            return
        try:
            self.kernel(*self.arguments)
        except BaseException as error:
            self.error = error
        finally:
            self.done.release()

    def finish(self) -> None:
        """Withdraw the call, or wait for its end if it has begun. Raises what it raised."""
        if not self.begun.acquire(blocking=False):
            self.done.acquire()
        if self.error is not None:
            raise self.error


def _helpers() -> SimpleQueue[_Task | None]:
    """Return the queue of the helper threads, which are started if there are none."""
    global _tasks
    with _lock:
        if _tasks is None:
            _tasks = SimpleQueue()
            for t in range(_threads - 1):
                threading.Thread(target=_serve, args=(_tasks,), name=f"splat_{t}", daemon=True).start()
        return _tasks


def _serve(tasks: SimpleQueue[_Task | None]) -> None:
    while (task := tasks.get()) is not None:
        task.call()
        del task  # else its arrays would stay until the next
