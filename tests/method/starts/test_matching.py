"""Poses and points from matches of the toy world: true matches give its cameras; weights decide which network runs."""

from pathlib import Path

import numpy as np
import pytest
import torch
from toy_world import ToyWorld, few_views

from spike4dgs.benchmark.metrics.pose_error import pose_errors
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.weights import WeightsError
from spike4dgs.method.matching.config import TINY
from spike4dgs.method.matching.network import Matcher, points_of_cells
from spike4dgs.method.matching.poses import solve
from spike4dgs.method.matching.tracks import Matches, PairMatches
from spike4dgs.method.matching.training.truth import correspond
from spike4dgs.method.matching.weights import VARIABLE, WEIGHTS, load_matcher
from spike4dgs.method.models.network_weights import ConfigCard
from spike4dgs.method.starts.matching import in_scene, match_and_solve, matched, refined_poses, seen_inputs

WORLD = ToyWorld(width=96, height=61, n_ticks=80, seed=1, views=(0, 1, 2, 3))  # six pairs of views, all eight have 28
FEW = few_views(WORLD.training, 0, 1, 3)


def true_matches() -> Matches:
    depth = [torch.from_numpy(np.asarray(WORLD.trace(c, 0.5)[1], np.float64)) for c in WORLD.training.cameras]
    K, w2c = ([torch.from_numpy(getattr(c, name)) for c in WORLD.training.cameras] for name in ("K", "w2c"))
    at = points_of_cells(15, 24).double()
    found = {}
    for i in range(len(depth)):
        for j in range(len(depth)):
            if i != j:
                true = correspond(at, (depth[i], depth[j]), (K[i], K[j]), w2c[j] @ torch.linalg.inv(w2c[i]))
                seen = true.seen.numpy()
                uv = true.uv.numpy()[seen]
                found[i, j] = PairMatches(np.flatnonzero(seen), at.numpy()[seen], uv, np.full(len(uv), 0.3))
    return found


def test_true_matches_give_the_cameras_and_the_points_of_the_scene() -> None:
    solved = solve(true_matches(), np.stack([c.K for c in WORLD.training.cameras]))
    assert solved is not None
    found = in_scene(WORLD.training, solved, seen_inputs(WORLD.training))
    errors = pose_errors(found.cameras, WORLD.training.cameras)
    assert errors.rotation_deg.max() < 0.05 and errors.translation_m.max() < 0.03 * errors.array_m
    assert len(found.points) > 300 and len(found.values) == len(found.points)
    assert np.median(WORLD.depth_errors(found.points, WORLD.training.cameras[0])) < 0.01


@pytest.fixture(scope="module")
def placed() -> tuple[Camera, ...]:
    """The network's cameras, with known intrinsics."""
    return match_and_solve(FEW, 0, "cpu", calibrated=True).cameras


def test_the_shipped_network_places_the_cameras_of_a_world_that_it_never_saw(placed: tuple[Camera, ...]) -> None:
    errors = pose_errors(placed, FEW.cameras)
    assert errors.rotation_deg.max() < 0.5 and errors.translation_m.max() < 0.03 * errors.array_m
    free = match_and_solve(FEW, 0, "cpu", calibrated=False)
    errors = pose_errors(free.cameras, FEW.cameras)
    assert errors.rotation_deg.max() < 1 and errors.translation_m.max() < 0.06 * errors.array_m
    assert len({camera.fx for camera in free.cameras}) == 1 and free.cameras[0].fx != FEW.cameras[0].fx


def test_points_of_the_start_lie_on_the_surfaces() -> None:
    start = matched(WORLD.training, 0, device="cpu")
    errors = pose_errors(start.cameras, WORLD.training.cameras)
    assert errors.rotation_deg.max() < 0.5 and errors.translation_m.max() < 0.03 * errors.array_m
    assert all(a.fx == b.fx for a, b in zip(start.cameras, WORLD.training.cameras, strict=True))
    off = WORLD.depth_errors(start.points)
    assert len(off) > 1000 and np.median(off) < 0.03


def test_where_features_find_nothing_the_networks_poses_stay(placed: tuple[Camera, ...], monkeypatch) -> None:
    dark = np.zeros((3, 61, 96), np.float32)
    monkeypatch.setattr("spike4dgs.method.starts.matching.window_means", lambda *args, **options: dark)
    found = refined_poses(FEW, 0, device="cpu").cameras
    assert all(np.array_equal(a.w2c, b.w2c) for a, b in zip(found, placed, strict=True))


def test_inputs_are_those_of_all_views() -> None:
    inputs = seen_inputs(WORLD.training)
    assert inputs.shape == (len(WORLD.training.cameras), 4, 61, 96) and np.isfinite(inputs).all()
    # The first channel is the image: its square is the radiance, up to a factor.
    truth = np.asarray(WORLD.trace(WORLD.training.cameras[2], 0.5)[0])
    assert np.corrcoef((inputs[2, 0] + 1).ravel() ** 2, truth.ravel())[0, 1] > 0.8


def test_the_network_in_use_is_that_of_the_variable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    network = Matcher(TINY)
    path = tmp_path / "matcher.safetensors"
    WEIGHTS.save(path, network, ConfigCard(TINY.name, 3, 0, ("toy-13@0",)))
    loaded = load_matcher(path, "cpu")
    x = torch.randn(1, 4, 32, 40)
    with torch.no_grad():
        a, b = network.extractor(x), loaded.extractor(x)
    torch.testing.assert_close(a.coarse, b.coarse, atol=5e-3, rtol=5e-3)
    monkeypatch.setenv(VARIABLE, str(path))
    match_and_solve(FEW, 0, "cpu", calibrated=True)  # random weights: any answer, but no failure
    monkeypatch.setenv(VARIABLE, str(tmp_path / "absent.safetensors"))
    with pytest.raises(WeightsError, match=r"absent\.safetensors"):
        match_and_solve(FEW, 0, "cpu", calibrated=True)
