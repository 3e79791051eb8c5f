"""Poses that are fitted together with the scene: the exponential, a toy world from wrong poses, and resuming."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from dummy_methods import CountMethod, CountModel, FailingMethod, run
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from small_scenes import GAIN, TICKS
from splat_scenes import FOCAL, HEIGHT, WIDTH, random_splats
from torch import Tensor
from toy_world import ToyWorld

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.baselines.tracking.fit import TRACKING
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.method import FitRequest, Recipe
from spike4dgs.benchmark.metrics.pose_error import angle_deg, pose_errors
from spike4dgs.benchmark.runs.record import read_record
from spike4dgs.benchmark.runs.refinement import free_ticks
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import read_exr
from spike4dgs.benchmark.scene.scene import TrainingScene, open_scene
from spike4dgs.benchmark.weights import WeightsError
from spike4dgs.method.fit import Parts, RecipeMethod
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.models.fitted_model import FittedModel, GaussianModel
from spike4dgs.method.motion.table import MOTIONS
from spike4dgs.method.pose_refinement import Poses, Refinement, refine_pose, rigid_motion
from spike4dgs.method.splat import Splats, Views, render
from spike4dgs.method.starts.base import Initialization, Start, StartRequest
from spike4dgs.method.starts.rig import rig
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


def displaced(camera: Camera, seed: int) -> Camera:
    """A camera that is off by 2 cm and 0.6 degrees."""
    rng = np.random.default_rng(seed)
    turn, shift = (size * x / np.linalg.norm(x) for size, x in zip((0.01, 0.02), rng.normal(size=(2, 3)), strict=True))
    R = rigid_motion(torch.tensor(np.concatenate([turn, np.zeros(3)]))).numpy()[:3, :3] @ camera.R
    return replace(camera, R=R, t=-R @ (camera.center + shift))


def wrong(scene: TrainingScene, seed: int) -> Start:
    """A stand-in for the initialisation: points on the surfaces, all cameras but the first a little off."""
    cameras = (scene.cameras[0], *(displaced(c, i) for i, c in enumerate(scene.cameras[1:])))
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


def test_wrong_poses_become_better_and_the_image_sharp() -> None:
    before = errors(wrong(SCENE, 0).cameras)
    refined = method().fit(SCENE, FitRequest())
    kept = method(refine_poses=False, coarse_steps=120).fit(SCENE, FitRequest())  # 24.0 dB, as after 400 steps
    assert isinstance(refined, FittedModel) and isinstance(kept, FittedModel)
    assert errors(kept.cameras) == before
    after = errors(refined.cameras)
    assert after[0] < 0.4 * before[0] and after[1] < 0.7 * before[1]
    assert WORLD.psnr(refined, moving=False) > WORLD.psnr(kept, moving=False) + 4


class Spanned(ImageMaker):
    """A stand-in for the images part whose values are means over ten ticks."""

    def __call__(self, *args: object) -> np.ndarray:
        raise AssertionError("asked for images without their spans")

    def with_spans(self, stream: object, ticks: list[int], *_: object) -> tuple[np.ndarray, np.ndarray, None]:
        images = truth(stream, ticks, 1.0)
        ends = np.array([-5, 5], np.float32)[None, :, None, None]
        return images, np.broadcast_to(ends, (len(ticks), 2, *images.shape[1:])), None


@pytest.mark.parametrize(("images", "freeze"), [("truth", True), ("spanned", False)])
def test_backgrounds_and_means_over_time_have_fixed_poses(images: str, freeze: bool) -> None:
    recipe = method(freeze_background=freeze).recipe
    parts = replace(PARTS, images={"truth": truth, "spanned": Spanned(name="spanned")})
    with pytest.raises(UserError, match="either trainer.refine_poses, or .* found both"):
        RecipeMethod(replace(recipe, images=images), parts).fit(SCENE, FitRequest())


DEPTH_M = 3.5


def frozen() -> Splats:
    s = random_splats(700, seed=3)
    return Splats(*(t.float() for t in (s.means, s.quats, s.scales, s.opacities * 0.9, s.colors)))


def render_view(views: Views) -> Tensor:
    return render(SPLATS, views).image[..., 0]


SPLATS = frozen()
TRUE = Camera("c", WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, np.eye(3), np.zeros(3))


def moved(camera: Camera, degrees: float, metres: float) -> Camera:
    xi = torch.tensor([0.6, -0.7, 0.4, 0.5, 0.6, -0.6], dtype=torch.float64)
    units = torch.tensor([math.radians(degrees)] * 3 + [metres] * 3, dtype=torch.float64)
    w2c = rigid_motion(xi * units).numpy() @ camera.w2c
    return replace(camera, R=w2c[:3, :3], t=w2c[:3, 3])


def off(a: Camera, b: Camera) -> float:
    """Mean distance in px between the images of the Gaussians' centres."""
    points = SPLATS.means.double().numpy()
    return float(np.linalg.norm(a.project(points)[0] - b.project(points)[0], axis=1).mean())


