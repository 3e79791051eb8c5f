from __future__ import annotations

import numpy as np

from spike4dgs.benchmark.metrics.metric import MAX_PSNR_DB
from spike4dgs.method.recordings.comparison import residual_db


def test_the_residual_of_equal_images_is_finite() -> None:
    image = np.array([0.25, 0.5, np.nan])
    assert residual_db(image, image) == MAX_PSNR_DB == 100.0
    assert residual_db(image, image + 1e-9) == MAX_PSNR_DB, "and no render has more"
