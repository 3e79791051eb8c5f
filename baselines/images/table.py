"""The table of image makers: a recipe names one of them as its `images`."""

from __future__ import annotations

import numpy as np

from spike4dgs.baselines.images.published.makers import MAKERS as PUBLISHED
from spike4dgs.baselines.images.spk2img.maker import SPK2IMG
from spike4dgs.baselines.images.tfi import TFI
from spike4dgs.baselines.images.tfp import TFP
from spike4dgs.baselines.images.tfstp import TFSTP
from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import unknown
from spike4dgs.benchmark.screen.shown import Table
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.image_network.maker import MSDI
from spike4dgs.method.images.adaptive import ADAPTIVE
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.images.intervals import INTERVALS

OURS = (TFP, TFI, TFSTP, SPK2IMG, ADAPTIVE, INTERVALS, MSDI)
IMAGES: dict[str, ImageMaker] = Table("image makers", {maker.name: maker for maker in (*OURS, *PUBLISHED)})


def make_image(name: str, stream: SpikeStream, tick: int, gain: float) -> Float32:
    """Return the image [H, W] of a stream at the start of a tick, by the named image maker.

    Linear radiance, 1.0 = white; gain: spikes per tick of a pixel that sees white, such as `Scene.radiance_gain`.
    Raises UserError for an unknown name and for a tick outside the clip.
    """
    if name not in IMAGES:
        raise unknown("image maker", name, IMAGES)
    return np.asarray(IMAGES[name](stream, [tick], gain)[0])


__all__ = ["IMAGES", "ImageMaker", "make_image"]
