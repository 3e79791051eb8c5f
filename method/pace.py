"""Images as close in time as the motion in a clip asks.

Spans, the spacing of images and the pieces of a clip are made for motion of up to a pixel from one image to the next.
In a clip with faster motion images stand closer by as much, and their spans and the pieces are as much shorter.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.images.training import ImageSettings
from spike4dgs.method.training_views.changes import POINTS, changing
from spike4dgs.method.training_views.light_layers import in_mean_light
from spike4dgs.method.training_views.training_images import TrainingImages
from spike4dgs.method.training_views.velocities import LEAST_SIDE_PX, mean_flow, seen_by_enough

SHARE = 0.95  # of the pixels that change, which move more slowly than what counts as fast
TIMES = (0.25, 0.5, 0.75)  # of the clip, at which motion is measured
MOST_PX = 1.0  # from one image to the next, as many ticks apart as the settings say

MakeImages = Callable[[ImageMaker, ImageSettings], TrainingImages]


def at_pace(
    scene: str, maker: ImageMaker, settings: Mapping[str, Any], make: MakeImages
) -> tuple[TrainingImages, Mapping[str, Any], float]:
    """Return images, settings and pace of a fit: how many times faster motion is than what the settings are for, or 1.

    Says so on the terminal where it is faster.
    """
    images = make(maker, settings["images"])
    follows = getattr(settings["motion"], "in_pace", False)
    moved = settings["images"].time_spacing_ticks * fast_motion(images) if follows else 0.0
    if moved <= MOST_PX:
        return images, settings, 1.0
    pace = moved / MOST_PX
    print(f"{scene}: fast motion, {moved:.1f} px between images: images and pieces that much shorter", file=sys.stderr)
    denser = {**settings, "images": settings["images"].denser(pace)}
    del images  # the others are as large
    return make(maker.with_settings(maker.settings.denser(pace)), denser["images"]), denser, pace


def fast_motion(images: TrainingImages) -> float:
    """Return how fast what is fast moves, in px a tick, by optical flow; 0 where nothing changes or images are few."""
    count = len(images.ticks)
    if count < 3 or min(images.views.width, images.views.height) < LEAST_SIDE_PX:
        return 0.0
    whole = np.array([m for m in range(1, count - 1) if seen_by_enough(images, (m - 1, m, m + 1))])
    if not len(whole):
        return 0.0
    middles = sorted({int(whole[np.abs(whole - round(t * (count - 1))).argmin()]) for t in TIMES})
    trios = torch.tensor([[m - 1, m, m + 1] for m in middles])
    values = in_mean_light(images).images[trios].cpu()
    changed = changing(values.flatten(0, 1), POINTS).numpy()
    found = []
    for trio, trio_values in zip(trios, values.numpy(), strict=True):
        known = (
            changed if images.missing is None else changed & ~images.missing[trio].any(0).cpu().numpy()[:, None, None]
        )
        flows = [mean_flow(*trio_values[:, c])[:, seen] for c, seen in enumerate(known)]
        moved = np.hypot(*np.concatenate(flows, axis=1))
        moved = moved[np.isfinite(moved)] / (images.ticks[trio[2]] - images.ticks[trio[0]]) * 2
        if len(moved):
            found.append(float(np.quantile(moved, SHARE)))
    return max(found, default=0.0)
