"""FLIP beside its authors' package, and the decoding of spikes beside numpy."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.metrics.flip import flip
from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.spikes.stream import SpikeStream, bytes_per_tick
from spike4dgs.studies.kit.measurement import TIMES, Column, Request, Series, compared, measurement

GROUP = "Metrics and streams"
Calls = dict[str, Callable[[], float]]
_COLUMNS = (*TIMES, Column("error", "error of the score"))


def make_image_pair(height: int, width: int, seed: int = 0) -> ImagePair:
    """Return a smooth random image, a noisy version, and both as they were one millisecond before."""
    from scipy.ndimage import gaussian_filter

    rng = np.random.default_rng(seed)
    smooth = gaussian_filter(rng.random((2, height, width)), (0, 3, 3))
    truth = (smooth - smooth.min()) / np.ptp(smooth)
    noisy = truth + 0.05 * rng.standard_normal(truth.shape)
    moving = truth[0] > 0.5
    earlier, now = (ImagePair(t, p, moving, "image") for t, p in zip(truth, noisy, strict=True))
    return ImagePair(now.truth_radiance, now.predicted_radiance, moving, "image", earlier=earlier, since_ms=1.0)


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
            usual,
            truth_radiance=dark * usual.truth_radiance,
            predicted_radiance=dark * usual.predicted_radiance,
            earlier=None,
        ),
    }


def _error(found: float, exact: float) -> dict[str, float]:
    return {"error": abs(found - exact)}


@measurement("flip", GROUP, "Scores: FLIP", _COLUMNS, ("error",))
def flip_score(request: Request) -> Iterator[Series]:
    """Gray images have one channel: the other two are left out, and filters are separable.

    The authors' package flip-evaluator, in colour.

    The scores differ by the package's float32, far below the digits that tables show.

    tests/benchmark/metrics
    """
    for name, pair in pairs(request).items():
        images = pair.truth8, pair.prediction8
        calls: Calls = {"flip-evaluator, colour": package_flip(*images), "flip": partial(flip, *images)}
        yield compared(f"FLIP of {name}", calls, _error, request.pick(1, 3, 7), "flip")


def package_flip(truth: UInt8, prediction: UInt8) -> Callable[[], float]:
    """Return a call of the package flip-evaluator on the images as RGB."""
    try:
        from flip_evaluator import evaluate
    except ImportError:
        fix = "pip install flip-evaluator"
        raise problem("FLIP", "the package flip-evaluator to compare with", "none", fix) from None
    images = [np.repeat((i / 255).astype(np.float32)[..., None], 3, axis=2) for i in (truth, prediction)]
    return lambda: float(evaluate(*images, "LDR", applyMagma=False)[1])


def random_stream(ticks: int, width: int, height: int, seed: int = 0) -> SpikeStream:
    """Return a stream of random bits: no layout or sparsity to profit from."""
    rng = np.random.default_rng(seed)
    packed = rng.integers(0, 256, (ticks, bytes_per_tick(width, height)), dtype=np.uint8)
    return SpikeStream(packed, width, height, 20_000.0)


def unpack_plainly(stream: SpikeStream) -> UInt8:
    """Return the window of all ticks, [T, H, W] upright, by np.unpackbits and a flip of the rows."""
    bits = np.unpackbits(stream.packed, axis=1, count=stream.width * stream.height, bitorder="little")
    return np.ascontiguousarray(bits.reshape(-1, stream.height, stream.width)[:, ::-1])


@measurement(
    "decoding",
    GROUP,
    "Spikes: decoding packed bits",
    (*TIMES, Column("error", "largest difference, spikes")),
    ("error",),
)
def decoding(request: Request) -> Iterator[Series]:
    """Windows and counts come from the packed bits, many pixels at a time.

    `numpy.unpackbits`, a flip of the rows, and a sum.

    Bits are exact: only time and memory count.

    tests/benchmark/spikes
    """
    width, height, ticks = request.pick((24, 16, 50), (200, 125, 1000), (400, 250, 1000))
    stream = random_stream(ticks, width, height, request.seed)

    def error(found: Any, exact: Any) -> dict[str, float]:
        return {"error": float(np.abs(found.astype(np.int64) - exact).max())}

    for name, plainly, ours in (
        ("all ticks", lambda: unpack_plainly(stream), lambda: stream.window(0, ticks)),
        ("counts", lambda: unpack_plainly(stream).sum(0, np.uint16), lambda: stream.counts(0, ticks)),
    ):
        calls = {"numpy unpackbits": plainly, "spike4dgs": ours}
        yield compared(f"{name}: {ticks} ticks of {width}x{height}", calls, error, request.pick(1, 5, 9), "spike4dgs")
