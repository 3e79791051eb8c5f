"""The images that a fit compares with, and what was not measured: bad pixels, images in long gaps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from torch import Tensor

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.scene.camera_state import local_ticks
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.method.splat import Views


@dataclass(frozen=True, eq=False)
class Spans:
    """Spans of time that the values of images are means over, in ticks from the image's own."""

    ends: Tensor  # float16 [..., 2, H, W], the first and the last instant
    half: float  # half the median length
    n_ticks: int  # of the clip
    doubts: Tensor | None = None  # float16 [..., 4, H, W], see `ImageMaker.with_spans`; None: no tick is lost

    def at(self, index: slice | int | Tensor) -> Spans:
        """Return the spans of some images."""
        doubts = None if self.doubts is None else self.doubts[index]
        return replace(self, ends=self.ends[index], doubts=doubts)


@dataclass(frozen=True, eq=False)
class TrainingImages:
    """Images of all training views at some times."""

    views: Views
    ticks: tuple[int, ...]  # ascending
    images: Tensor  # [T, C, H, W] linear radiance
    n_ticks: int  # length of the clip
    bad: Tensor | None = None  # bool [C, H, W], bad and dead pixels, with a neighbour's values; None: there are none
    missing: Tensor | None = None  # bool [T, C], images where a recording lacks most ticks; None: there are none
    spans: Spans | None = None  # of [T, C]; None: the images show instants
    exposure_ticks: int = 0  # that images of another sensor are means over, from tick - exposure_ticks // 2 on
    light: Float64 | None = None  # factors [n_ticks] of a lamp that the images show; None: they show one light

    def measured(self, index: int, views: Sequence[int] | slice = slice(None)) -> Tensor:
        """Return the images [V, H, W] of some views at one time for a loss: NaN where nothing was measured."""
        image, unmeasured = self.images[index][views], self._unmeasured
        return image if unmeasured is None else image.masked_fill(unmeasured[index][views], math.nan)

    @cached_property
    def _unmeasured(self) -> Tensor | None:
        """Where nothing was measured, bool [T, C, H, W]: made once, as a fit asks in each step."""
        masks = []
        if self.bad is not None:
            masks.append(self.bad)
        if self.missing is not None:
            masks.append(self.missing[..., None, None])
        if self.spans is not None:  # before a pixel's first spike and after its last, a span is of another time
            first, last = self.spans.ends.unbind(2)
            masks.append((first > 0) | (last < 0))
        return reduce(torch.logical_or, masks).expand(self.images.shape) if masks else None

    def at(self, index: int) -> TrainingImages:
        """Return the images of one time alone."""
        missing = None if self.missing is None else self.missing[index : index + 1]
        times = slice(index, index + 1)
        spans = None if self.spans is None else self.spans.at(times)
        return replace(self, ticks=self.ticks[times], images=self.images[times], missing=missing, spans=spans)


def known(image: Tensor, rendered: Tensor) -> Tensor:
    """Return `image`, with the values of `rendered` of the same shape, without gradient, where it is no number."""
    return torch.where(image.isfinite(), image, rendered.detach())


NEAR_TICKS = 20  # on each side of an image's tick: most makers look no further


def bad_pixels(scene: TrainingScene) -> list[NDArray[np.bool_]] | None:
    """Return the bad pixels [H, W] of each training stream; None where there are none."""
    masks = [scene.state(camera.id).bad for camera in scene.cameras]
    if all(mask is None for mask in masks):
        return None
    return [np.zeros((s.height, s.width), bool) if m is None else m for m, s in zip(masks, scene.streams, strict=True)]


def fill_dead(images: Float32) -> NDArray[np.bool_] | None:
    """Give the pixels of images [T, C, H, W] that are no number at some time the values of the nearest ones, in place.

    Return these pixels, [C, H, W]; None where there are none. A camera without any other pixel keeps its values.
    """
    dead = np.stack([~np.isfinite(own).all(0) for own in images.swapaxes(0, 1)])
    if not dead.any():
        return None
    for own, mask in zip(images.swapaxes(0, 1), dead, strict=True):
        if mask.any() and not mask.all():
            rows, columns = distance_transform_edt(mask, return_distances=False, return_indices=True)[:, mask]
            own[:, mask] = own[:, rows, columns]
    return dead


def missing_images(scene: TrainingScene, ticks: Sequence[int]) -> NDArray[np.bool_] | None:
    """Return the images that a camera lacks at ticks of the array, [T, C]; None where there are none.

    A camera lacks one where its recording lacks most ticks around its own tick, and where that is outside its clip.
    """
    clocks = [scene.state(camera.id).clock for camera in scene.cameras]
    local = [local_ticks(clock, ticks, scene.n_ticks) for clock in clocks]
    outside = np.array([[not i for i in inside] for _, inside in local]).T
    if not outside.any() and not any(stream.gaps for stream in scene.streams):
        return None
    lacking = [~present(stream.gaps, scene.n_ticks) for stream in scene.streams]
    near = [
        [own[max(0, t - NEAR_TICKS) : t + NEAR_TICKS].mean() > 0.5 for t in at]
        for own, (at, _) in zip(lacking, local, strict=True)
    ]
    return outside | np.array(near).T
