"""The kernels' own threads: every item once, errors reach the caller, and nothing is called after the return."""

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.method.splat.kernels import threads


@pytest.fixture(autouse=True, params=[1, 2, 5])
def count(request: pytest.FixtureRequest) -> Iterator[int]:
    before = threads.get_threads()
    threads.set_threads(request.param)
    yield request.param
    threads.set_threads(before)


def test_callers_at_once_each_get_all_their_items(count: int) -> None:
    lock = threading.Lock()

    def kernel(done: list[int], counter: np.ndarray, name: int) -> None:
        while True:
            with lock:
                item, counter[0] = int(counter[0]), counter[0] + 1
            if item >= 50:
                return
            done.append(item)
            time.sleep(1e-5)

    def call(_: int) -> list[int]:
        done: list[int] = []
        threads.run(kernel, (done,), [(t,) for t in range(count)])
        return done

    with ThreadPoolExecutor(4) as callers:
        for done in callers.map(call, range(40)):
            assert sorted(done) == list(range(50))


def test_an_error_of_any_thread_reaches_the_caller(count: int) -> None:
    begun = threading.Barrier(count)  # no thread may be withdrawn

    def kernel(counter: np.ndarray, name: int) -> None:
        begun.wait(10)
        if name == count - 1:
            raise ZeroDivisionError(name)

    with pytest.raises(ZeroDivisionError, match=str(count - 1)):
        threads.run(kernel, (), [(t,) for t in range(count)])


def test_a_helper_that_comes_late_does_nothing(count: int) -> None:
    calls: list[str] = []
    hold = threading.Event()

    def block(counter: np.ndarray, own: bool) -> None:
        if not own:
            hold.wait(10)

    def kernel(counter: np.ndarray, name: str) -> None:
        calls.append(name)

    busy = threading.Thread(target=threads.run, args=(block, (), [(True,), *[(False,)] * (count - 1)]))
    busy.start()
    time.sleep(0.05)  # all helpers wait in `block`
    threads.run(kernel, (), [("own",), *[("late",)] * (count - 1)])
    assert calls == ["own"]
    hold.set()
    busy.join()
    time.sleep(0.05)
    assert calls == ["own"], "called after the return"


def test_no_threads_are_refused() -> None:
    with pytest.raises(UserError, match="at least 1"):
        threads.set_threads(0)
