"""Co-visible pixels: against rays of a world in closed form, and as a scene is scored."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion
from small_scenes import HEIGHT, TICKS, WIDTH, write_small_scene

from spike4dgs.benchmark import Scene, Target, open_scene
from spike4dgs.benchmark.metrics.covisible import count_views, covisible
from spike4dgs.benchmark.metrics.measure import select_metrics
from spike4dgs.benchmark.runs.predictions import open_predictions, write_predictions
from spike4dgs.benchmark.runs.score import score_scene
from spike4dgs.benchmark.scene.cameras import Camera, look_at
from spike4dgs.benchmark.scene.images import read_geometry, write_geometry
from spike4dgs.benchmark.scene.manifest import write_manifest

BALL, RADIUS = np.array([0.1, 0.3, 0.5]), 0.5  # above the plane z = 0, before a sky
LENSES: list[tuple[float, ...]] = [(), (-0.2, 0.03, 0.0, 0.0, 0.0)]


def cameras(n: int, lens: tuple[float, ...], width: int = 120, height: int = 80) -> list[Camera]:
    seen: Any = {"target": np.array([0.3, 0.5, 0.6]), "up": np.array([0.0, 0.0, 1.0])}
    seen |= {"focal": 0.9 * width, "width": width, "height": height}
    centers = [np.array([0.5 * (i - (n - 1) / 2), -3.0, 1.2 + 0.2 * (i % 2)]) for i in range(n)]
    return [replace(look_at(f"cam_{i:02d}", center, **seen), distortion=lens) for i, center in enumerate(centers)]


def first_hit(origin: NDArray, to: NDArray) -> NDArray:
    """The distance, in lengths of the directions [N, 3], at which rays meet ball or plane; inf where neither."""
    a, b = np.sum(to * to, -1), 2 * to @ (origin - BALL)
    root = b * b - 4 * a * (np.sum((origin - BALL) ** 2) - RADIUS**2)
    with np.errstate(invalid="ignore", divide="ignore"):
        ball = (-b - np.sqrt(root)) / (2 * a)
        plane = -origin[2] / to[:, 2]
    return np.minimum(*(np.where(t > 1e-9, t, np.inf) for t in (np.nan_to_num(ball, nan=-1.0), plane)))


def rays(camera: Camera) -> NDArray:
    """Directions [N, 3] through the middles of the pixels, one metre deep."""
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    xy = camera.normalized(np.stack([u.ravel(), v.ravel()], -1))
    return np.column_stack([xy, np.ones(len(xy))]) @ camera.R


def depth_of(camera: Camera) -> NDArray:
    return first_hit(camera.center, rays(camera)).reshape(camera.height, camera.width)


def views_by_rays(camera: Camera, others: list[Camera]) -> NDArray:
    """How many other cameras see what each pixel shows: nothing lies between the point and the camera."""
    to, t = rays(camera), first_hit(camera.center, rays(camera))
    counts = np.zeros(len(t), int)
    for other in others:
        near = np.isfinite(t)
        points = camera.center + to * np.where(near, t, 1.0)[:, None]
        way = np.where(near[:, None], points - other.center, to)  # the sky: the same direction
        uv, z = other.project(other.center + way)
        with np.errstate(invalid="ignore"):
            inside = (z > 0) & (uv >= 0).all(1) & (uv <= (other.width, other.height)).all(1)
        free = np.where(near, first_hit(other.center, way) > 1 - 1e-6, np.isinf(first_hit(other.center, way)))
        counts += inside & free
    return counts.reshape(camera.height, camera.width)


@pytest.mark.parametrize("lens", LENSES)
def test_counted_views_are_those_of_rays(lens: tuple[float, ...]) -> None:
    everything = cameras(5, lens)
    camera, others = everything[1], [c for i, c in enumerate(everything) if i != 1]
    found = count_views(camera, depth_of(camera), {c: depth_of(c).astype(np.float32) for c in others})
    expected = views_by_rays(camera, others)
    assert set(np.unique(expected)) == {0, 1, 2, 3, 4}, "the world has pixels of every kind"
    assert (found != expected).mean() < 0.03
    for least in (1, 2):
        seen, true = found >= least, expected >= least
        around = np.ones((5, 5), bool)  # an edge of depth may be off by what a pixel and the four around it span
        assert not (seen & ~binary_dilation(true, around)).any()
        assert not (binary_erosion(true, around, border_value=1) & ~seen).any()


def write_depth(root: Path, ticks: tuple[int, ...] = (20,), hidden: NDArray | None = None) -> Scene:
    """Give a small scene the depth of a plane; at the first tick something that moves has the pixels `hidden`."""
    scene = open_scene(root)
    for name, camera in scene.cameras.items():
        v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        to = np.column_stack([camera.normalized(np.stack([u.ravel(), v.ravel()], -1)), np.ones(u.size)]) @ camera.R
        depth = (-camera.center[1] / to[:, 1]).reshape(HEIGHT, WIDTH).astype(np.float32)  # the plane y = 0
        for tick in ticks:
            shown = np.where(hidden, np.float32(1), depth) if hidden is not None and tick == ticks[0] else depth
            flow = np.zeros((HEIGHT, WIDTH, 2), np.float32)
            path, ids = root / f"geometry/{name}/{tick:06d}.exr", np.zeros(shown.shape, np.uint32)
            write_geometry(path, shown, ids, flow, 50.0 * tick)
    write_manifest(root)
    return open_scene(root)


def score(scene: Scene, folder: Path, wrong: NDArray) -> dict:
    """The cell of predictions that are off by 0.3 in some pixels, by 0.01 in the others."""
    images = {t: scene.ground_truth(t) + np.where(wrong, np.float32(-0.3), np.float32(0.01)) for t in scene.targets}
    write_predictions(folder, scene, images, "example")
    return score_scene(open_predictions(folder, scene.targets), scene, select_metrics(("psnr",)))


def test_pixels_that_fewer_than_two_cameras_see_do_not_count(small_scene: Path, tmp_path: Path) -> None:
    scene = write_depth(small_scene)
    seen = covisible(scene)["cam_03"]
    assert seen[:-1, 1:].all() and not seen[:, 0].any(), "cam_03 is the last in the row, and sees a column more"
    moving = scene.moving(scene.targets[0])
    cell = score(scene, tmp_path / "edge", ~seen & ~moving)
    assert cell["metrics"]["psnr_covisible"] == pytest.approx(40, abs=0.1)
    assert cell["metrics"]["psnr"] < 30 and "psnr_covisible" not in cell["notes"]
    assert score(scene, tmp_path / "moving", moving)["metrics"]["psnr_covisible"] < 20, "what moves always counts"


def test_what_moves_hides_the_resting_scene_for_a_time_only(small_scene: Path) -> None:
    alone = covisible(write_depth(small_scene))["cam_03"]
    hidden = np.zeros((HEIGHT, WIDTH), bool)
    hidden[4:20, 4:20] = True
    assert (covisible(write_depth(small_scene, (20,), hidden))["cam_03"] != alone).any(), "it stays"
    assert np.array_equal(covisible(write_depth(small_scene, (20, 60), hidden))["cam_03"], alone), "it passes"


def test_fewer_training_cameras_see_fewer_pixels(tmp_path: Path) -> None:
    write_depth(write_small_scene(tmp_path / "scene", splits=True))
    scene = open_scene(tmp_path / "scene")
    fewer = replace(scene, meta=scene.meta | {"splits": {scene.split: {"train": scene.train[:2], "test": scene.test}}})
    more, less = covisible(scene)["cam_03"], covisible(fewer)["cam_03"]
    assert less.sum() < more.sum() and not (less & ~more).any()


def test_a_scene_without_depth_or_with_damaged_files_has_no_value(small_scene: Path, tmp_path: Path) -> None:
    scene = open_scene(small_scene)
    nothing = np.zeros((HEIGHT, WIDTH), bool)
    cell = score(scene, tmp_path / "without", nothing)
    assert cell["metrics"]["psnr_covisible"] is None and cell["metrics"]["psnr"] is not None
    assert cell["notes"]["psnr_covisible"] == "the scene has no depth of its cameras"
    scene = write_depth(small_scene)
    path = next((small_scene / "geometry/cam_01").iterdir())
    path.write_bytes(path.read_bytes()[:-10])
    cell = score(scene, tmp_path / "damaged", nothing)
    assert cell["metrics"]["psnr_covisible"] is None and "psnr_covisible" not in cell["computed"], "nothing is claimed"
    assert "the scene's depth cannot be read" in cell["notes"]["psnr_covisible"]


def test_depth_of_another_size_or_instant_of_each_camera_is_not_used(small_scene: Path) -> None:
    assert covisible(write_depth(small_scene))
    path = small_scene / "geometry/cam_00/000020.exr"
    found = read_geometry(path)
    write_geometry(path, found.depth[:-1], found.ids[:-1], found.flow[:-1], 1000.0)
    write_manifest(small_scene)
    assert covisible(open_scene(small_scene)) is None
    write_geometry(path, found.depth, found.ids, found.flow, 1000.0)
    path.rename(path.with_name(f"{TICKS // 2:06d}.exr"))
    write_manifest(small_scene)
    assert covisible(open_scene(small_scene)) == {}
    assert Target("cam_03", 20) in open_scene(small_scene).targets
