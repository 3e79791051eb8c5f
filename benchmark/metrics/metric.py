"""A row of the metric table."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Literal

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.screen.shown import Shown
from spike4dgs.benchmark.weights import WeightFile

MAX_PSNR_DB = 100.0  # half-float images with any error at all stay far below it


def psnr_db(squares: Float64) -> float:
    """Return 10 log10(1 / MSE) of squared errors [N], in the unit of white."""
    mse = float(np.mean(squares))
    return min(-10 * math.log10(mse), MAX_PSNR_DB) if mse > 0 else MAX_PSNR_DB


class Images(Enum):
    """The images of a scene for which a metric has a value. The dataset decides, so all methods share them."""

    EVERY = "images"
    MOVING = "images that have a moving region"
    COVISIBLE = "images of cameras whose depth the scene has"
    LATER = "images that have an earlier one of their camera"
    RECORDED = "images around which the camera recorded every tick"
    RECORDED_MOVING = "images with a moving region around which the camera recorded every tick"


@dataclass(frozen=True, kw_only=True, repr=False)
class Metric(Shown):
    """One row of the table.

    `measure` returns the value of an image pair, or None where the dataset defines none. It raises UserError for a
    prediction that the metric refuses; the scene then has no value.
    """

    id: str
    title: str
    definition: str
    higher_is_better: bool
    implementation: str
    measure: Callable[[ImagePair], float | None]
    unit: str = ""
    digits: int = 4  # decimals shown to people; records keep the full value
    takes: Literal["linear", "srgb8", "spikes"] = "linear"
    images: Images = Images.EVERY
    weights: WeightFile | None = None  # a file that users bring; None: always computable
    aligned: bool = False  # the prediction is first multiplied by the scene's gain
    blind: bool = False  # it does not use the truth, so the truth has a score of its own
    added_later: bool = False  # records that were written before it lack it
    tolerance: float = 1e-6  # largest difference between two machines' values of the same files

    def _about(self) -> str:
        return f"{self.id}: {self.definition}"

    def format(self, value: float | None) -> str:
        """Return the value as people read it; a dash for null."""
        return "-" if value is None else f"{value:.{self.digits}f}"