@pytest.mark.parametrize(("gain", "offset", "lens"), [(1.06, -0.02, ()), (0.9, 0.05, (-0.2, 0.03, 0.0, 0.0, 0.0))])
def test_refinement_finds_the_pose_from_background_pixels_of_any_sensor(
    gain: float, offset: float, lens: tuple[float, ...]
) -> None:
    true = replace(TRUE, distortion=lens)
    image = gain * render_view(Views.from_cameras([true]))[0].numpy() + np.float32(offset)
    noisy = image + 0.02 * np.random.default_rng(0).standard_normal(image.shape).astype(np.float32)
    background = np.ones(image.shape, bool)
    background[20:50, 30:65] = False
    noisy[~background] = 5.0  # what moves is somewhere else by now
    wrong = moved(true, 1.0, -0.03)
    found = refine_pose(render_view, wrong, noisy, background, DEPTH_M, Refinement())
    assert off(replace(wrong, distortion=()), TRUE) > 0.8 and off(replace(found, distortion=()), TRUE) < 0.1
    assert np.allclose(found.R @ found.R.T, np.eye(3), atol=1e-9)
    assert (found.id, found.fx, found.width, found.distortion) == (TRUE.id, TRUE.fx, TRUE.width, lens)


def test_refinement_never_ends_worse_than_it_began() -> None:
    image, everywhere = render_view(Views.from_cameras([TRUE]))[0].numpy(), np.ones((HEIGHT, WIDTH), bool)
    kept = refine_pose(render_view, TRUE, image, everywhere, DEPTH_M, Refinement(steps=5, lr=0.3, lr_last=0.3))
    assert np.array_equal(kept.w2c, TRUE.w2c)


def test_refinement_without_background_pixels_is_refused() -> None:
    dark, nowhere = np.zeros((HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH), bool)
    with pytest.raises(UserError, match="0 background pixels"):
        refine_pose(render_view, TRUE, dark, nowhere, 1, Refinement())


@given(st.sets(st.integers(0, 59), max_size=30), st.integers(60, 400))
def test_the_image_comes_from_the_longest_time_without_targets(ticks: set[int], n_ticks: int) -> None:
    start, stop = free_ticks(sorted(ticks), n_ticks, 200)
    assert 0 <= start < stop <= n_ticks and not ticks & set(range(start, stop))
    runs = "".join("x" if t in ticks else "." for t in range(n_ticks)).split("x")
    assert stop - start == min(200, max(map(len, runs)))


def test_a_clip_of_targets_alone_is_refused() -> None:
    with pytest.raises(UserError, match="ticks that are not scored"):
        free_ticks(range(10), 10, 200)


class SeenFrom(CountModel):
    """Renders the camera's position as a gray value; refinement moves it, and keeps its arguments."""

    def __init__(self, seen: list[Any]) -> None:
        self.seen = seen

    def render(self, camera: Camera, t_us: float) -> np.ndarray:
        return np.full((camera.height, camera.width), camera.t[0], np.float32)

    def refine(self, camera: Camera, image: np.ndarray, background: np.ndarray, t_us: float) -> Camera:
        self.seen.append((camera, image, background, t_us))
        return replace(camera, t=camera.t + [0.5, 0, 0])


