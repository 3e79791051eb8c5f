"""Ground truth on disk: colour and gray radiance, moving region, geometry."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_opening

from spike4dgs.benchmark.scene.images import gray, write_exr, write_geometry, write_mask
from spike4dgs.benchmark.scene.scene import Target
from spike4dgs.generators.profiles import RATE_HZ
from spike4dgs.generators.render_tasks import Truth

_MASK_GROW_PX = 2
_MASK_CHANGE = 0.1  # relative change of radiance that counts as moving light


def mask_file(scene: Path, target: Target) -> Path:
    """Return the path of a target's moving region: the file that `write_truth` writes last."""
    return scene / f"masks/{target.name}.png"


def write_truth(
    scene: Path,
    target: Target,
    truth: Truth,
    background: NDArray[np.float32],
    light_range: Callable[[], tuple[NDArray[np.float32], NDArray[np.float32]]],
) -> None:
    """Write image, geometry and mask of one target. `background` [H, W] is the gray background of its camera.

    `light_range` returns the smallest and largest radiance [H, W] of each pixel over the clip.
    """
    t_us = target.tick * 1e6 / RATE_HZ
    write_exr(scene / f"images/{target.name}.exr", truth.rgb, t_us)
    write_geometry(scene / f"geometry/{target.name}.exr", truth.depth, truth.ids, truth.flow, t_us)
    low, high = light_range()
    varies = high - low > _MASK_CHANGE * high
    write_mask(mask_file(scene, target), moving_region(truth.mask, gray(truth.rgb), background, varies))


def moving_region(
    object_mask: NDArray[np.bool_],
    image: NDArray[np.float32],
    background: NDArray[np.float32],
    varies: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Return the moving region [H, W] of a ground-truth image, over which the `*_dynamic` metrics are computed.

    It has two parts. The first is the moving objects' pixels, grown by 2 px. The second is the pixels whose light the
    objects change by shadow or reflection: their radiance differs from `background` by more than 10 % and also `varies`
    as much over the clip (the shadow of a disc that turns about its axis does not). Specks under 2 px are dropped.
    """
    lit = (np.abs(image - background) > _MASK_CHANGE * background) & varies
    grown = binary_dilation(object_mask, np.ones((3, 3)), iterations=_MASK_GROW_PX)
    return np.asarray(grown | binary_opening(lit, np.ones((2, 2))))
