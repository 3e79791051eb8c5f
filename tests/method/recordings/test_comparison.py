from __future__ import annotations

import numpy as np
import pytest
from toy_world import ToyWorld

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.baselines.images.tfp import TfpSettings
from spike4dgs.baselines.recipes import METHODS
from spike4dgs.benchmark.metrics.metric import MAX_PSNR_DB
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.recordings.comparison import Comparison, compare, mean_residual, residual_db


class Black:
    def render(self, camera: Camera, t_us: float) -> np.ndarray:
        return np.zeros((camera.height, camera.width), np.float32)


def test_the_images_are_those_that_the_fit_has() -> None:
    """By the recipe's own settings of its image maker."""
    scene = ToyWorld(width=32, height=20, side=2, n_ticks=120).training
    method = METHODS["tfp+4dgs"].with_settings({"image_maker.half_window": 5}, "short")
    found = compare(method, Black(), scene, scene.cameras, "cpu", IMAGES["tfi"])
    maker = IMAGES["tfp"].with_settings(TfpSettings(half_window=5))
    expected = maker(scene.streams[0], [round(found.times_us[4] * scene.rate_hz / 1e6)], scene.radiance_gain)[0]
    np.testing.assert_array_equal(found.images[4, 0], expected)


def test_the_residual_of_equal_images_is_finite() -> None:
    image = np.array([0.25, 0.5, np.nan])
    assert residual_db(image, image) == MAX_PSNR_DB == 100.0
    assert residual_db(image, image + 1e-9) == MAX_PSNR_DB, "and no render has more"


def test_a_camera_that_measured_nothing_is_not_in_the_mean() -> None:
    cameras = ToyWorld(width=8, height=6, side=2, n_ticks=10).training.cameras[:2]
    images = np.full((1, 2, 6, 8), 0.5, np.float32)
    images[:, 1] = np.nan
    found = Comparison(cameras, (0.0,), images, np.full_like(images, 0.6), "tfp")
    assert mean_residual(found) == pytest.approx(20)
