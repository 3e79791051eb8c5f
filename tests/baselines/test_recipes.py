import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from spike4dgs.baselines.images.tfp import tfp_image
from spike4dgs.baselines.recipes import CALIBRATED, PARTS, POSED, RECIPES, SUPERVISED
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.method import Budget, FitRequest, Recipe, find_methods
from spike4dgs.benchmark.reports.paper_tables import published
from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.scene.camera_state import CameraState
from spike4dgs.benchmark.scene.scene import Scene, TrainingScene, open_scene
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.recipes import RECIPES as OURS

METHODS = find_methods()
ALL = (*OURS, *RECIPES, *CALIBRATED, *SUPERVISED, *POSED)

TINY = Budget(scale=0.01)
# One of each kind of fit that needs nothing that a user brings, and no features in the images.
FITTED = ["nearest-view", "tfp+static", "tfi+4dgs", "tfp+stg", "tfp+d3dgs", "dy-spikegs", "dy-spikenerf"]
FITTED += ["tfp+4dgs+spss", "spike4dgs", "spike4dgs-x"]


@pytest.fixture(scope="module")
def scene(one_small_scene: Path) -> Scene:
    return open_scene(one_small_scene)


def test_every_row_of_the_papers_tables_is_a_method() -> None:
    assert all(method.name == name for name, method in METHODS.items())
    main = {recipe.name for recipe in RECIPES} - {"tfp+static"} | {"spike4dgs", "spike4dgs-x"}
    for number in (1, 2):
        assert set(published(number).rows) == main
        posed = {recipe.name for recipe in POSED} | {"spike4dgs-uncalibrated"}
        assert set(published(number, "estimated").rows) <= posed
    for number in (3, 4, 5, 7):
        assert set(published(number).rows) <= set(METHODS)


@pytest.mark.parametrize("recipe", ALL, ids=lambda r: r.name)
def test_a_recipe_is_the_parts_that_its_name_says(recipe: Recipe) -> None:
    motions = {"d3dgs": "tracking", "stg": "spacetime", "4dgs": "hexplane", "static": "static"}
    if recipe.name.startswith(("dy-", "spike4dgs")):
        assert recipe.name.endswith("+colmap") == recipe.initialization.startswith("colmap")
    else:
        images, *middle = recipe.name.removesuffix(".tuned").split("+")
        at = next(i for i, part in enumerate(middle) if part in motions)
        assert (recipe.images, recipe.motion) == (images, motions[middle[at]])
        expected = ("+".join(middle[:at]) or ("msdi" if images == "msdi" else "rig")).removesuffix("-flat")
        assert recipe.initialization == expected
        assert recipe.supervision == ("+".join(middle[at + 1 :]) or "pixel")
    method = METHODS[recipe.name]
    assert isinstance(method, RecipeMethod) and method.initialization.estimates_poses == (
        recipe.initialization not in ("rig", "msdi")
    )
    assert recipe.images in PARTS.images and recipe.initialization in PARTS.initialization
    assert recipe.motion in {**PARTS.motion, **PARTS.algorithms}


def test_images_and_first_points_are_corrected_as_the_recipe_says() -> None:
    """One fact, `images.flat_field`; one row calibrates itself."""
    for name, method in METHODS.items():
        if isinstance(method, RecipeMethod):
            settings = method.params["settings"]
            corrected = name.startswith(("spike4dgs", "msdi")) or "rig-flat" in name
            corrected &= not name.endswith("+self-calibrated")
            assert settings["images"]["flat_field"] == corrected, name
            assert settings["initialization"].get("flat_field", corrected) == corrected, name


@pytest.mark.parametrize("recipe", RECIPES, ids=lambda r: r.name)
def test_a_two_stage_row_has_a_twin_that_only_the_calibration_tells_from_it(recipe: Recipe) -> None:
    if recipe.name.startswith("dy-") or recipe.motion == "static":
        return
    twin = METHODS[recipe.name.replace("+", "+rig-flat+")]
    assert isinstance(twin, RecipeMethod) and twin.given == ("poses", "flat-field")
    own, calibrated = METHODS[recipe.name].params["settings"], twin.params["settings"]
    changed = {(part, key) for part in own for key in own[part] if own[part][key] != calibrated[part][key]}
    assert changed == {("images", "flat_field"), ("initialization", "flat_field")}
    assert own.keys() == calibrated.keys() and twin.params["supervision"] == recipe.supervision


