"""The first of a recipe's four parts: what image does a spike window give?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.weights import FoundWeights

Float32 = NDArray[np.float32]


@dataclass(frozen=True)
class Learned:
    """The weights of a trained part: runs with other weights are other methods."""

    sha256: str  # of the weight file
    trained_on: tuple[str, ...]  # data sets, such as scenes as ID@REVISION


def learned_from(find: Callable[[], FoundWeights], read_card: Callable[[Path], Any]) -> Learned | None:
    """Return the hash and the training data of the weights in use; None where they are missing or damaged.

    A fit will say which of the two.
    """
    try:
        found = find()
        return Learned(found.sha256, read_card(found.path).trained_on)
    except UserError:
        return None


@dataclass(frozen=True)
class ImageMaker:
    """A named way from spikes to images. `rate` gives spikes per tick [H, W] float32 at the start of a tick.

    A pixel's own rate can be corrected by its calibration afterwards. What looks at neighbours is better told before:
    `corrected` gives the rate that an ideal camera's pixels would have. `learned` tells of the weights in use; None
    where nothing is learned or no weights are there.

    >>> IMAGES["tfp"](stream, ticks=[100, 200], gain=0.6).shape  # doctest: +SKIP
    (2, 250, 400)
    """

    name: str
    definition: str
    source: str
    rate: Callable[[SpikeStream, int], Float32]
    learned: Callable[[], Learned | None] = lambda: None
    corrected: Callable[[SpikeStream, int, Calibration], Float32] | None = None

    def __call__(
        self, stream: SpikeStream, ticks: Sequence[int], gain: float, camera: Calibration | None = None
    ) -> Float32:
        """Linear radiance [n, H, W] float32 (1.0 = white) at the starts of `ticks`; `gain`: spikes per tick of white.

        `camera` corrects the images for what its pixels do to light; a dead pixel has seen nothing, which is not
        black but NaN. Raises UserError for a tick outside the clip.
        """
        images = np.empty((len(ticks), stream.height, stream.width), np.float32)
        for image, tick in zip(images, ticks, strict=True):
            if not 0 <= tick < stream.n_ticks:
                raise problem(stream.source, f"ticks within [0, {stream.n_ticks})", f"{tick}", "ask for another tick")
            image[:] = self.corrected(stream, tick, camera) if self.corrected and camera else self.rate(stream, tick)
        if camera is None:
            images /= gain
            return images
        found = images / np.float32(camera.radiance_gain) if self.corrected else camera.radiance(images)
        found[:, ~(camera.gain > 0)] = np.nan
        return found
