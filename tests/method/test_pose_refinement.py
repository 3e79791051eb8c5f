"""Poses that are fitted together with the scene: the exponential, a toy world from wrong poses, and resuming."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.linalg import expm
from toy_world import ToyWorld

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.method import FitRequest, Recipe
from spike4dgs.benchmark.metrics.pose_error import angle_deg, pose_errors
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.fit import Parts, RecipeMethod
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.models.fitted_model import FittedModel
from spike4dgs.method.motion.table import MOTIONS
from spike4dgs.method.pose_refinement import Poses, rigid_motion
from spike4dgs.method.splat import Views
from spike4dgs.method.starts.base import Initialization, Start
from spike4dgs.method.supervision.table import SUPERVISIONS

WORLD = ToyWorld(width=64, height=40, n_ticks=40, travel=0.0)
SCENE = WORLD.training


@pytest.mark.parametrize("size", [0.0, 1e-9, 0.1, 2.0])
def test_exponential_is_a_rigid_motion(size: float) -> None:
    xi = size * np.random.default_rng(1).normal(size=6)
    (x, y, z), v = xi[:3], xi[3:]
    twist = np.array([[0, -z, y, v[0]], [z, 0, -x, v[1]], [-y, x, 0, v[2]], [0, 0, 0, 0]])
    motion = rigid_motion(torch.tensor(xi)).numpy()
    assert np.allclose(motion, expm(twist), atol=1e-12)
    assert np.allclose(motion[:3, :3] @ motion[:3, :3].T, np.eye(3), atol=1e-12)
    assert abs(float(angle_deg(motion[:3, :3])) - np.degrees(np.linalg.norm(xi[:3])) % 360) < 1e-6 or size == 2.0
    assert torch.autograd.gradcheck(rigid_motion, torch.tensor(xi, requires_grad=True))


def test_poses_start_where_the_views_are_and_the_first_stays() -> None:
    views = Views.from_cameras(SCENE.cameras)
    poses = Poses(views, 3.0)
    assert torch.equal(poses.views([4, 1]).w2c, views.w2c[[4, 1]])
    torch.nn.init.normal_(poses.xi, std=0.1)
    found = poses.views(range(8)).w2c
    assert torch.equal(found[0], views.w2c[0])
    step = torch.cat([poses.xi[2, :3], 3 * poses.xi[2, 3:]])
    assert torch.allclose(found[3], rigid_motion(step) @ views.w2c[3])
    np.testing.assert_allclose(poses.cameras(SCENE.cameras)[3].w2c, found[3].detach().numpy())


class Truth(ImageMaker):
    """A stand-in for the images part: what the camera sees without noise."""

    def __call__(self, stream: object, ticks: list[int], *_: object) -> np.ndarray:
        index = next(i for i, s in enumerate(SCENE.streams) if s is stream)
        return np.stack([WORLD.trace(SCENE.cameras[index], 0.5)[0]] * len(ticks)).astype(np.float32)


truth = Truth(name="truth")


def off(camera: Camera, seed: int) -> Camera:
    """A camera that is off by 2 cm and 0.6 degrees."""
    rng = np.random.default_rng(seed)
    turn, shift = (size * x / np.linalg.norm(x) for size, x in zip((0.01, 0.02), rng.normal(size=(2, 3)), strict=True))
    R = rigid_motion(torch.tensor(np.concatenate([turn, np.zeros(3)]))).numpy()[:3, :3] @ camera.R
    return replace(camera, R=R, t=-R @ (camera.center + shift))


def wrong(scene: TrainingScene, seed: int) -> Start:
    """A stand-in for the initialisation: points on the surfaces, all cameras but the first a little off."""
    cameras = (scene.cameras[0], *(off(c, i) for i, c in enumerate(scene.cameras[1:])))
    return Start(cameras, *WORLD.surfaces(scene.cameras[::2], 0.01, seed))


WRONG = Initialization(lambda request: wrong(request.scene, request.seed))
PARTS = Parts({"truth": truth}, {"wrong": WRONG}, MOTIONS, SUPERVISIONS)


def method(**settings: object) -> RecipeMethod:
    steps = {"coarse_steps": 400, "views_per_step": 4, "refine_poses": True}
    of_trainer = {f"trainer.{name}": value for name, value in {**steps, **settings}.items()}
    return RecipeMethod(Recipe("test", "truth", "wrong", "static", "pixel", of_trainer), PARTS)


def errors(cameras: tuple[Camera, ...]) -> tuple[float, float]:
    """Means over the cameras after the similarity that fits them best: degrees, and metres."""
    found = pose_errors(cameras, SCENE.cameras).summary()
    return found["rotation_deg"], found["translation_m"]


@pytest.mark.slow
def test_wrong_poses_become_better_and_the_image_sharp() -> None:
    before = errors(wrong(SCENE, 0).cameras)
    refined, kept = (method(refine_poses=r).fit(SCENE, FitRequest()) for r in (True, False))
    assert isinstance(refined, FittedModel) and isinstance(kept, FittedModel)
    assert errors(kept.cameras) == before
    after = errors(refined.cameras)
    assert after[0] < 0.4 * before[0] and after[1] < 0.7 * before[1]
    assert WORLD.psnr(refined, moving=False) > WORLD.psnr(kept, moving=False) + 4


def test_a_resumed_fit_has_the_same_poses(tmp_path: Path) -> None:
    class Killed(Exception):
        pass

    def kill(done: int, total: int, note: str = "") -> None:
        if note.startswith("loss") and done >= 20:
            raise Killed

    short = method(coarse_steps=30)
    whole = short.fit(SCENE, FitRequest())
    with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
        patch.setattr("spike4dgs.method.trainer.Trainer.run.__defaults__", (None, "", 0.0))
        short.fit(SCENE, FitRequest(progress=kill, checkpoint=tmp_path / "c.safetensors"))
    again = short.fit(SCENE, FitRequest(checkpoint=tmp_path / "c.safetensors"))
    for a, b, start in zip(whole.cameras, again.cameras, wrong(SCENE, 0).cameras, strict=True):
        np.testing.assert_array_equal(a.w2c, b.w2c)
        assert a.id == "cam_00" or not np.array_equal(a.w2c, start.w2c)


class Spanned(ImageMaker):
    """A stand-in for the images part whose values are means over ten ticks."""

    def __call__(self, *args: object) -> np.ndarray:
        raise AssertionError("asked for images without their spans")

    def with_spans(self, stream: object, ticks: list[int], *_: object) -> tuple[np.ndarray, np.ndarray]:
        images = truth(stream, ticks, 1.0)
        ends = np.array([-5, 5], np.float32)[None, :, None, None]
        return images, np.broadcast_to(ends, (len(ticks), 2, *images.shape[1:]))


@pytest.mark.parametrize(("images", "freeze"), [("truth", True), ("spanned", False)])
def test_backgrounds_and_means_over_time_have_fixed_poses(images: str, freeze: bool) -> None:
    recipe = method(freeze_background=freeze).recipe
    parts = replace(PARTS, images={"truth": truth, "spanned": Spanned(name="spanned")})
    with pytest.raises(UserError, match="either trainer.refine_poses, or .* found both"):
        RecipeMethod(replace(recipe, images=images), parts).fit(SCENE, FitRequest())
