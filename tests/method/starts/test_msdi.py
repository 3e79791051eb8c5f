"""The initialisations by MSDI: from what a perfect network would say of the toy world, and from random weights."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from toy_world import GAIN, ToyWorld, few_views

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark.files import sha256_file
from spike4dgs.benchmark.method import Budget
from spike4dgs.benchmark.runs.cell import Job
from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.scene.camera_state import CameraState
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.weights import WeightsError
from spike4dgs.method.fit import RecipeMethod
from spike4dgs.method.image_network.weights import VARIABLE as IMAGES_VARIABLE
from spike4dgs.method.matching.config import TINY as MATCHER_TINY
from spike4dgs.method.matching.network import Matcher
from spike4dgs.method.matching.weights import VARIABLE as MATCHER_VARIABLE
from spike4dgs.method.matching.weights import WEIGHTS as MATCHER
from spike4dgs.method.models.network_weights import ConfigCard
from spike4dgs.method.msdi.config import TINY
from spike4dgs.method.msdi.network import Msdi
from spike4dgs.method.msdi.training_data import points_of
from spike4dgs.method.msdi.weights import VARIABLE, WEIGHTS, Card, load_network
from spike4dgs.method.recipes import METHODS, PARTS
from spike4dgs.method.starts.base import Start
from spike4dgs.method.starts.clip import SpikeClip
from spike4dgs.method.starts.msdi import (
    Estimate,
    MsdiSettings,
    block_means,
    completed,
    infer,
    inverse_depth_line,
    msdi,
    shrunk,
)
from spike4dgs.method.starts.rig import Cloud, RigSettings, matched, rig

WORLD = ToyWorld(width=96, height=61, n_ticks=80, seed=1)
SCENE = WORLD.training
SCALE = 3.7  # metres to a unit of the perfect network
OFF = slice(10, 16)  # rows of which the perfect network says that it is not sure


@pytest.fixture(scope="module")
def perfect() -> Estimate:
    """The truth at half the size and another scale; some rows are far off, and known to be."""
    cameras = tuple(shrunk(c, 2) for c in SCENE.cameras)
    frames = [WORLD.trace(c, 0.5) for c in cameras]
    relative = np.stack([c.w2c @ np.linalg.inv(cameras[0].w2c) for c in cameras])
    depth = np.array([x[1] for x in frames], np.float32)
    points = points_of(depth, np.stack([c.K for c in cameras]), relative).astype(np.float64) / SCALE
    confidence = np.full(depth.shape, 9.0)
    points[:, OFF] *= 5
    confidence[:, OFF] = 1.1
    return Estimate(2, cameras, np.array([x[0] for x in frames], np.float32), points, confidence)


def depth_errors(start: Start, camera: Camera) -> np.ndarray:
    """Relative errors of the depths of the points that a camera sees, beside the board's edges."""
    _, truth, board = WORLD.trace(camera, 0.5)
    uv, z = camera.project(start.points.astype(np.float64))
    u, v = np.floor(uv).astype(int).T
    inside = (z > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    inside &= ~near_edge(board)[np.clip(v, 0, 60), np.clip(u, 0, 95)]
    return np.abs(z[inside] / truth[v[inside], u[inside]] - 1)


def near_edge(board: np.ndarray) -> np.ndarray:
    rows, columns = np.nonzero(board)
    found = np.zeros_like(board)
    found[max(0, rows.min() - 8) : rows.max() + 8, max(0, columns.min() - 8) : columns.max() + 8] = True
    return found


def test_holes_of_the_matched_points_take_the_networks(perfect: Estimate) -> None:
    """A network that is right but for a line through its inverse depths, and matches of one half of the image."""
    camera = SCENE.cameras[0]
    _, truth, board = WORLD.trace(camera, 0.5)
    v, u = np.mgrid[0:61:2, 0:48:2].reshape(2, -1)
    points = camera.unproject(np.stack([u, v], -1) + 0.5, truth[v, u])
    half = Cloud(points, np.full(len(points), 0.5, np.float32))
    bent = perfect.points.copy()
    bent[0] *= (1 / (1 / (0.6 * bent[0, :, :, 2]) + 0.05) / bent[0, :, :, 2])[..., None]
    whole = completed(half, replace(perfect, points=bent))
    assert len(whole.points) > 1.5 * len(points)
    np.testing.assert_array_equal(whole.points[: len(points)], points)
    error = depth_errors(Start(SCENE.cameras, whole.points[len(points) :], whole.values), camera)
    assert len(error) > 300 and np.median(error) < 0.02 and np.mean(error < 0.05) > 0.95
    uv = camera.project(whole.points[len(points) :])[0]
    assert (uv[:, 0] > 46).all(), "nothing where views match"
    assert not near(uv, 2 * OFF.start, 2 * OFF.stop).any(), "nothing where the network is not sure"


def near(uv: np.ndarray, start: int, stop: int) -> np.ndarray:
    return (uv[:, 1] > start) & (uv[:, 1] < stop)


@given(st.floats(0.1, 10), st.floats(-0.05, 0.3), st.integers(0, 99))
def test_a_line_is_found_through_outliers(a: float, b: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1, 5, (20, 30))
    v, u = np.mgrid[:20, :30].reshape(2, -1)
    inverse = a / depth[v, u] + b
    wrong = rng.random(600) < 0.2
    inverse = np.where(wrong, inverse * rng.uniform(1.5, 3, 600), inverse)
    kept = inverse > 0
    found = inverse_depth_line(depth, (np.stack([u, v], -1) + 0.5)[kept], 1 / inverse[kept])
    assert found is not None
    np.testing.assert_allclose(found, (a, b), atol=0.01 * a)


def test_without_a_rising_line_the_matched_points_are_all(perfect: Estimate) -> None:
    camera = SCENE.cameras[0]
    v, u = np.mgrid[0:61:2, 0:48:2].reshape(2, -1)
    depth = WORLD.trace(camera, 0.5)[1][v, u]
    for count, z in ((20, depth), (len(depth), 1 / depth)):
        points = camera.unproject((np.stack([u, v], -1) + 0.5)[:count], z[:count])
        cloud = Cloud(points, np.full(count, 0.5, np.float32))
        assert completed(cloud, perfect) is cloud


def test_the_start_is_that_of_corrected_images_where_views_match(random_network: Path) -> None:
    scene = few_views(SCENE, 0, 2, 5, 7)
    start, flat = msdi(scene), rig(scene, RigSettings(flat_field=True))
    assert start.cameras is scene.cameras
    n = len(matched(scene, MsdiSettings(), SpikeClip(scene, MsdiSettings().window_ticks, flat_field=True))[0].points)
    np.testing.assert_array_equal(start.points[:n], flat.points[:n])


def test_a_shrunk_camera_sees_the_same_points() -> None:
    camera = SCENE.cameras[1]
    points = camera.unproject(np.array([[3.0, 5.0], [90.0, 60.0]]), np.array([2.0, 4.0]))
    small = shrunk(camera, 2)
    assert (small.width, small.height) == (48, 31)
    np.testing.assert_allclose(small.project(points)[0], camera.project(points)[0] / 2)


def test_maps_of_blocks_are_means_of_the_pixels_that_there_are() -> None:
    gain = np.arange(15, dtype=np.float32).reshape(3, 5)
    found = block_means([Calibration(gain, 2 * gain, 0.6)], 2, "cpu")
    assert found.sensitivity.shape == (1, 1, 2, 3)
    assert found.sensitivity[0, 0, 0, 0] == gain[:2, :2].mean() and found.dark[0, 0, 1, 2] == 2 * gain[2, 4]


@pytest.fixture
def random_network(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Weights that nobody trained."""
    torch.manual_seed(0)
    path = tmp_path / "network.safetensors"
    WEIGHTS.save(path, Msdi(TINY), Card("tiny", 0, 0, ("toy-1",), {}))
    monkeypatch.setenv(VARIABLE, str(path))
    return path


@pytest.mark.parametrize("name", ["spike4dgs", "spike4dgs-uncalibrated"])
def test_other_weights_of_the_start_are_another_method(name: str, one_small_scene: Path, tmp_path, monkeypatch) -> None:
    shipped = METHODS[name]
    path = tmp_path / "network.safetensors"
    path.write_bytes(WEIGHTS.shipped.read_bytes())
    monkeypatch.setenv(VARIABLE, str(path))
    again = RecipeMethod(shipped.recipe, PARTS)
    assert (again.params, again.trained_on) == (shipped.params, shipped.trained_on), "a copy of the included weights"
    WEIGHTS.save(path, Msdi(TINY), Card("tiny", 0, 0, ("car-0@1234",), {}))
    if name != "spike4dgs":
        card = ConfigCard(MATCHER_TINY.name, 0, 0, ("bird-0@5678",))
        MATCHER.save(tmp_path / "matcher.safetensors", Matcher(MATCHER_TINY), card)
        monkeypatch.setenv(MATCHER_VARIABLE, str(tmp_path / "matcher.safetensors"))
    changed, scene = RecipeMethod(shipped.recipe, PARTS), open_scene(one_small_scene)
    jobs = [Job(m, scene, 0, "cpu", Budget()) for m in (shipped, changed)]
    assert jobs[0].key != jobs[1].key
    added = jobs[1].info.trained_on[len(shipped.trained_on) :]
    assert added == (("car-0@1234",) if name == "spike4dgs" else ("bird-0@5678", "car-0@1234"))
    assert jobs[1].info.trained_on[: -len(added)] == shipped.trained_on
    assert changed.params["weights_sha256"] == shipped.params["weights_sha256"]
    assert sha256_file(path) in changed.params["start_weights_sha256"]


def test_the_network_in_use_sees_the_middle_of_the_clip(random_network: Path) -> None:
    estimate = infer(SCENE, calibrated=True)
    assert estimate.factor == 1 and estimate.points.shape == (8, 61, 96, 3) and estimate.images.shape == (8, 61, 96)
    assert np.isfinite(estimate.points).all() and (estimate.confidence > 1).all()


def test_the_networks_gray_is_in_each_cameras_own_white(random_network: Path) -> None:
    gains = np.linspace(0.5, 1.5, len(SCENE.cameras), dtype=np.float32)
    states = {c.id: CameraState(gain=float(g)) for c, g in zip(SCENE.cameras, gains, strict=True)}
    plain, own = (infer(s, calibrated=True).images for s in (SCENE, replace(SCENE, states=states)))
    np.testing.assert_allclose(own, plain / gains[:, None, None], rtol=1e-5)


def test_without_calibration_the_network_is_not_told_the_intrinsics(random_network: Path) -> None:
    """The layer that takes them starts at zero and is set here: other intrinsics are then other points."""
    network = load_network(random_network, "cpu")
    torch.nn.init.normal_(network.encoder.ray_embed.weight, std=0.1)
    longer = replace(SCENE, cameras=tuple(replace(c, fx=1.3 * c.fx, fy=1.3 * c.fy) for c in SCENE.cameras))
    for calibrated in (True, False):
        a, b = (infer(s, calibrated=calibrated).points for s in (SCENE, longer))
        assert np.array_equal(a, b) != calibrated


def test_images_are_the_networks_and_know_the_camera() -> None:
    stream, maker = SCENE.streams[0], IMAGES["msdi"]
    plain = maker(stream, [40], GAIN)
    even = Calibration(np.ones((61, 96), np.float32), np.zeros((61, 96), np.float32), GAIN)
    # That the sensor is known to be even tells the network that what is uneven is the scene.
    assert 0 < np.abs(maker(stream, [40], GAIN, even) - plain).mean() < 0.02
    uneven = replace(even, gain=even.gain.copy(), dark=even.dark + 0.01)
    uneven.gain[:, :40], uneven.gain[3, 4] = 1.3, 0
    found = maker(stream, [40], GAIN, uneven)[0]
    assert np.isnan(found[3, 4]) and np.isfinite(found).sum() == found.size - 1
    assert np.nanmean(np.abs(found - plain[0])) > 1e-3
    learned = maker.learned()
    assert learned is not None and any(name.startswith("car-13@") for name in learned.trained_on)


def test_without_weights_it_is_said_how_to_train_them(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path / "absent.safetensors"))
    with pytest.raises(WeightsError, match="train it with `spike4dgs train-msdi`"):
        msdi(SCENE)
    monkeypatch.setenv(IMAGES_VARIABLE, str(tmp_path / "absent.safetensors"))
    with pytest.raises(WeightsError, match="train it with `spike4dgs train-msdi --config images`"):
        IMAGES["msdi"](SCENE.streams[0], [40], GAIN)
    assert IMAGES["msdi"].learned() is None