class Posed(CountMethod):
    refines_views = True

    def __init__(self) -> None:
        super().__init__("posed")
        self.seen: list[Any] = []

    def fit(self, *args: Any, **kwargs: Any) -> SeenFrom:
        super().fit(*args, **kwargs)
        return SeenFrom(self.seen)


def test_a_run_publishes_unrefined_and_refined_scores(small_scene: Path, tmp_path: Path) -> None:
    method, scene = Posed(), open_scene(small_scene)
    plain, refined, other = run(tmp_path, [small_scene], method, CountMethod())
    assert [r["method"]["name"] for r in (plain, refined, other)] == ["posed", "posed.refined", "counts"]
    camera = scene.cameras["cam_03"]
    for name, value in (("posed", camera.t[0]), ("posed.refined", camera.t[0] + 0.5)):
        image = read_exr(tmp_path / f"predictions/{name}/pattern-0/cam_03/000040.exr")
        assert np.allclose(image, value, atol=1e-3)
    assert plain["mean"]["psnr"] != refined["mean"]["psnr"]
    assert read_record(tmp_path / "results/posed.refined.json") == refined
    assert method.fits == 1 and len(method.seen) == 1
    again = Posed()
    assert run(tmp_path, [small_scene], again)[1]["scenes"] == refined["scenes"] and again.fits == 0


def test_the_image_for_refinement_is_unscored_and_of_the_background(small_scene: Path, tmp_path: Path) -> None:
    method, scene = Posed(), open_scene(small_scene)
    run(tmp_path, [small_scene], method)
    camera, image, background, t_us = method.seen[0]
    assert camera.id == "cam_03" and TICKS == 80  # targets at 20, 40 and 60
    counts = scene.stream("cam_03").counts(0, 20) / (20 * GAIN)  # the longest time between them, by one tick
    assert np.allclose(image, counts, atol=1e-6) and image.dtype == np.float32
    assert t_us == pytest.approx(50 * 10)
    assert np.array_equal(background, ~scene.moving(scene.targets[0]))


def test_a_failure_fails_both_records_and_absent_weights_skip_them(small_scene: Path, tmp_path: Path) -> None:
    for error, status in ((ValueError("no luck"), "failed"), (WeightsError("no file", "no file"), "skipped")):
        bad = FailingMethod("bad", error)
        bad.refines_views = True
        records = run(tmp_path / status, [small_scene], bad)
        assert [r["method"]["name"] for r in records] == ["bad", "bad.refined"]
        assert [r["scenes"]["pattern-0"]["status"] for r in records] == [status] * 2


STILL = ToyWorld(width=80, height=50, n_ticks=120, travel=0.0, seed=1)


@pytest.mark.parametrize("motion", ["static", "tracking"])
def test_a_recipe_on_shifted_poses_scores_better_refined(motion: str) -> None:
    """All training poses are shifted by the same: at the calibrated held-out pose the image is off, refined not."""
    shift = np.array([0.02, 0.0, 0.0])

    def shifted(request: StartRequest) -> Start:
        cameras = tuple(replace(c, t=c.t - c.R @ shift) for c in request.scene.cameras)
        return rig(replace(request.scene, cameras=cameras))

    starts = {"shifted": Initialization(shifted, estimates_poses=True)}
    parts = Parts(IMAGES, starts, MOTIONS, SUPERVISIONS, {"tracking": TRACKING})
    steps = {"trainer.coarse_steps": 60} if motion == "static" else {"motion.first_steps": 60, "motion.later_steps": 2}
    recipe = Recipe("posed", "tfp", "shifted", motion, "pixel", steps)
    method = RecipeMethod(recipe, parts)
    assert method.refines_views and method.params["refinement"]["steps"] == 100

    world, model = STILL, method.fit(STILL.training, FitRequest())
    truth = world.trace(world.held_out, 0.5)[0].astype(np.float32)
    assert isinstance(model, GaussianModel)
    found = model.refine(world.held_out, truth, np.ones_like(truth, bool), 3000.0)
    assert np.linalg.norm(found.center - world.held_out.center - shift) < 0.5 * np.linalg.norm(shift)
    before, after = (np.abs(model.render(c, 3000.0) - truth).mean() for c in (world.held_out, found))
    assert after < 0.8 * before
