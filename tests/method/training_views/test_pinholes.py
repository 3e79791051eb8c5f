"""Pinholes in the place of distorted cameras: maps, images, spikes, renders, and a fit."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_fits import PARTS, request
from toy_world import ToyWorld

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.method import Model, Recipe
from spike4dgs.benchmark.scene.camera_state import CameraState
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.images.adaptive import ADAPTIVE
from spike4dgs.method.images.training import ImageSettings, make_training_images
from spike4dgs.method.models.fitted_model import FittedModel
from spike4dgs.method.training_views import pinholes

BARREL, CUSHION = (-0.5, 0.1, 0.002, -0.003, 0.0), (0.3, 0.0, 0.0, 0.0, 0.0)
CURVED = ToyWorld(n_ticks=120, travel=0.0, lens=BARREL)


def wave(camera: Camera) -> np.ndarray:
    """A smooth image [H, W] of what lies in each direction."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    x, y = camera.normalized(np.stack([u, v], -1)).transpose(2, 0, 1)
    return (0.5 + 0.2 * np.sin(25 * x) * np.cos(20 * y + 5 * x)).astype(np.float32)


class Waves:
    @pinholes.through_lens
    def render(self, camera: Camera, t_us: float) -> np.ndarray:
        assert not camera.distortion
        return wave(camera)


def scene_of(*cameras: Camera) -> TrainingScene:
    stream = CURVED.stream(CURVED.cameras[0], 0)
    return TrainingScene("test", "test", cameras, (stream,) * len(cameras), 20000.0, 120, 0.6)


@pytest.mark.parametrize("lens", [BARREL, CUSHION, (-0.2, 0.0, 0.0, 0.0, 0.0)])
def test_a_pinhole_sees_all_that_its_camera_sees(lens: tuple[float, ...]) -> None:
    cameras = [replace(c, distortion=lens, cx=c.cx + k) for k, c in enumerate(CURVED.cameras[:3])]
    found = pinholes.make_lenses(cameras)
    assert len({(x.pinhole.width, x.pinhole.height) for x in found}) == 1
    for camera, x in zip(cameras, found, strict=True):
        uv = x.to_pinhole.reshape(-1, 2)
        assert (uv > 1).all() and (uv < np.array([x.pinhole.width, x.pinhole.height]) - 1).all()
        points = x.pinhole.unproject(uv, np.full(len(uv), 2.0))
        v, u = np.mgrid[: camera.height, : camera.width] + 0.5
        np.testing.assert_allclose(camera.project(points)[0], np.stack([u, v], -1).reshape(-1, 2), atol=1e-8)
        there = x.to_camera[x.seen]
        back = camera.unproject(there, np.full(len(there), 2.0))
        v, u = np.nonzero(x.seen)
        np.testing.assert_allclose(x.pinhole.project(back)[0], np.stack([u, v], -1) + 0.5, atol=1e-7)


@pytest.mark.parametrize("lens", [BARREL, CUSHION])
def test_images_go_to_the_pinhole_and_back(lens: tuple[float, ...]) -> None:
    cameras = [replace(c, distortion=lens) for c in CURVED.cameras[:2]]
    scene = pinholes.as_pinholes(scene_of(*cameras))
    images = np.stack([wave(c) for c in cameras])
    straight = pinholes.undistorted(scene, images[None])[0]
    expected, seen = np.stack([wave(c) for c in scene.cameras]), pinholes.seen_pixels(scene)
    assert seen is not None
    assert np.sqrt(np.mean((straight - expected)[np.stack(seen)] ** 2)) < 3e-3
    assert np.isfinite(straight).all()
    back = Waves().render(cameras[0], 0.0)
    assert back.shape == images[0].shape and np.abs(back - images[0]).max() < 5e-3
    assert np.sqrt(np.mean((back - images[0]) ** 2)) < 5e-4


