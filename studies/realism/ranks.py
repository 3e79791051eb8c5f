"""Do image makers rank alike on a real recording and on a simulated one, by how well they predict the next spikes?"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.stats import kendalltau

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.baselines.images.tfp import TFP, TfpSettings
from spike4dgs.benchmark.arrays import Mask, UInt8
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.studies.realism.windows import stream_of

SEEN, NEXT = 100, 10  # ticks that an image is made of, and whose counts it predicts
MAKERS: Mapping[str, ImageMaker] = {
    **{f"tfp, {2 * half} ticks": TFP.with_settings(TfpSettings(half_window=half)) for half in (5, 10, 20, 40)},
    **{name: IMAGES[name] for name in ("tfi", "tfstp", "adaptive", "intervals")},
}
NETWORKS = ("spk2img", "msdi", "ssml", "ssir", "scflow-tfp")  # SpikeCLIP looks at more ticks than there are


def makers_here() -> dict[str, ImageMaker]:
    """Return the image makers, those of networks where their weights are installed."""
    return {**MAKERS, **{name: IMAGES[name] for name in NETWORKS if IMAGES[name].learned() is not None}}


def prediction_errors(
    spikes: UInt8, regions: Mapping[str, Mask], makers: Mapping[str, ImageMaker] = MAKERS
) -> dict[str, dict[str, float]]:
    """Return for each of `regions` [H, W] each maker's mean squared error, in spikes per tick, of the next NEXT ticks.

    An image is made of the SEEN ticks before alone, and asked for at their end.
    """
    errors: dict[str, dict[str, list[float]]] = {region: {name: [] for name in makers} for region in regions}
    for tick in range(SEEN, len(spikes) - NEXT + 1, 2 * NEXT):
        seen, truth = stream_of(spikes[tick - SEEN : tick]), spikes[tick : tick + NEXT].mean(0)
        for name, maker in makers.items():
            image = maker(seen, [SEEN - 1], 1.0)[0]
            for region, pixels in regions.items():
                errors[region][name].append(float(np.mean((image - truth)[pixels] ** 2)))
    return {region: {name: float(np.mean(of)) for name, of in found.items()} for region, found in errors.items()}


def agreement(first: Mapping[str, float], second: Mapping[str, float]) -> float:
    """Return Kendall's rank correlation of two errors of the same makers."""
    return float(kendalltau([*first.values()], [second[name] for name in first]).statistic)
