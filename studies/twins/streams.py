"""The measurements of this room for `report speed-error`: metrics and the decoding of spikes."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.metrics.flip import flip
from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.metrics.ssim_window import SSIM_SIGMA, SSIM_WINDOW
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.studies.speed.decode import random_stream, unpack_plainly
from spike4dgs.studies.speed.metrics import make_image_pair, package_flip
from spike4dgs.studies.speed.timing import by_turns_ms
from spike4dgs.studies.speed_error.measurement import (
    MEDIAN_MS,
    MS,
    Column,
    Measurement,
    Point,
    Request,
    Series,
)

Calls = dict[str, Callable[[], float]]
_ERROR = Column("error", "error of the score")
_C1, _C2 = 0.01**2, 0.03**2  # of SSIM, for the data range 1


def ssim_slowly(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return SSIM (Wang et al. 2004) window by window in extended precision, without the border; [H, W] in [0, 1]."""
    at = np.arange(SSIM_WINDOW, dtype=np.longdouble) - SSIM_WINDOW // 2
    line = np.exp(-0.5 * (at / SSIM_SIGMA) ** 2)
    window = np.outer(line, line) / line.sum() ** 2
    wide = [x.astype(np.longdouble) for x in (a, b)]
    views = [np.lib.stride_tricks.sliding_window_view(x, window.shape) for x in wide]
    means = [np.einsum("yxij,ij->yx", v, window) for v in views]
    s1, s2, s12 = (
        np.einsum("yxij,yxij,ij->yx", *pair, window) - m * n
        for pair, m, n in (
            ((views[0], views[0]), means[0], means[0]),
            ((views[1], views[1]), means[1], means[1]),
            ((views[0], views[1]), means[0], means[1]),
        )
    )
    m1, m2 = means
    return float(np.mean((2 * m1 * m2 + _C1) * (2 * s12 + _C2) / ((m1**2 + m2**2 + _C1) * (s1 + s2 + _C2))))


