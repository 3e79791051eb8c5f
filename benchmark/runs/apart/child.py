"""The process that fits: it stands in a training part, and the caller tells it of nothing else.

Its standard input and output are the two pipes of `messages`, so that any program that starts it in a container passes
them on. What the method prints goes to standard error. It ends with its caller, however that ends, and then removes the
training part.
"""

from __future__ import annotations

import os
import queue
import shutil
import signal
import sys
import threading
import time
from dataclasses import asdict, replace
from typing import Any, cast

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.method import FitRequest, training_for
from spike4dgs.benchmark.runs.apart.allocator import keep_freed_memory
from spike4dgs.benchmark.runs.apart.messages import (
    DONE,
    FAILED,
    MODEL,
    MOST,
    NOTE,
    PROGRESS,
    RENDERED,
    Order,
    Rest,
    identity,
    images_folder,
    line_of,
    receive,
    unpacked_method,
)
from spike4dgs.benchmark.runs.cell import failure_of, render_targets, timed_fit
from spike4dgs.benchmark.runs.provenance import Savable
from spike4dgs.benchmark.runs.refinement import Refinable, refined_cameras
from spike4dgs.benchmark.scene.images import write_exr
from spike4dgs.benchmark.scene.scene import Target, open_scene

_EVERY_S = 0.1  # between two lines of progress


class _Caller:
    """The caller's end: what it sends arrives in a thread, which ends this process when the caller is gone."""

    def __init__(self, orders: int, lines: int) -> None:
        self._orders, self._lines, self._inbox = orders, lines, queue.SimpleQueue[Any]()
        self._shown = 0.0
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        part = None
        try:
            while True:
                self._inbox.put(found := receive(self._orders))
                part = getattr(found, "part", part)
        except (EOFError, OSError):
            if part is not None:
                shutil.rmtree(part, ignore_errors=True)
            os._exit(1)
        except BaseException as e:  # a method whose package is not here
            self._inbox.put(e)

    def next(self) -> Any:
        found = self._inbox.get()
        if isinstance(found, BaseException):
            raise found
        return found

    def say(self, kind: str, value: Any) -> None:
        os.write(self._lines, line_of(kind, value))

    def progress(self, done: int, total: int, note: str = "") -> None:
        now = time.monotonic()
        if 0 < done < total and now - self._shown < _EVERY_S:
            return
        self._shown = now
        self.say(PROGRESS, [int(done), int(total), str(note)[:1000]])


def main() -> int:
    """Do what the caller orders, and return the exit code."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    caller = _Caller(os.dup(0), os.dup(1))
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.dup2(2, 1)
    keep_freed_memory()
    try:
        _fit(caller.next(), caller)
    except KeyboardInterrupt:
        return 130
    except Exception as e:  # whatever a method does wrong
        failure = failure_of(e)
        short = {key: text[-MOST // 8 :] for key, text in asdict(failure).items()}
        caller.say(FAILED, short)
        return 1
    caller.say(DONE, None)
    return 0


def _fit(order: Order, caller: _Caller) -> None:
    method = unpacked_method(order.method)
    if other := [key for key, value in identity(method).items() if value != order.code[key]]:
        fix = "install here what the caller has"
        raise problem(f"method {method.name}", "the caller's", f"another {', '.join(other)}", fix)
    scene = open_scene(order.part, allow_gaps=True)  # the caller decides about gaps
    training = training_for(method, scene.training)
    training = replace(training, revision=order.revision, cameras=tuple(order.cameras[c] for c in scene.train))
    request = FitRequest(order.budget, order.device, order.seed, caller.progress)
    model, fit_seconds = timed_fit(method, training, request, order.work, lambda text: caller.say(NOTE, text))

    def render(variant: int, cameras: Any) -> None:
        def add(target: Target, image: Float32, t_us: float) -> None:
            write_exr(images_folder(order.work, variant) / f"{target.name}.exr", image, t_us)

        costs = render_targets(model, scene, cameras, method.name, order.device, add)
        caller.say(RENDERED, {**costs, "fit_seconds": fit_seconds})

    render(0, order.cameras)
    rest: Rest = caller.next()
    if isinstance(model, Savable):
        model.save(order.work / MODEL, rest.provenance)
    if rest.views:
        render(1, {**order.cameras, **refined_cameras(cast(Refinable, model), rest.views)})


if __name__ == "__main__":
    sys.exit(main())
