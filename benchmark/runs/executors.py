"""Executors run tasks in this process, in several, or on a cluster, with the same results in the same order.

An executor is a function `run(task, chunks)` that yields `task(chunk)` for every chunk, in order. The task travels to
each worker once.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any, TypeVar

from spike4dgs.benchmark.errors import problem

C = TypeVar("C")
R = TypeVar("R")
Run = Callable[[Callable[[Any], Any], Sequence[Any]], Iterator[Any]]
_CONNECT_S = 10
_task: Callable[[Any], Any] | None = None  # of a worker process


@contextmanager
def executor(workers: int = 1, scheduler: str | None = None) -> Iterator[Run]:
    """Yield the executor for `workers` processes, or for a dask.distributed scheduler such as tcp://host:8786.

    Raises UserError for fewer than one worker, for both at once, where distributed is not installed, where the
    scheduler does not answer within 10 s or has no workers, and, while running, where a worker process dies.
    """
    if workers < 1:
        raise problem("--workers", "a number from 1 up", str(workers), "correct it")
    if scheduler is None:
        yield here if workers == 1 else lambda task, chunks: _in_processes(task, chunks, workers)
    elif workers != 1:
        raise problem("--workers and --scheduler", "one of them", "both", "the cluster decides about its workers")
    else:
        with _cluster(scheduler) as run:
            yield run


def here(task: Callable[[C], R], chunks: Iterable[C]) -> Iterator[R]:
    """Run in this process."""
    return (task(chunk) for chunk in chunks)


def chunked(items: Sequence[int], most: int = 16) -> list[list[int]]:
    """Return runs of neighbouring items: neighbours share work, and many chunks keep all workers busy to the end."""
    return [list(items[k : k + most]) for k in range(0, len(items), most)]


def _in_processes(task: Callable[[C], R], chunks: Sequence[C], workers: int) -> Iterator[R]:
    threads = max(1, len(os.sched_getaffinity(0)) // workers)
    arguments = (task, threads, os.getpid())
    pool = ProcessPoolExecutor(workers, get_context("spawn"), initializer=_start_worker, initargs=arguments)
    try:
        yield from _ordered([pool.submit(_work, chunk) for chunk in chunks])
    except BrokenProcessPool:
        fix = "run the same command again, with fewer --workers if memory ran out"
        raise problem("a worker process", "that it ends its task", "it died (out of memory, or killed)", fix) from None
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for process in (pool._processes or {}).values():  # what is running would only be thrown away
            process.terminate()


def _ordered(futures: list[Future[R]]) -> Iterator[R]:
    """Yield results in order; each is dropped once it is yielded."""
    futures.reverse()
    while futures:
        yield futures.pop().result()


def _start_worker(task: Callable[[Any], Any], threads: int, parent: int) -> None:
    global _task
    _task = task
    threading.Thread(target=_die_with, args=(parent,), daemon=True).start()
    import drjit

    drjit.set_thread_count(threads)


def _die_with(parent: int) -> None:
    """End this worker with its parent: after the parent was killed it would wait for work for ever."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def _work(chunk: Any) -> Any:
    assert _task is not None  # set by the pool's initializer
    return _task(chunk)


@contextmanager
def _cluster(address: str) -> Iterator[Run]:
    try:
        from distributed import Client
    except ImportError:
        raise problem(
            "--scheduler", "the package distributed", "none", "pip install 'spike4dgs[cluster]' here and on the workers"
        ) from None
    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError) as e:
        reason = str(e).splitlines()[0] if str(e) else type(e).__name__
        raise problem(
            "--scheduler", f"a dask scheduler at {address}", reason, "start it, or correct the address"
        ) from None
    with client:
        if not client.scheduler_info()["workers"]:
            raise problem("--scheduler", f"workers at {address}", "none", "start some: dask worker ADDRESS")
        yield lambda task, chunks: _on_cluster(client, task, chunks)


def _on_cluster(client: Any, task: Callable[[C], R], chunks: Sequence[C]) -> Iterator[R]:
    sent = client.scatter(task, broadcast=True, hash=False)
    futures = [client.submit(_call, sent, chunk, pure=False, priority=-k) for k, chunk in enumerate(chunks)]
    futures.reverse()
    while futures:  # a result is dropped on the cluster as soon as it is here
        yield futures.pop().result()


def _call(task: Callable[[C], R], chunk: C) -> R:
    return task(chunk)
