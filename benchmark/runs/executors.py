"""Executors run tasks in this process, in several, or on a cluster, with the same results.

An executor is a function `run(task, chunks)` that yields `task(chunk)` for every chunk, in order. The task travels to
each worker once. One of `unordered_executor` yields each result as soon as it is there, with its chunk's position.
"""

from __future__ import annotations

import os
import pickle
import re
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any, TypeVar

import psutil

from spike4dgs.benchmark.environment import available_cores
from spike4dgs.benchmark.errors import UserError, problem

C = TypeVar("C")
R = TypeVar("R")
Run = Callable[[Callable[[Any], Any], Sequence[Any]], Iterator[Any]]
RunUnordered = Callable[[Callable[[Any], Any], Sequence[Any]], Iterator[tuple[int, Any]]]
WORKERS_DIED = "workers died"  # the result of a chunk that a cluster gives up
_CONNECT_S = 10
_task: Callable[[Any], Any] | None = None  # of a worker process


@contextmanager
def executor(workers: int = 1, scheduler: str | None = None) -> Iterator[Run]:
    """Yield the executor for `workers` processes, or for a dask.distributed scheduler such as tcp://host:8786.

    Raises UserError for fewer than one worker, for both at once, where distributed is not installed, where the
    scheduler does not answer within 10 s or has no workers, and, while running, where a worker process dies.
    """
    with unordered_executor(workers, scheduler, task_travels_once=True) as run:
        yield lambda task, chunks: _ordered(run(task, chunks))


@contextmanager
def unordered_executor(workers: int, scheduler: str | None, task_travels_once: bool = False) -> Iterator[RunUnordered]:
    """Yield the executor for `workers` processes or a scheduler that gives each result as soon as it is there.

    Results are pairs of a chunk's position and `task(chunk)`. A cluster runs the chunk of a lost worker again
    elsewhere; one that loses several workers has the result WORKERS_DIED. The task travels with every chunk: one that
    travels once to the workers of a cluster would be lost with the last of them. Raises UserError as `executor` does,
    and, while running, where the scheduler is lost.
    """
    check_workers(workers, scheduler)
    if scheduler is not None:
        with _cluster(scheduler) as client:
            yield lambda task, chunks: _on_cluster(client, task, chunks, task_travels_once)
    elif workers == 1:
        yield lambda task, chunks: enumerate(here(task, chunks))
    else:
        yield lambda task, chunks: _in_processes(task, chunks, workers)


def check_workers(workers: int, scheduler: str | None) -> None:
    """Raise UserError for fewer than one worker, for both at once, and for what is no address of a scheduler."""
    if workers < 1:
        raise problem("--workers", "a number from 1 up", str(workers), "correct it")
    if scheduler is not None and workers != 1:
        raise problem("--workers and --scheduler", "one of them", "both", "the cluster decides about its workers")
    if scheduler is not None and not re.fullmatch(r"\w+://.+:\d+", scheduler):
        raise problem("--scheduler", "an address such as tcp://HOST:8786", repr(scheduler), "correct it")


def here(task: Callable[[C], R], chunks: Iterable[C]) -> Iterator[R]:
    """Run in this process."""
    return (task(chunk) for chunk in chunks)


def chunked(items: Sequence[int], most: int = 16) -> list[list[int]]:
    """Return runs of neighbouring items: neighbours share work, and many chunks keep all workers busy to the end."""
    return [list(items[k : k + most]) for k in range(0, len(items), most)]


def _in_processes(task: Callable[[C], R], chunks: Sequence[C], workers: int) -> Iterator[tuple[int, R]]:
    with _pool(task, workers) as pool:
        futures = {pool.submit(_work, chunk): k for k, chunk in enumerate(chunks)}
        for future in as_completed(list(futures)):
            yield futures.pop(future), future.result()


def _ordered(results: Iterator[tuple[int, R]]) -> Iterator[R]:
    """Yield results in the order of their chunks; each is dropped once it is yielded."""
    early: dict[int, R] = {}
    turn = 0
    for k, result in results:
        if result is WORKERS_DIED:
            fix = "give workers more memory, then run the same command again"
            raise problem("a worker", "that it ends its task", "several died one after another", fix)
        early[k] = result
        while turn in early:
            yield early.pop(turn)
            turn += 1


