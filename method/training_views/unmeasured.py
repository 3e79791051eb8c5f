"""What a scene's streams did not measure: bad pixels, and images around which a recording lacks most ticks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.scene.camera_state import local_ticks
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.gaps import present

NEAR_TICKS = 20  # on each side of an image's tick: most makers look no further


def bad_pixels(scene: TrainingScene) -> list[NDArray[np.bool_]] | None:
    """Return the bad pixels [H, W] of each training stream; None where there are none."""
    masks = [scene.state(camera.id).bad for camera in scene.cameras]
    if all(mask is None for mask in masks):
        return None
    return [np.zeros((s.height, s.width), bool) if m is None else m for m, s in zip(masks, scene.streams, strict=True)]


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
