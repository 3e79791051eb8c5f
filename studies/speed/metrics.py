"""`speed metrics`: time of every metric for one image, and FLIP beside the authors' package, with the error.

Those of spikes include the reading of the spikes and the means over time, which in a scene all of them share. Networks
without their weight file are timed with random weights: that changes the value, not the work.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.metrics.flip import flip
from spike4dgs.benchmark.metrics.held_out_spikes import record_around, response_of, view_spikes
from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.metrics.iqa.metaiqa import metaiqa_network, predict
from spike4dgs.benchmark.metrics.lpips import TRUNKS, empty_trunk, make_network
from spike4dgs.benchmark.metrics.metric import Metric
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.spikes.sensor_model import SENSOR
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.studies.speed.timing import show_table, time_ms

SIZES = ((125, 200), (250, 400))  # of the profiles small and paper
TICKS = 120  # of the stream that the metrics of spikes see
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


def make_stream(pair: ImagePair) -> SpikeStream:
    """Return the stream of a camera that sees the truth of a pair, which does not change."""
    charge = np.random.default_rng(0).random(pair.truth.shape)
    gathered = charge + SENSOR.radiance_gain * pair.truth * np.arange(TICKS + 1)[:, None, None]
    spikes = np.diff(np.floor(gathered), axis=0)
    height, width = pair.truth.shape
    return SpikeStream(pack(spikes), width, height, 20_000.0)


def runs(pair: ImagePair) -> dict[str, Callable[[], object]]:
    """Return a call for each metric that is not another one with a gain."""
    stream = make_stream(pair)
    calls: dict[str, Callable[[], object]] = {
        m.id: partial(_beside_spikes, m, pair, stream) if m.takes == "spikes" else partial(_anew, m, pair)
        for m in METRICS.values()
        if not m.aligned and m.weights is None
    }
    for net in TRUNKS:
        network = make_network(net, empty_trunk(net).eval())
        calls[f"lpips_{net}"] = partial(network.distance, pair.truth8, pair.prediction8)
    calls["metaiqa"] = partial(predict, metaiqa_network().eval(), pair.prediction8)
    return calls


def _anew(metric: Metric, pair: ImagePair) -> float | None:
    """Return the metric's value, computed from the radiance on: a copy of the pair has nothing cached."""
    return metric.measure(replace(pair))


def _beside_spikes(metric: Metric, pair: ImagePair, stream: SpikeStream) -> float | None:
    """Return the metric's value from the stream on, with a prediction and a truth each millisecond."""
    recorded = record_around(stream, TICKS // 2, response_of(None, pair.truth.shape, SENSOR.radiance_gain))
    ticks = [recorded.tick + 20 * k for k in (-3, -2, -1, 0, 1, 2, 3)]
    images = [[image] * len(ticks) for image in (pair.predicted_radiance, pair.truth_radiance)]
    return metric.measure(replace(pair, spikes=view_spikes(recorded, ticks, *images)))


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
