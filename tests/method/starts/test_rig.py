from dataclasses import asdict, replace

import cv2
import numpy as np
import pytest
from small_scenes import array_cameras
from toy_world import GAIN, RATE_HZ, ToyWorld

from spike4dgs.baselines.recipes import PARTS
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.method import Recipe
from spike4dgs.benchmark.scene.camera_state import CameraState
from spike4dgs.benchmark.scene.cameras import Camera, look_at
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.starts.base import StartRequest
from spike4dgs.method.starts.clip import window_means
from spike4dgs.method.starts.plane_sweep import (
    UNSEEN,
    agreed,
    find_range,
    full_range,
    lift,
    plane_homographies,
    sweep,
)
from spike4dgs.method.starts.rig import RigSettings, middle_camera, rig
from spike4dgs.method.starts.structure_from_motion import clip_means

WORLD = ToyWorld(width=96, height=60, n_ticks=160, travel=0.25, seed=1, views=(0, 2, 3, 5, 7))


def static_views(world: ToyWorld) -> tuple[np.ndarray, np.ndarray]:
    """Noise-free images and depths of all cameras at the middle of the clip."""
    seen = [world.trace(c, 0.5) for c in world.cameras]
    return np.stack([s[0] for s in seen]).astype(np.float32), np.stack([s[1] for s in seen])


@pytest.mark.parametrize("center", [(0.0, 0.0, 0.0), (0.3, 0.2, 0.1)])
def test_cameras_at_one_place_have_no_depth(center: tuple[float, float, float]) -> None:
    """Their centres differ by rounding where they are not the origin: a camera stores its translation."""
    scene = WORLD.training
    cameras = tuple(replace(c, t=-c.R @ np.array(center)) for c in scene.cameras)
    assert len({tuple(c.center) for c in cameras}) > 1 or not any(center)
    with pytest.raises(UserError, match="training cameras apart from each other"):
        rig(replace(scene, cameras=cameras))


def test_homography_maps_pixels_as_projecting_through_the_plane_does():
    a, b = WORLD.cameras[0], WORLD.cameras[5]
    uv = np.random.default_rng(0).uniform(0, 60, (20, 2))
    for inverse in (0.1, 0.4):
        points = a.unproject(uv, np.full(20, 1 / inverse))
        mapped = np.column_stack([uv, np.ones(20)]) @ next(plane_homographies(a, b, [inverse])).T
        assert np.allclose(mapped[:, :2] / mapped[:, 2:], b.project(points)[0], atol=1e-9)


def test_lifted_pixels_project_back_to_their_centres():
    camera, mask = WORLD.cameras[1], np.zeros((60, 96), bool)
    mask[7, 30], mask[50, 2] = True, True
    uv, z = camera.project(lift(camera, np.full((60, 96), 0.25, np.float32), mask))
    assert np.allclose(uv, [[30.5, 7.5], [2.5, 50.5]]) and np.allclose(z, 4)


def test_sweep_finds_the_depth_of_textured_surfaces():
    images, depths = static_views(WORLD)
    found = sweep(WORLD.cameras, images, 4, full_range(WORLD.cameras))
    error = np.abs(found.inverse * depths[4] - 1)[5:-5, 5:-5]
    assert np.median(error) < 0.02 and np.mean(error < 0.1) > 0.85


