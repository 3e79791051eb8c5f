"""Images from what other sensors recorded beside the spike cameras: frames of a conventional camera, events."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.training_views.warm_up_scene import radiance_of


@dataclass(frozen=True, eq=False)
class Recorded:
    """Images of all training views, at the pixels of their sensors."""

    ticks: tuple[int, ...]  # ascending; with an exposure, the tick in its middle
    images: Float32  # [T, C, H, W] linear radiance
    exposure_ticks: int = 0  # that each image is a mean over, from tick - exposure_ticks // 2 on; 0: an instant


def _nothing(scene: TrainingScene, ticks: Sequence[int]) -> Recorded:
    raise NotImplementedError("an image maker of other sensors needs `read`")


@dataclass(frozen=True, kw_only=True, repr=False)
class RecordedImages(ImageMaker):
    """A named way from other sensors to images.

    `read` returns the images of a scene; of the ticks that a recipe asks for it may have fewer, or others. A fit with
    such images gets `without_spikes`; its first points come from the same images.
    """

    read: Callable[[TrainingScene, Sequence[int]], Recorded] = _nothing


def without_spikes(scene: TrainingScene) -> TrainingScene:
    """Return a scene of perfect cameras without calibrations, none of whose pixels ever fired."""
    first = scene.streams[0]
    empty = SpikeStream(np.zeros(first.packed.shape, np.uint8), first.width, first.height, first.rate_hz)
    return replace(scene, streams=(empty,) * len(scene.streams), recordings=(), states={})


def warm_up_images(scene: TrainingScene) -> Recorded:
    """Return images of the warm-up scene, whose recordings are no files, as another sensor could give them."""
    ticks = tuple(range(10, scene.n_ticks, 30))
    images = np.stack([radiance_of(camera)[list(ticks)] for camera in scene.cameras], axis=1)
    return Recorded(ticks, images.astype(np.float32), exposure_ticks=5)
