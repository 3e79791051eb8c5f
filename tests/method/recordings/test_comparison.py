from dataclasses import replace

import numpy as np
import pytest
from toy_fits import MOTIONS, SUPERVISIONS, request
from toy_world import ToyWorld
from warm_cameras import warm_scene

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.baselines.images.tfp import TfpSettings
from spike4dgs.baselines.recipes import METHODS
from spike4dgs.benchmark.method import Recipe
from spike4dgs.benchmark.metrics.metric import MAX_PSNR_DB
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.fit import FitJob, Parts, RecipeMethod
from spike4dgs.method.recordings.comparison import TIMES, Comparison, compare, mean_residual, residual_db
from spike4dgs.method.starts.base import Initialization, Start
from spike4dgs.method.training_views.training_images import TrainingImages


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


def test_the_images_have_the_dark_rates_that_the_fit_finds() -> None:
    warm = warm_scene((2.0,))
    start = Initialization(lambda r: Start(r.scene.cameras, np.array([[0, 0, 2]], np.float32), np.ones(1, np.float32)))
    parts = Parts({"tfp": IMAGES["tfp"]}, {"one": start}, MOTIONS, SUPERVISIONS)
    settings = {"images.flat_field": True, "images.max_times": TIMES}
    method = RecipeMethod(Recipe("test", "tfp", "one", "static", "pixel", settings), parts)
    fitted: list[TrainingImages] = []

    def fit(job: FitJob) -> Black:
        fitted.append(job.training_images)
        return Black()

    method.algorithm = replace(method.algorithm, fit=fit)
    model = method.fit(warm, request())
    found = compare(method, model, warm, warm.cameras, "cpu", IMAGES["tfi"])
    np.testing.assert_array_equal(found.images, fitted[0].images.numpy())


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
