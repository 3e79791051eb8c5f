import json
from functools import cache

import numpy as np
import pytest
from spike4dgs.baselines.recipes import METHODS, RECIPES
from spike4dgs.baselines.spike_to_image import IMAGES
from spike4dgs.benchmark.cameras import Camera
from spike4dgs.benchmark.recipes import Budget, find_methods
from spike4dgs.benchmark.scene import TrainingScene

from toy_world import ToyWorld


@cache
def scene() -> TrainingScene:
    return ToyWorld(width=40, height=24, n_ticks=120).training


def silent(done: int, total: int, note: str = "") -> None:
    pass


def test_the_four_recipes_are_registered_under_their_names():
    assert list(METHODS) == ["tfi+4dgs", "tfp+4dgs", "tfp+static", "nearest-view"]
    found = find_methods()
    assert all(found[name] is METHODS[name] and METHODS[name].name == name for name in METHODS)


def test_parameters_are_plain_values_and_name_every_setting():
    for name, method in METHODS.items():
        assert json.loads(json.dumps(method.params)) == method.params and method.params["name"] == name
    assert METHODS["tfp+4dgs"].params["settings"]["ssim_weight"] == 0.2


def test_recipes_that_are_compared_differ_in_one_part():
    tfi, tfp, static = (r.as_dict() for r in RECIPES)
    assert [k for k in tfi if tfi[k] != tfp[k]] == ["name", "images"]
    assert [k for k in tfp if tfp[k] != static[k]] == ["name", "motion", "settings"]
    assert set(static["settings"]) == {"coarse_steps"}


@pytest.mark.parametrize("name", list(METHODS))
def test_every_recipe_fits_and_renders(name):
    reports = []
    method = METHODS[name]
    model = method.fit(scene(), Budget(0.005), "cpu", 0, lambda done, total, note="": reports.append((done, total)))
    camera = ToyWorld(width=40, height=24).held_out
    images = [model.render(camera, t_us) for t_us in (-10.0, 0.0, 3000.0, 1e9)]
    assert all(i.shape == (24, 40) and i.dtype == np.float32 and np.isfinite(i).all() for i in images)
    assert all((i >= 0).all() for i in images) and reports[-1][0] == reports[-1][1]
    assert 0.2 < images[2].mean() < 0.8


def test_nearest_view_shows_the_picture_of_the_nearest_camera():
    model = METHODS["nearest-view"].fit(scene(), Budget(), "cpu", 0, silent)
    for i, camera in enumerate(scene().cameras):
        a = camera
        near = Camera("test", a.width, a.height, a.fx, a.fy, a.cx, a.cy, a.R, a.t + 0.001)
        expected = IMAGES["tfp"](scene().streams[i], [60], scene().radiance_gain)[0]
        assert np.array_equal(model.render(near, 60 * 50.0), expected)
    centre = ToyWorld(width=40, height=24).held_out  # four cameras are equally near: the first of them
    assert np.array_equal(model.render(centre, 3000.0), IMAGES["tfp"](scene().streams[1], [60], 0.6)[0])