def field_of(reference: Camera, camera: Camera, inverse: float) -> np.ndarray:
    """Return the pixels [H, W] that see through a frame at an inverse depth, 10 px inside the reference's image."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    points = camera.unproject(np.stack([u.ravel(), v.ravel()], axis=-1), np.full(u.size, 1 / inverse))
    uv, _ = reference.project(points)
    inside = (uv >= 10) & (uv < [camera.width - 10, camera.height - 10])
    return inside.all(axis=1).reshape(u.shape)


@pytest.mark.parametrize("inverse", [0.3, 0.45])
def test_edges_of_the_fields_of_view_are_no_texture(inverse: float) -> None:
    """They coincide at one depth, as those of lenses do, and all views agree on it: where nothing is."""
    images, depths = static_views(WORLD)
    fields = np.stack([field_of(WORLD.cameras[4], c, inverse) for c in WORLD.cameras])
    marked = np.where(fields, images, np.float32(UNSEEN))
    planes = find_range(WORLD.cameras, marked)
    maps = [sweep(WORLD.cameras, marked, i, planes) for i in range(9)]
    edge = fields[4].copy()
    edge[14:-14, 14:-14] = False
    kept = agreed(WORLD.cameras, maps, 4) & edge
    wrong = np.abs(maps[4].inverse * depths[4] - 1) > 0.1
    assert kept[edge].mean() > 0.8 and wrong[kept].mean() < 0.05, "half of them were at the depth of the frame"


def test_sweep_of_a_part_equals_the_whole_sweep_inside_it():
    images, _ = static_views(WORLD)
    planes, mask = full_range(WORLD.cameras), np.zeros((60, 96), bool)
    mask[20:40, 30:50] = True
    part, whole = (sweep(WORLD.cameras, images, 0, planes, m) for m in (mask, None))
    inside = part.score > -1
    assert inside[mask].all() and inside.sum() == 30 * 30
    assert np.allclose(part.inverse[mask], whole.inverse[mask], atol=1e-6)


def test_range_holds_the_scene_and_is_much_smaller_than_everything():
    images, depths = static_views(WORLD)
    planes = find_range(WORLD.cameras, images)
    low, high = np.quantile(1 / depths, [0.01, 0.99])
    assert planes[0] <= low and planes[-1] >= high and len(planes) < 0.7 * len(full_range(WORLD.cameras))


def test_views_agree_on_true_depths_and_not_on_chance():
    images, depths = static_views(WORLD)
    planes = full_range(WORLD.cameras)
    maps = [sweep(WORLD.cameras, images, i, planes) for i in range(9)]
    kept = agreed(WORLD.cameras, maps, 4)
    wrong = np.abs(maps[4].inverse * depths[4] - 1) > 0.1
    assert kept.mean() > 0.6 and wrong[kept].mean() < 0.5 * wrong.mean()
    noise = np.random.default_rng(0).random(images.shape).astype(np.float32)
    noise = np.stack([cv2.GaussianBlur(n, (0, 0), 1.0) for n in noise])
    chance = [sweep(WORLD.cameras, noise, i, planes) for i in range(9)]
    assert agreed(WORLD.cameras, chance, 4).mean() < 0.1


@pytest.fixture(scope="module")
def start():
    return rig(WORLD.training)


def test_rig_keeps_the_calibrated_poses_and_is_deterministic(start):
    again = rig(WORLD.training)
    assert start.cameras == WORLD.training.cameras
    assert np.array_equal(again.points, start.points) and np.array_equal(again.values, start.values)


def test_rig_covers_the_image(start):
    uv, _ = middle_camera(start.cameras).project(start.points.astype(np.float64))
    seen = np.histogram2d(uv[:, 0], uv[:, 1], bins=(24, 15), range=((0, 96), (0, 60)))[0]
    assert (seen > 0).mean() > 0.99
    assert 0.15 < len(start.points) / (96 * 60) < 0.8


def test_middle_camera_is_between_the_others_and_not_the_held_out_one():
    training = [camera for camera in WORLD.cameras if camera is not WORLD.held_out]
    m, centers = middle_camera(training), np.stack([c.center for c in training])
    mean = centers.mean(axis=0)
    nearest = np.linalg.norm(centers - mean, axis=1).min()
    assert np.linalg.norm(m.center - mean) == pytest.approx(nearest / 4) and np.allclose(m.R @ m.R.T, np.eye(3))
    assert np.allclose(m.R, WORLD.held_out.R, atol=0.01)
    places = [np.array([0.3 * (k % 3 - 1), 0.0, 0.2 * (1 - k // 3)]) for k in range(9)]  # 3x3, the middle held out
    up = np.array([0.0, 0.0, 1.0])
    array = [look_at(f"{k}", p, p + (0, 9.0, 0), up, focal=50.0, width=40, height=20) for k, p in enumerate(places)]
    assert np.linalg.norm(middle_camera([*array[:4], *array[5:]]).center - array[4].center) == pytest.approx(0.05)


@pytest.mark.parametrize("spikes", ["none", "all"])
def test_scene_without_any_texture_still_gives_points(spikes):
    packed = np.full((40, 30), 0 if spikes == "none" else 255, np.uint8)
    cameras = ToyWorld(width=20, height=12).training.cameras
    streams = tuple(SpikeStream(packed, 20, 12, RATE_HZ) for _ in cameras)
    start = rig(TrainingScene("flat", "flat", cameras, streams, RATE_HZ, 40, GAIN))
    assert len(start.points) > 20 and np.isfinite(start.points).all() and np.isfinite(start.values).all()


@pytest.mark.parametrize("means", [lambda s: window_means(s, 0, 200, flat_field=True), clip_means])
def test_cameras_of_known_gains_see_one_light(means):
    """Gains of 0.5 and 1.5 in light of 0.5: spikes in one and in three of eight ticks."""
    spikes = np.zeros((2, 200, 8, 16), bool)
    spikes[0, ::8] = spikes[1, ::8] = spikes[1, 2::8] = spikes[1, 4::8] = True
    streams = tuple(SpikeStream(pack(s), 16, 8, RATE_HZ) for s in spikes)
    cameras = array_cameras(2, 16, 8)
    states = {c.id: CameraState(gain=g) for c, g in zip(cameras, (0.5, 1.5), strict=True)}
    scene = TrainingScene("lit", "lit", cameras, streams, RATE_HZ, 200, 0.5, states=states)
    np.testing.assert_allclose(means(scene), 0.5, rtol=1e-6)


def test_a_recipe_overrides_the_cell_size_and_its_record_shows_it(start):
    overrides = {"initialization.cell_px": 4.0}
    method = RecipeMethod(Recipe("mine", "tfp", "rig", "static", "pixel", overrides), PARTS)
    wide = method.settings["initialization"]
    coarse = method.initialization.start(StartRequest(WORLD.training, 0, wide))
    assert len(coarse.points) < 0.7 * len(start.points)
    assert method.params["settings"]["initialization"] == {**asdict(RigSettings()), "cell_px": 4.0}


@pytest.mark.parametrize(
    ("initialization", "name"),
    [
        ("rig", "pair_error_px"),  # COLMAP's
        ("dust3r", "cell_px"),
        ("colmap", "focal_prior"),  # the focal length is known
        ("msdi", "flat_field"),  # always corrected
    ],
)
def test_a_number_of_a_part_that_does_not_run_is_refused(initialization: str, name: str):
    recipe = Recipe("mine", "tfp", initialization, "static", "pixel", {f"initialization.{name}": 1})
    with pytest.raises(UserError, match=f"recipe mine: expected .*found 'initialization.{name}'"):
        RecipeMethod(recipe, PARTS)


def test_no_initialization_has_more_than_25_numbers():
    assert max(len(asdict(part.settings)) for part in PARTS.initialization.values()) <= 25
