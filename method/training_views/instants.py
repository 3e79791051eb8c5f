"""Images of instants from means over spans of time, by the model that is being fitted.

A value that is a mean over a span [a, b] around its instant is compared with the model at that instant, once what the
model says of the difference is added to it:

    value + (model(0) - mean of model over [a, b]).

Where that holds for a model, its mean over the span is what was measured. So the fit has the same optimum as one that
renders the whole span at each step, at the cost of one render. The model that corrects is a snapshot, taken anew a few
times in a fit; repeated, this is van Cittert's deconvolution (1931), which starts from what was measured.

The same model tells what a span's lost ticks held. Of a span that gathered k spikes for certain, and up to D more, the
number is the one that comes nearest to the model's mean over it; where that is not near to a whole number, nothing was
measured.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future

import torch
from torch import Tensor

from spike4dgs.method.splat.kernels.threads import work_alone
from spike4dgs.method.training_views.training_images import Spans

REACH = 2.0  # half spans from the instant, beyond which no span is followed
UNSURE = 0.3  # spikes from a whole number, beyond which a model does not tell how many there were

RenderViews = Callable[[float, Sequence[int]], Tensor]  # ticks from the instant, views -> [V, H, W], no gradient


def node(half: float) -> float:
    """Return the outer node, in ticks, of three-point Gauss-Legendre over [-half, half]; the inner one is 0."""
    return half * math.sqrt(0.6)


def correction(before: Tensor, now: Tensor, after: Tensor, spans: Spans) -> Tensor:
    """Return light at the instant - its mean over each span [V, H, W], from renders at -node, 0 and node.

    Light is taken as quadratic in time. Over [-half, half] that is exact for light up to the fifth power.
    """
    far, reach = node(spans.half), REACH * spans.half
    a, b = spans.ends.to(now).clamp(-reach, reach).unbind(1)
    slope, bend = (after - before) / (2 * far), (before + after - 2 * now) / (2 * far * far)
    return -(slope * (a + b) / 2 + bend * (a * a + a * b + b * b) / 3)


def recount(mean: Tensor, doubts: Tensor) -> Tensor:
    """Return what values lack of the spikes that a model's means over their spans, [V, H, W], tell.

    `doubts` [V, 4, H, W] are those of `ImageMaker.with_spans`. NaN where the model does not tell.
    """
    most, one, without, counted = doubts.float().unbind(1)
    spikes = (mean - without) / one
    whole = spikes.round().clamp(min=0).minimum(most)
    lacking = torch.where((spikes - whole).abs() > UNSURE, math.nan, whole * one - counted)
    return torch.where(most > 0, lacking, 0.0)


class Corrections:
    """The corrections by one snapshot of a model, made when they are first asked for and kept as half floats.

    `begin` has them made ahead, in the order in which a fit will ask for them: a thread of its own fills the time in
    which the fit's other steps keep one core waiting, and while the fit waits for that thread it makes what comes next
    itself. The values are the same whoever makes them.
    """

    def __init__(self, spans: Spans, render: Callable[[int], RenderViews]) -> None:
        self.spans, self.render = spans, render
        self._made: dict[tuple[int, int], Future[Tensor]] = {}
        self._ahead: Iterator[tuple[int, Sequence[int]]] = iter(())
        self._lock, self._stopped, self._thread = threading.Lock(), threading.Event(), threading.Thread()

    def at(self, index: int, views: Sequence[int]) -> Tensor:
        """Return the corrections [V, H, W] of some views' images of one time."""
        self._make(index, views)
        made = [self._made[index, v] for v in views]
        while not all(future.done() for future in made) and (request := self._next()):
            self._make(*request)
        return torch.stack([future.result() for future in made]).float()

    def begin(self, requests: Iterable[tuple[int, Sequence[int]]]) -> None:
        """Make what `at` will be asked for, beside the caller, until `stop`."""
        self._ahead = iter(requests)

        def work() -> None:
            work_alone()
            torch.set_num_threads(1)
            while not self._stopped.is_set() and (request := self._next()):
                self._make(*request)

        self._thread = threading.Thread(target=work, name="corrections")
        self._thread.start()

    def _next(self) -> tuple[int, Sequence[int]] | None:
        """Return what is to be made next, to one thread alone; None where there is no more."""
        with self._lock:
            return next(self._ahead, None)

    def stop(self) -> None:
        """Make nothing ahead any more; return once the thread that did has ended."""
        self._stopped.set()
        if self._thread.ident:
            self._thread.join()
        self._ahead = iter(())  # what is left holds the fit, and all its images

    def _make(self, index: int, views: Sequence[int]) -> None:
        """Make what neither thread has begun. An error is raised where the image is asked for."""
        with self._lock:
            begun = {v: Future[Tensor]() for v in views if (index, v) not in self._made}
            self._made.update(((index, v), future) for v, future in begun.items())
        if not begun:
            return
        try:
            made = self._correct(index, list(begun))
        except Exception as error:
            for future in begun.values():
                future.set_exception(error)
            return
        for future, image in zip(begun.values(), made, strict=True):
            future.set_result(image.half())

    def _correct(self, index: int, views: Sequence[int]) -> Tensor:
        far, render = node(self.spans.half), self.render(index)
        with torch.no_grad():
            before, now, after = (render(ticks, views) for ticks in (-far, 0.0, far))
            spans = self.spans.at(index).at(torch.tensor(views))
            change = correction(before, now, after, spans)
            return change if spans.doubts is None else change + recount(now - change, spans.doubts)