@contextmanager
def _pool(task: Callable[[Any], Any], workers: int) -> Iterator[ProcessPoolExecutor]:
    context = get_context("spawn")
    arguments = (pickle.dumps(task), context.Value("i", 0), workers, os.getpid())
    pool = ProcessPoolExecutor(workers, context, initializer=_start_worker, initargs=arguments)
    at_work = True
    try:
        yield pool
        at_work = False
    except BrokenProcessPool:
        fix = "run the same command again, with fewer --workers if memory ran out"
        raise problem("a worker process", "that it ends its task", "it died (out of memory, or killed)", fix) from None
    finally:
        running = list((pool._processes or {}).values()) if at_work else []  # the shutdown forgets them
        pool.shutdown(wait=False, cancel_futures=True)
        for process in running:  # what it does would only be thrown away
            process.terminate()


def _start_worker(task: bytes, started: Any, workers: int, parent: int) -> None:
    """Take this worker's share of the cores, which libraries ask for as they load, then load the task and keep it."""
    global _task
    threading.Thread(target=_die_with, args=(parent,), daemon=True).start()
    with started.get_lock():
        index, started.value = started.value, started.value + 1
    process = psutil.Process()
    cores = process.cpu_affinity() if hasattr(process, "cpu_affinity") else list(range(available_cores()))
    share = cores[index % len(cores) :: workers]
    if hasattr(process, "cpu_affinity"):  # macOS pins no process to cores
        process.cpu_affinity(share)
    import drjit

    drjit.set_thread_count(min(len(share), available_cores()))
    _task = pickle.loads(task)


def _die_with(parent: int) -> None:
    """End this worker with its parent: after the parent was killed it would wait for work for ever."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def _work(chunk: Any) -> Any:
    assert _task is not None  # set by the pool's initializer
    return _task(chunk)


@contextmanager
def _cluster(address: str) -> Iterator[Any]:
    try:
        from distributed import Client
    except ImportError:
        fix = "pip install 'spike4dgs[cluster]' here and on the workers"
        raise problem("--scheduler", "the package distributed", "none", fix) from None
    try:
        client = Client(address, timeout=_CONNECT_S, set_as_default=False)  # type: ignore[no-untyped-call]
    except (OSError, ValueError, TimeoutError) as e:
        reason = str(e).splitlines()[0] if str(e) else type(e).__name__
        expected, fix = f"a dask scheduler at {address}", "start it, or correct the address"
        raise problem("--scheduler", expected, reason, fix) from None
    with client:
        if not client.scheduler_info()["workers"]:
            raise problem("--scheduler", f"workers at {address}", "none", "start some: dask worker ADDRESS")
        yield client


def _on_cluster(client: Any, task: Callable[[C], R], chunks: Sequence[C], once: bool) -> Iterator[tuple[int, Any]]:
    from distributed import KilledWorker
    from distributed import as_completed as arriving

    sent = client.scatter(task, broadcast=True, hash=False) if once else task
    futures = {client.submit(_call, sent, chunk, pure=False, priority=-k): k for k, chunk in enumerate(chunks)}
    for future in arriving(list(futures), loop=client.loop):  # type: ignore[no-untyped-call]
        k = futures.pop(future)
        try:
            result = future.result()
        except KilledWorker:
            result = WORKERS_DIED
        except CancelledError:
            fix = "give the same command again once it runs: what has come back is kept"
            raise problem("--scheduler", "a scheduler that runs to the end", "a lost connection", fix) from None
        except UserError:
            raise
        except Exception as e:  # such as code that is not installed there
            fix = "see its log; the scheduler and all workers need the packages that are here"
            raise problem("a worker", "that it ends its task", f"{type(e).__name__}: {e}", fix) from e
        del future  # the cluster drops the result
        yield k, result


def _call(task: Callable[[C], R], chunk: C) -> R:
    return task(chunk)
