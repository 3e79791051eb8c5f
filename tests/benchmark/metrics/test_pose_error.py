from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from spike4dgs.benchmark.metrics.pose_error import Sim3, align_cameras, pose_errors, umeyama
from spike4dgs.benchmark.scene.cameras import Camera, look_at

UP = np.array([0.0, 0.0, 1.0])


def camera(center: np.ndarray, R: np.ndarray) -> Camera:
    return Camera("c", 80, 50, 90.0, 90.0, 40.0, 25.0, R, -R @ center)


def facing(centers: np.ndarray, target: tuple[float, float, float] = (0.1, 4.0, 0.2)) -> list[Camera]:
    return [look_at("c", c, np.array(target), UP, focal=90, width=80, height=50) for c in centers]


def parallel(centers: np.ndarray) -> list[Camera]:
    return [camera(c, np.eye(3)) for c in centers]


def random_sim3(seed: int) -> Sim3:
    rng = np.random.default_rng(seed)
    return Sim3(float(np.exp(rng.normal())), Rotation.random(random_state=seed).as_matrix(), 3 * rng.normal(size=3))


LINE = np.stack([np.linspace(-0.5, 0.5, 5), np.zeros(5), np.ones(5)], axis=-1)
GRID = np.array([[x, 0.0, z] for z in (0.8, 1.0, 1.2) for x in (-0.3, 0.0, 0.3)])
BALL = np.random.default_rng(1).normal(size=(7, 3))
RIGS = {
    "collinear, parallel": parallel(LINE),
    "collinear, turned": facing(LINE),
    "planar, parallel": parallel(GRID),
    "planar, turned": facing(GRID),
    "anywhere": [camera(c, Rotation.random(random_state=i).as_matrix()) for i, c in enumerate(BALL)],
    "two": facing(LINE[:2]),
}


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("seed", range(4))
def test_similarity_of_cameras_is_recovered(rig: str, seed: int) -> None:
    given, there = RIGS[rig], random_sim3(seed)
    true = [there.camera(c) for c in given]
    found = align_cameras(given, true)
    assert abs(found.scale / there.scale - 1) < 1e-8
    assert np.allclose(found.R, there.R, atol=1e-8) and np.allclose(found.t, there.t, atol=1e-8)
    errors = pose_errors(given, true)
    assert errors.rotation_deg.max() < 1e-6 and errors.translation_m.max() < 1e-8
    assert errors.summary()["maa_30"] == errors.summary()["rra_5"] == errors.summary()["rta_5"] == 1


@given(st.integers(0, 10_000), st.integers(4, 12), st.sampled_from(["ball", "plane", "flat noise"]))
@settings(max_examples=40, deadline=None)
def test_umeyama_recovers_similarities_of_points(seed: int, n: int, shape: str) -> None:
    thick = {"ball": 1, "plane": 0, "flat noise": 1e-9}[shape]
    points = np.random.default_rng(seed).normal(size=(n, 3)) * [1, 1, thick]
    there = random_sim3(seed)
    found = umeyama(points, there(points))
    assert np.linalg.det(found.R) > 0.99
    assert np.allclose(found(points), there(points), atol=1e-8)
    assert np.allclose(found.R, there.R, atol=1e-6) and abs(found.scale / there.scale - 1) < 1e-8


def test_umeyama_gives_the_best_rotation_where_a_reflection_would_fit_better() -> None:
    points = np.random.default_rng(3).normal(size=(20, 3)) * [1, 0.8, 0.3]
    target = points * [1, 1, -1]
    best = umeyama(points, target)

    def loss(s: Sim3) -> float:
        return float(np.sum((s(points) - target) ** 2))

    assert np.linalg.det(best.R) > 0.99
    rng = np.random.default_rng(0)
    for _ in range(300):  # no nearby similarity is better
        R = Rotation.from_rotvec(0.03 * rng.normal(size=3)).as_matrix() @ best.R
        near = Sim3(best.scale * np.exp(0.03 * rng.normal()), R, best.t + 0.03 * rng.normal(size=3))
        assert loss(near) >= loss(best)


def test_a_transformed_camera_projects_transformed_points_to_the_same_pixels() -> None:
    there, points = random_sim3(5), np.random.default_rng(0).normal(size=(30, 3)) + [0, 5, 1]
    for c in RIGS["planar, turned"]:
        uv, z = c.project(points)
        moved_uv, moved_z = there.camera(c).project(there(points))
        assert np.allclose(uv, moved_uv, atol=1e-9) and np.allclose(moved_z, there.scale * z)


def test_one_wrong_camera_is_measured() -> None:
    """A camera of a large array that is turned by 2 degrees and moved by 3 cm; the others hold the alignment."""
    grid = np.array([[x, 0.0, z] for z in np.linspace(0, 2, 9) for x in np.linspace(-1, 1, 9)])
    true = facing(grid, (0.0, 9.0, 1.0))
    turn = Rotation.from_rotvec(np.radians(2) * np.array([0, 1, 0])).as_matrix()
    wrong = list(true)
    wrong[7] = camera(true[7].center + [0.03, 0, 0], turn @ true[7].R)
    errors = pose_errors([random_sim3(2).camera(c) for c in wrong], true)
    assert abs(errors.rotation_deg[7] - 2) < 0.1 and np.delete(errors.rotation_deg, 7).max() < 0.1
    assert abs(errors.translation_m[7] - 0.03) < 2e-3 and np.delete(errors.translation_m, 7).max() < 2e-3
    assert abs(errors.array_m - np.sqrt(2)) < 1e-9
    pairs = [k for k, (i, j) in enumerate(zip(*np.triu_indices(81, 1), strict=True)) if 7 in (i, j)]
    assert np.allclose(errors.pair_rotation_deg[pairs], 2, atol=1e-6)
    assert np.delete(errors.pair_rotation_deg, pairs).max() < 1e-6
    summary = errors.summary()
    assert summary["rra_5"] == 1 and summary["rotation_max_deg"] == errors.rotation_deg.max()


def test_shares_of_pairs_count_what_is_below_the_thresholds() -> None:
    true = facing(GRID)
    opposite = [replace(c, t=-c.t) for c in true]  # all directions reversed: rotations right, translations not
    summary = pose_errors(opposite, true).summary()
    assert summary["rra_5"] == 1
    assert summary["rta_15"] == summary["rta_5"] == summary["maa_30"] == 0
    turns = [Rotation.from_rotvec([0, 0, np.radians(10.5) * (i % 2)]).as_matrix() for i in range(len(true))]
    turned = [camera(c.center, turn @ c.R) for c, turn in zip(true, turns, strict=True)]
    errors = pose_errors(turned, true)
    worst = np.maximum(errors.pair_rotation_deg, errors.pair_direction_deg)
    by_hand = np.mean([[w < k for w in worst] for k in range(1, 31)])
    assert abs(errors.summary()["maa_30"] - by_hand) < 1e-12
    assert errors.summary()["rra_5"] == np.mean(errors.pair_rotation_deg < 5) < 1
    assert errors.summary()["rra_15"] == 1