def test_spikes_and_masks_keep_their_values() -> None:
    scene = pinholes.as_pinholes(scene_of(*[replace(c, distortion=BARREL) for c in CURVED.cameras[:2]]))
    spikes = [s.window(0, 3) for s in scene.streams]
    for found, lens, given in zip(
        pinholes.nearest_pixels(scene, spikes), pinholes.lenses_of(scene), spikes, strict=True
    ):
        assert found.dtype == np.uint8 and found.shape == (3, lens.pinhole.height, lens.pinhole.width)
        v, u = np.argwhere(lens.seen)[50]
        x, y = lens.to_camera[v, u].astype(int)
        np.testing.assert_array_equal(found[:, v, u], given[:, y, x])


def test_a_scene_of_pinholes_stays_as_it_is() -> None:
    scene = ToyWorld(n_ticks=16).training
    assert pinholes.as_pinholes(scene) is scene and pinholes.seen_pixels(scene) is None
    images = np.zeros((2, 8, 40, 64), np.float32)
    assert pinholes.undistorted(scene, images) is images
    assert pinholes.with_lenses(scene, scene.cameras) == scene.cameras


def test_fitted_pinholes_become_cameras_with_their_lens() -> None:
    cameras = [replace(c, distortion=BARREL) for c in CURVED.cameras[:2]]
    scene = pinholes.as_pinholes(scene_of(*cameras))
    moved = [replace(c, t=c.t + 0.1, fx=c.fx * 1.01) for c in scene.cameras]
    for found, given in zip(pinholes.with_lenses(scene, moved), cameras, strict=True):
        np.testing.assert_allclose(found.t, given.t + 0.1)
        np.testing.assert_allclose([found.fx, found.cx, found.cy], [given.fx * 1.01, given.cx, given.cy])
        assert found.distortion == BARREL and (found.width, found.height) == (given.width, given.height)


def test_a_lens_that_folds_within_the_image_is_refused() -> None:
    with pytest.raises(UserError, match="a lens of cam_00 whose model holds up to the image's corners"):
        pinholes.make_lenses([replace(CURVED.cameras[0], distortion=(-5.0, 0.0, 0.0, 0.0, 0.0))])


def test_training_images_are_at_the_pixels_of_the_streams() -> None:
    """What a loss compares was never resampled: a lens changes the views alone."""
    bad = np.zeros((CURVED.height, CURVED.width), bool)
    bad[3, 5] = True
    curved = replace(CURVED.training, states={c.id: CameraState(bad=bad) for c in CURVED.cameras})
    ignored = replace(curved, cameras=tuple(replace(c, distortion=()) for c in curved.cameras))
    settings = ImageSettings(time_spacing_ticks=40)
    seen, same = (make_training_images(s, s.cameras, ADAPTIVE, settings, "cpu") for s in (curved, ignored))
    assert torch.equal(seen.images, same.images) and torch.equal(seen.bad, same.bad)
    assert seen.views.lenses is not None and same.views.lenses is None


@pytest.mark.parametrize("supervision", ["pixel", "spike"])
def test_a_fit_through_a_lens_gives_straight_images_and_bent_ones(supervision: str) -> None:
    settings = {"trainer.coarse_steps": 80, "trainer.views_per_step": 4}
    method = RecipeMethod(Recipe("test", "short", "true", "static", supervision, settings), PARTS)
    curved = CURVED.training
    straight = replace(CURVED.held_out, distortion=())

    def psnr(model: Model, camera: Camera) -> float:
        difference = model.render(camera, curved.duration_us / 2) - CURVED.trace(camera, 0.5)[0]
        return float(-10 * np.log10(np.mean(difference**2)))

    known = method.fit(curved, request())
    assert psnr(known, CURVED.held_out) > 24
    assert psnr(known, straight) > 24
    if supervision == "pixel":
        without = tuple(replace(c, distortion=()) for c in curved.cameras)
        assert psnr(method.fit(replace(curved, cameras=without), request()), straight) < 18, "the lens matters"
    assert isinstance(known, FittedModel)
    assert [c.distortion for c in known.cameras] == [BARREL] * len(curved.cameras)