def psnr_slowly(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """Return PSNR in dB for the range 1, in extended precision."""
    return float(-10 * np.log10(np.mean((a.astype(np.longdouble) - b) ** 2)))


def pairs(request: Request) -> dict[str, ImagePair]:
    """Return pairs of images by name: usual ones, and those on which a score has the least room."""
    height, width = request.pick((24, 40), (125, 200), (250, 400))
    usual = make_image_pair(height, width, request.seed)
    close = usual.truth_radiance + 1e-3 * (usual.predicted_radiance - usual.truth_radiance)
    dark = 1e-2
    return {
        "a noisy image": usual,
        "almost equal images": replace(usual, predicted_radiance=close, earlier=None),
        "almost black images": replace(
            usual, truth_radiance=dark * usual.truth_radiance, predicted_radiance=dark * usual.predicted_radiance,
            earlier=None,
        ),
    }  # fmt: skip


def _scores(request: Request) -> Iterator[Series]:
    for name, pair in pairs(request).items():
        narrow = replace(
            pair,
            truth_radiance=pair.truth_radiance.astype(np.float32),
            predicted_radiance=pair.predicted_radiance.astype(np.float32),
        )
        for metric, slowly in (("psnr", psnr_slowly), ("ssim", ssim_slowly)):
            calls: Calls = {
                "extended precision": partial(slowly, pair.truth, pair.prediction),
                "the score": lambda pair=pair, metric=metric: _score(metric, pair),  # type: ignore[misc]
                "of float32 images": lambda narrow=narrow, metric=metric: _score(metric, narrow),  # type: ignore[misc]
                "of 8-bit images": lambda pair=pair, metric=metric: _score(metric, _in_8_bits(pair)),  # type: ignore[misc]
            }
            roles = {"extended precision": "exact", "the score": "chosen"}
            yield _compared(f"{metric.upper()} of {name}", calls, roles, request)


def _score(metric: str, pair: ImagePair) -> float:
    value = METRICS[metric].measure(replace(pair))  # a copy has nothing cached
    assert value is not None
    return value


def _in_8_bits(pair: ImagePair) -> ImagePair:
    a, b = (np.rint(255 * x) / 255 for x in (pair.truth, pair.prediction))
    return replace(pair, truth_radiance=a, predicted_radiance=b)


def _flip(request: Request) -> Iterator[Series]:
    for name, pair in pairs(request).items():
        if (reference := package_flip(pair.truth8, pair.prediction8)) is None:
            raise problem("FLIP", "the package flip-evaluator to compare with", "none", "pip install flip-evaluator")
        calls: Calls = {"flip-evaluator, colour": reference, "flip": partial(flip, pair.truth8, pair.prediction8)}
        yield _compared(f"FLIP of {name}", calls, {"flip-evaluator, colour": "exact", "flip": "chosen"}, request)


def _compared(name: str, calls: Calls, roles: dict[str, Any], request: Request) -> Series:
    """Return the series of calls that give one number; the first is exact."""
    found = [call() for call in calls.values()]
    times = by_turns_ms(list(calls.values()), request.pick(1, 3, 7))
    points = (
        Point(title, {"ms": best, "median_ms": median, "error": abs(value - found[0])}, roles.get(title, ""))
        for title, value, (best, median) in zip(calls, found, times, strict=True)
    )
    return Series(name, tuple(points))


def _decoding(request: Request) -> Iterator[Series]:
    width, height, ticks = request.pick((24, 16, 50), (200, 125, 1000), (400, 250, 1000))
    stream = random_stream(ticks, width, height, request.seed)
    plain = unpack_plainly(stream)
    for name, plainly, ours, exact in (
        ("all ticks", lambda: unpack_plainly(stream), lambda: stream.window(0, ticks), plain),
        ("counts", lambda: unpack_plainly(stream).sum(0, np.uint16), lambda: stream.counts(0, ticks), plain.sum(0)),
    ):
        (slow, fast), off = by_turns_ms([plainly, ours], request.pick(1, 5, 9)), np.abs(ours().astype(np.int64) - exact)
        points = [
            Point("numpy unpackbits", {"ms": slow[0], "median_ms": slow[1], "error": 0.0}, "exact"),
            Point("spike4dgs", {"ms": fast[0], "median_ms": fast[1], "error": float(off.max())}, "chosen"),
        ]
        yield Series(f"{name}: {ticks} ticks of {width}x{height}", tuple(points))


def measurements() -> Sequence[Measurement]:
    """Return them."""
    group = "Metrics and streams"
    return (
        Measurement(
            id="scores",
            group=group,
            title="Scores: PSNR and SSIM",
            approximation="Scores are computed in float64 from linear radiance, by scikit-image.",
            exact="The formulas in extended precision, window by window.",
            reason="Rounding is far below the last digit of tables, for almost equal and almost black images too. "
            "8-bit images would cap the PSNR of good models and change dark ones.",
            columns=(MS, MEDIAN_MS, _ERROR),
            x="ms",
            y=("error",),
            run=_scores,
            seconds={"tiny": 3, "quick": 15, "whole": 60},
            held_by="tests/studies/twins/test_streams.py",
        ),
        Measurement(
            id="flip",
            group=group,
            title="Scores: FLIP",
            approximation="Gray images have one channel: the other two are left out, and filters are separable.",
            exact="The authors' package flip-evaluator, in colour.",
            reason="The scores differ by the package's float32, far below the digits that tables show.",
            columns=(MS, MEDIAN_MS, _ERROR),
            x="ms",
            y=("error",),
            run=_flip,
            seconds={"tiny": 4, "quick": 15, "whole": 60},
            held_by="tests/benchmark/metrics",
        ),
        Measurement(
            id="decoding",
            group=group,
            title="Spikes: decoding packed bits",
            approximation="Windows and counts come from the packed bits, many pixels at a time.",
            exact="`numpy.unpackbits`, a flip of the rows, and a sum.",
            reason="Bits are exact: only time and memory count.",
            columns=(MS, MEDIAN_MS, Column("error", "largest difference, spikes")),
            x="ms",
            y=("error",),
            run=_decoding,
            seconds={"tiny": 1, "quick": 4, "whole": 10},
            held_by="tests/benchmark/spikes",
        ),
    )
