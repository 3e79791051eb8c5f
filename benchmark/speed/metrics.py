"""`speed metrics`: time of every metric for one image, and FLIP beside the authors' package, with the error.

Networks without their weight file are timed with random weights: that changes the value, not the work.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.metrics.flip import flip
from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.metrics.iqa.metaiqa import metaiqa_network, predict
from spike4dgs.benchmark.metrics.lpips import TRUNKS, empty_trunk, make_network
from spike4dgs.benchmark.metrics.table import METRICS, Metric
from spike4dgs.benchmark.scene.images import UInt8
from spike4dgs.benchmark.speed.timing import show_table, time_ms

SIZES = ((125, 200), (250, 400))  # of the profiles small and paper
COLUMNS = ("metric", "height", "width", "by", "min ms", "median ms", "error")


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


def runs(pair: ImagePair) -> dict[str, Callable[[], object]]:
    """Return a call for each metric that is not another one with a gain."""
    calls: dict[str, Callable[[], object]] = {
        m.id: partial(_anew, m, pair) for m in METRICS.values() if not m.aligned and m.weights is None
    }
    for net in TRUNKS:
        network = make_network(net, empty_trunk(net).eval())
        calls[f"lpips_{net}"] = partial(network.distance, pair.truth8, pair.prediction8)
    calls["metaiqa"] = partial(predict, metaiqa_network().eval(), pair.prediction8)
    return calls


def _anew(metric: Metric, pair: ImagePair) -> float | None:
    """Return the metric's value, computed from the radiance on: a copy of the pair has nothing cached."""
    return metric.measure(replace(pair))


def package_flip(truth: UInt8, prediction: UInt8) -> Callable[[], float] | None:
    """Return a call of the package flip-evaluator on the images as RGB; None where it is not installed."""
    try:
        from flip_evaluator import evaluate
    except ImportError:
        return None
    images = [np.repeat((i / 255).astype(np.float32)[..., None], 3, axis=2) for i in (truth, prediction)]
    return lambda: float(evaluate(*images, "LDR", applyMagma=False)[1])


def metrics(argv: Sequence[str] = ()) -> int:
    """Time every metric for one image of each profile's size."""
    p = argparse.ArgumentParser("spike4dgs speed metrics", description=metrics.__doc__)
    p.add_argument("--repeats", type=int, default=5)
    p.add_argument("--csv", type=Path, help="write the table here too")
    a = p.parse_args(list(argv))
    rows = []
    for height, width in SIZES:
        pair = make_image_pair(height, width)
        for name, call in runs(pair).items():
            shown = [f"{ms:.2f}" for ms in time_ms(call, a.repeats)]
            rows.append((name, str(height), str(width), "spike4dgs", *shown, ""))
        if (reference := package_flip(pair.truth8, pair.prediction8)) is not None:
            shown = [f"{ms:.2f}" for ms in time_ms(reference, a.repeats)]
            error = abs(reference() - flip(pair.truth8, pair.prediction8))
            rows.append(("flip", str(height), str(width), "flip-evaluator", *shown, f"{error:.1e}"))
    show_table("one image", COLUMNS, rows, a.csv)
    return 0
