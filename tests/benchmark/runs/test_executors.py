"""Executors: the same results in the same order everywhere, and clear errors."""

import multiprocessing
import os
import signal
import socket
import time
from pathlib import Path

import pytest
from dummy_methods import wait_for

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.runs import executors
from spike4dgs.benchmark.runs.executors import chunked, executor, unordered_executor


class Square:
    """A task that counts its calls, to show that it stays with its worker, and touches a file when it is killed."""

    def __init__(self, killed):
        self.calls, self.killed = 0, killed

    def __call__(self, chunk):
        if multiprocessing.parent_process():
            signal.signal(signal.SIGTERM, lambda *_: self.killed.touch())
        self.calls += 1
        time.sleep(0.02 * (chunk[0] % 3))
        return [x * x for x in chunk], self.calls, os.getpid()


def die(chunk):
    os._exit(3)


def test_chunks_are_neighbours():
    assert chunked(list(range(7)), 3) == [[0, 1, 2], [3, 4, 5], [6]]


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_order_and_no_worker_of_a_run_that_ends_well_is_killed(workers, tmp_path):
    """COLMAP's library prints a stack of calls where it is."""
    chunks, killed = chunked(list(range(20)), 2), tmp_path / "killed"
    with executor(workers) as run:
        found = list(run(Square(killed), chunks))
    assert [x for squares, _, _ in found for x in squares] == [k * k for k in range(20)]
    processes = {pid for _, _, pid in found}
    assert (os.getpid() in processes) == (workers == 1) and len(processes) <= workers
    assert max(calls for _, calls, _ in found) >= 10 / workers  # one task object for each worker
    wait_for(lambda: not multiprocessing.active_children(), 30)
    assert not killed.exists()


def test_a_worker_that_dies_is_one_error():
    with executor(2) as run, pytest.raises(UserError, match="a worker process.*run the same command again"):
        list(run(die, [1]))


def first_ends_last(chunk):
    """Touch a file; the first chunk waits for those of the others."""
    folder, k = chunk
    (folder / str(k)).touch()
    while k == 0 and len(list(folder.iterdir())) < 3:
        time.sleep(0.05)
    return sorted(os.sched_getaffinity(0))


def test_unordered_results_come_as_they_end_with_their_positions(tmp_path):
    with unordered_executor(2, None) as run:
        found = list(run(first_ends_last, [(tmp_path, k) for k in range(3)]))
    assert found[0][0] != 0 and sorted(k for k, _ in found) == [0, 1, 2]
    mine = sorted(os.sched_getaffinity(0))
    shares = {tuple(cores) for _, cores in found}
    assert all(set(share) <= set(mine) for share in shares)
    if len(mine) > 1:
        assert sum(map(len, shares)) <= len(mine), "workers share no core"


class Loaded:
    """A task that notes the cores that it was loaded with, as a library does."""

    def __setstate__(self, state):
        self.cores = os.sched_getaffinity(0)

    def __getstate__(self):
        return True

    def __call__(self, chunk):
        return self.cores == os.sched_getaffinity(0)


def test_a_worker_has_its_cores_before_it_loads_the_task():
    if len(os.sched_getaffinity(0)) < 2:
        pytest.skip("one core is nobody's share")
    with executor(2) as run:
        assert list(run(Loaded(), range(2))) == [True, True]


def pid_of(chunk):
    time.sleep(0.02)
    return os.getpid()


def has_ended(pid):
    status = Path(f"/proc/{pid}/status")
    return not status.exists() or "zombie" in status.read_text()


def test_workers_end_with_a_run_that_is_given_up():
    with executor(2) as run:
        results = run(pid_of, range(50))
        pid = next(results)
        results.close()
    wait_for(lambda: has_ended(pid), 30)


def fail_beside_a_long_task(chunk):
    """Fail once the task of the other worker runs, which lasts longer than a test waits."""
    path, fails = chunk
    if fails:
        wait_for(lambda: path.is_file() and path.read_text())
        raise UserError("cam_00: expected light, found none. Switch it on")
    path.write_text(f"{os.getpid()}")
    time.sleep(90)


def test_a_worker_at_work_ends_after_the_error_of_another(tmp_path):
    path = tmp_path / "pid"
    with executor(2) as run, pytest.raises(UserError, match="Switch it on"):
        list(run(fail_beside_a_long_task, [(path, False), (path, True)]))
    wait_for(lambda: has_ended(int(path.read_text())), 30)


def test_a_scheduler_that_does_not_answer_is_one_error(monkeypatch):
    monkeypatch.setattr(executors, "_CONNECT_S", 1)
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port = s.getsockname()[1]
    with pytest.raises(UserError, match=f"--scheduler: expected a dask scheduler at tcp://127.0.0.1:{port}"):
        with executor(1, f"tcp://127.0.0.1:{port}"):
            pass
