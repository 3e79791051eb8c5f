"""What a scene's streams did not measure: bad pixels, and images around which a recording lacks most ticks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

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
    """Return the images around which a camera's recording lacks most ticks, [T, C]; None where there are none."""
    if not any(stream.gaps for stream in scene.streams):
        return None
    lacking = [~present(stream.gaps, scene.n_ticks) for stream in scene.streams]
    return np.array([[own[max(0, t - NEAR_TICKS) : t + NEAR_TICKS].mean() > 0.5 for own in lacking] for t in ticks])