@pytest.mark.parametrize("images", ["tfi", "tfp", "spk2img", "adaptive"])
def test_images_of_calibrated_rows_show_even_light_as_even(images: str) -> None:
    """Integrate-and-fire pixels, those on the right twice as sensitive as those on the left."""
    radiance_gain, light, n = 0.6, 0.5, 400
    gain = np.where(np.arange(40) < 20, 2 / 3, 4 / 3) * np.ones((24, 1))
    ticks = np.arange(1, n + 1)[:, None, None]
    charge = np.random.default_rng(0).random((24, 40)) + ticks * gain * radiance_gain * light
    stream = SpikeStream(pack(np.diff(np.floor(charge), axis=0, prepend=0) > 0), 40, 24, 20_000.0)
    camera = Calibration(gain.astype(np.float32), np.zeros((24, 40), np.float32), radiance_gain)
    raw = PARTS.images[images](stream, [n // 2], radiance_gain)[0]
    corrected = PARTS.images[images](stream, [n // 2], radiance_gain, camera)[0]
    sides = slice(0, 16), slice(24, 40)  # a network looks at neighbours
    left, right = (float(raw[:, side].mean()) for side in sides)
    assert right / left == pytest.approx(2, rel=0.1)
    assert [float(corrected[:, side].mean()) for side in sides] == pytest.approx([light, light], rel=0.1)


def test_a_recipe_holds_settings_of_its_own_parts_only() -> None:
    trained = {"images", "initialization", "motion", "supervision", "trainer", "density"}
    looped = {"images", "initialization", "motion", "supervision"}
    for name, parts in {
        "tfp+static": trained | {"image_maker"},
        "spike4dgs-x": trained | {"image_maker"},
        "spike4dgs": trained,
        "tfp+d3dgs": looped | {"image_maker"},
        "dy-spikenerf": looped | {"image_maker", "occupancy"},
    }.items():
        settings = METHODS[name].params["settings"]
        assert set(settings) == parts
        assert max(len(values) for values in settings.values()) <= 25
    assert METHODS["tfp+static"].params["settings"]["motion"] == {}


def test_params_survive_json_and_tell_recipes_and_settings_apart() -> None:
    for name, method in METHODS.items():
        assert json.loads(json.dumps(method.params, allow_nan=False)) == method.params
        assert method.params["name"] == name
    texts = {json.dumps(m.params, sort_keys=True) for m in METHODS.values()}
    changed = RecipeMethod(dataclasses.replace(METHODS["tfi+4dgs"].recipe, settings={"motion.levels": 1}), PARTS)
    texts.add(json.dumps(changed.params, sort_keys=True))
    assert len(texts) == len(METHODS) + 1


@pytest.mark.parametrize("name", FITTED)
def test_each_kind_of_method_fits_and_renders_the_held_out_camera(name: str, scene: Scene) -> None:
    reports: list[tuple[int, int]] = []
    request = FitRequest(TINY, progress=lambda done, total, note="": reports.append((done, total)))
    model = METHODS[name].fit(scene.training, request)
    target = scene.targets[1]
    camera = scene.cameras[target.camera]
    image = model.render(camera, scene.t_us(target.tick))
    assert image.shape == (camera.height, camera.width) and image.dtype == np.float32
    assert np.isfinite(image).all() and image.min() >= 0
    assert abs(image.mean() - scene.ground_truth(target).mean()) < 0.15
    assert reports[-1][0] == reports[-1][1] and all(0 <= done <= total for done, total in reports)
    for t_us in (-5.0, 0.0, scene.training.duration_us, 1e9):  # the clip's ends and beyond
        assert np.isfinite(model.render(camera, t_us)).all()


def test_nearest_view_is_the_nearest_training_cameras_tfp_in_any_order_of_cameras(scene: Scene) -> None:
    model = METHODS["nearest-view"].fit(scene.training, FitRequest(TINY))
    for tick in (0, 20, 60, scene.n_ticks - 1):
        # The cameras are in a row and cam_03 is held out, next to cam_02.
        expected = tfp_image(scene.stream("cam_02"), tick) / scene.radiance_gain
        np.testing.assert_allclose(model.render(scene.cameras["cam_03"], scene.t_us(tick)), expected, rtol=1e-6)
    own = model.render(scene.cameras["cam_00"], scene.t_us(40))
    np.testing.assert_allclose(own, tfp_image(scene.stream("cam_00"), 40) / scene.radiance_gain, rtol=1e-6)

    cameras, streams = (tuple(getattr(scene.training, part)[i] for i in (2, 0, 1)) for part in ("cameras", "streams"))
    mixed = METHODS["nearest-view"].fit(
        dataclasses.replace(scene.training, cameras=cameras, streams=streams), FitRequest(TINY)
    )
    images = [m.render(scene.cameras["cam_03"], 2000.0) for m in (model, mixed)]
    np.testing.assert_array_equal(*images)
    states = {"cam_02": CameraState(gain=1.25)}  # which counts more spikes of the same light
    brighter = METHODS["nearest-view"].fit(dataclasses.replace(scene.training, states=states), FitRequest(TINY))
    image = brighter.render(scene.cameras["cam_03"], 2000.0)
    np.testing.assert_allclose(image, images[0] / 1.25, rtol=1e-6)


@pytest.mark.parametrize("part", ["images", "initialization", "motion", "supervision"])
def test_an_unknown_part_is_named(part: str) -> None:
    parts: dict[str, Any] = {"images": "tfp", "initialization": "rig", "motion": "static", "supervision": "pixel"}
    with pytest.raises(UserError, match=f"recipe mine: expected {part} among .*found 'nothing'"):
        RecipeMethod(Recipe("mine", **{**parts, part: "nothing"}), PARTS)


def test_a_recipe_overrides_the_numbers_of_its_image_maker(scene: Scene) -> None:
    recipe = Recipe("wide", "tfp", "rig", "static", "pixel", {"image_maker.half_window": 30})
    wide = RecipeMethod(recipe, PARTS)
    assert wide.params["settings"]["image_maker"] == {"half_window": 30}
    camera, t_us = scene.cameras["cam_03"], 2000.0
    default = METHODS["tfp+static"].fit(scene.training, FitRequest(TINY)).render(camera, t_us)
    assert not np.array_equal(wide.fit(scene.training, FitRequest(TINY)).render(camera, t_us), default)
    with pytest.raises(
        UserError, match="one of image_maker.half_window, found 'image_maker.window'; did you mean 'image_maker.half"
    ):
        RecipeMethod(dataclasses.replace(recipe, settings={"image_maker.window": 30}), PARTS)


def test_a_device_that_is_not_there_is_a_user_error(scene: Scene) -> None:
    with pytest.raises(
        UserError, match="--device: expected cpu, or a CUDA device of this machine, found 'cuda:99'; use"
    ):
        METHODS["tfp+static"].fit(scene.training, FitRequest(TINY, "cuda:99"))


def test_a_fit_resumes_from_its_own_checkpoint_only(scene: Scene, tmp_path: Path) -> None:
    method, path = METHODS["tfp+static"], tmp_path / "fit.safetensors"
    camera = scene.cameras["cam_03"]

    def fit(training: TrainingScene = scene.training, budget: Budget = TINY, seed: int = 0) -> np.ndarray:
        return method.fit(training, FitRequest(budget, seed=seed, checkpoint=path)).render(camera, 2000.0)

    first = fit()
    np.testing.assert_array_equal(fit(), first)
    foreign: list[dict[str, Any]] = [{"seed": 1}, {"budget": Budget(0.02)}]
    foreign += [{"training": dataclasses.replace(scene.training, revision="0" * 64)}]
    for other in foreign:
        with pytest.raises(UserError, match="fit.safetensors: expected a checkpoint of this scene, recipe"):
            fit(**other)


def test_recipes_that_are_compared_differ_in_one_part() -> None:
    recipes = {r.name: r.as_dict() for r in ALL}

    def differ(a: str, b: str) -> set[str]:
        return {k for k in recipes[a] if recipes[a][k] != recipes[b][k]} - {"name"}

    for motion in ("d3dgs", "stg", "4dgs"):
        assert differ(f"tfi+{motion}", f"tfp+{motion}") == {"images"}
        # Spk2ImgNet's images take time, so a quick fit has fewer of them, and 4DGS fewer steps.
        assert differ(f"tfi+{motion}", f"spk2img+{motion}") == {"images"} | (
            {"settings"} if motion != "d3dgs" else set()
        )
    for images in ("tfi", "tfp"):
        assert differ(f"{images}+d3dgs", f"{images}+4dgs") == {"motion"} == differ(f"{images}+stg", f"{images}+4dgs")
    for name in ("dy-spikegs", *(r.name for r in SUPERVISED)):
        assert differ("tfp+4dgs", name) == {"supervision"}
    for start in ("colmap", "dust3r"):
        assert differ(f"tfi+{start}+4dgs", f"tfi+{start}+4dgs+spss") == {"supervision"}
        assert differ("tfi+4dgs", f"tfi+{start}+4dgs") == {"initialization"}
    for name in published(1, "estimated").rows:
        assert differ(name.replace("+colmap", "").replace("-uncalibrated", ""), name) == {"initialization"}
    assert differ("tfp+4dgs", "tfp+dust3r+4dgs") == {"initialization"}
    assert differ("tfp+4dgs", "tfp+static") == {"motion", "settings"}
    static, moving = (METHODS[name].settings["trainer"] for name in ("tfp+static", "tfp+4dgs"))
    assert static.coarse_steps == moving.coarse_steps + moving.fine_steps, "the floor has as many steps"


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("nearest-view", ("poses",)),
        ("tfp+4dgs", ("poses",)),
        ("dy-spikenerf", ("poses",)),
        ("tfp+4dgs+spss", ("poses", "flat-field")),  # its loss has the cameras' response
        ("spike4dgs", ("poses", "flat-field")),
        ("spike4dgs-x", ("poses", "flat-field")),
        ("tfp+colmap+4dgs", ()),
        ("spike4dgs-x+colmap", ("flat-field",)),
        ("spike4dgs-uncalibrated", ("flat-field",)),
    ],
)
def test_methods_say_what_they_are_given(name: str, given: tuple[str, ...]) -> None:
    assert METHODS[name].given == given  # type: ignore[attr-defined]
