"""What a fit looks at."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from spike4dgs.method.splat import Views


@dataclass(frozen=True, eq=False)
class TrainingImages:
    """Images of all training views at some times."""

    views: Views
    ticks: tuple[int, ...]  # ascending
    images: Tensor  # [T, C, H, W] linear radiance
    n_ticks: int  # length of the clip
