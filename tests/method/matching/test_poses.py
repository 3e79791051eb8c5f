"""Poses from matches: the derivative against differences, and arrays whose poses are known."""

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from scipy.spatial.transform import Rotation

from spike4dgs.benchmark.metrics.pose_error import angle_deg
from spike4dgs.method.matching import adjust as module
from spike4dgs.method.matching.adjust import Array, adjust, depths
from spike4dgs.method.matching.poses import Solved, solve, solve_unknown
from spike4dgs.method.matching.tracks import Matches, PairMatches, make_tracks
from spike4dgs.method.matching.two_views import averaged, relative_pose, relative_poses

SIZE = 125, 200


def true_array(views: int, rng: np.random.Generator, focal: float = 220.0, baseline: float = 0.15) -> Array:
    """Return an array about 1 from the points, turned in a little, in view 0's frame."""
    turns = Rotation.from_rotvec(rng.normal(0, 0.04, (views, 3)))
    turns = turns * turns[0].inv()
    centers = rng.normal(0, 1, (views, 3)) * (1, 1, 0.2)
    centers = (centers - centers[0]) * baseline / 2
    K = np.array([[focal, 0, SIZE[1] / 2], [0, focal, SIZE[0] / 2], [0, 0, 1.0]])
    return Array(turns.as_matrix(), centers, np.tile(K, (views, 1, 1)))


def project(array: Array, view: int, points: np.ndarray) -> np.ndarray:
    p = (points - array.centers[view]) @ array.R[view].T @ array.K[view].T
    return p[:, :2] / p[:, 2:]


def matches_of(
    array: Array, rng: np.random.Generator, noise: float = 0.0, wrong: float = 0.0, count: int = 150
) -> Matches:
    """Return matches of random points between 0.8 and 1.6 before every view in turn."""
    found = {}
    views = len(array.R)
    for r in range(views):
        at = rng.uniform((0, 0), SIZE[::-1], (count, 2))
        rays = np.concatenate([(at - array.K[r][:2, 2]) / array.K[r][0, 0], np.ones((count, 1))], axis=1)
        world = rays * rng.uniform(0.8, 1.6, (count, 1)) @ array.R[r] + array.centers[r]
        for j in range(views):
            if j == r:
                continue
            uv = project(array, j, world) + noise * rng.normal(size=(count, 2))
            bad = rng.random(count) < wrong
            uv[bad] = rng.uniform((0, 0), SIZE[::-1], (int(bad.sum()), 2))
            seen = (rng.random(count) < 0.8) & (uv > 0).all(axis=1) & (uv < SIZE[::-1]).all(axis=1)
            found[r, j] = PairMatches(np.arange(count)[seen], at[seen], uv[seen], np.full(int(seen.sum()), 0.3))
    return found


def check(solved: Solved | None, true: Array, turn_deg: float, way_deg: float) -> Solved:
    assert solved is not None
    turn = angle_deg(solved.array.R @ true.R.transpose(0, 2, 1))
    assert turn.max() < turn_deg
    a, b = solved.array.centers[1:], true.centers[1:]
    cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < way_deg
    return solved


def test_the_derivative_is_that_of_differences() -> None:
    rng = np.random.default_rng(3)
    true = true_array(4, rng)
    tracks = make_tracks(matches_of(true, rng, 0.5, count=12), 10, rng)
    weights = rng.uniform(0.3, 1, len(tracks.track))
    x = rng.normal(0, 0.01, 6 * 3 + 1)

    # At the best depths the gradient of half the squares is that of the full derivative: exact for any residuals.
    def half_squares(x: np.ndarray) -> float:
        array = true.moved(x)
        w = depths(array, tracks, weights)
        return 0.5 * float((module._sights(array, tracks, w, weights).offset ** 2).sum())

    array = true.moved(x)
    w = depths(array, tracks, weights)
    sights = module._sights(array, tracks, w, weights)
    derivative = module._projected(array, tracks, w, sights, x, True)
    expected = approx_fprime(x, half_squares, 1e-7)
    np.testing.assert_allclose(
        derivative.T @ sights.offset.ravel(), expected, rtol=2e-3, atol=2e-3 * abs(expected).max()
    )


def test_depths_are_those_of_the_points() -> None:
    rng = np.random.default_rng(4)
    true = true_array(5, rng)
    tracks = make_tracks(matches_of(true, rng), 40, rng)
    w = depths(true, tracks, np.ones(len(tracks.track)))
    seen = np.bincount(tracks.track, minlength=len(w)) > 0
    assert 1 / 1.6 - 1e-6 < w[seen].min() and w[seen].max() < 1 / 0.8 + 1e-6
    np.testing.assert_allclose(module._sights(true, tracks, w, np.ones(len(tracks.track))).offset, 0, atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_a_pair_gives_its_relative_pose(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = true_array(2, rng)
    m = matches_of(true, rng)[0, 1]
    K = true.K[0]
    a, b = ((x - K[:2, 2]) / K[0, 0] for x in (m.at, m.uv))
    found = relative_pose(a, b, 220.0, 0.3)
    assert found is not None and found.inliers > 0.9 * len(a)
    assert angle_deg(found.R @ true.R[1].T) < 0.05
    t = -true.R[1] @ true.centers[1]
    assert found.t @ t / np.linalg.norm(t) > 0.999
    assert relative_pose(a[:5], b[:5], 220.0, 0.3) is None


def test_averages_of_exact_pairs_are_exact() -> None:
    rng = np.random.default_rng(0)
    true = true_array(6, rng)
    found = averaged(relative_poses(matches_of(true, rng), true.K, 0.5), 6)
    assert found is not None
    np.testing.assert_allclose(found[0], true.R, atol=2e-3)
    scale = np.sqrt((true.centers**2).sum(1)[1:].mean())
    np.testing.assert_allclose(found[1], true.centers / scale, atol=0.05)


@pytest.mark.parametrize(("views", "seed", "turn_deg", "way_deg"), [(3, 0, 0.6, 10.0), (6, 1, 0.2, 3.0)])
def test_an_array_is_found_from_noisy_and_wrong_matches(views: int, seed: int, turn_deg: float, way_deg: float) -> None:
    rng = np.random.default_rng(seed)
    true = true_array(views, rng)
    solved = check(solve(matches_of(true, rng, noise=0.3, wrong=0.2), true.K), true, turn_deg, way_deg)
    sights = solved.tracks
    scale = np.sqrt((true.centers**2).sum(1)[1:].mean())
    of_many = np.bincount(sights.track, minlength=len(sights.anchor)) >= min(views - 1, 4)
    depth = scale / solved.adjusted.inverse_depth[of_many]
    assert 0.7 < np.quantile(depth, 0.1) and np.quantile(depth, 0.9) < 1.8


def test_a_narrow_array_is_found() -> None:
    rng = np.random.default_rng(5)
    true = true_array(5, rng, baseline=0.04)
    check(solve(matches_of(true, rng, noise=0.2, count=100), true.K), true, 0.3, 5.0)


def test_the_focal_length_is_found_too() -> None:
    rng = np.random.default_rng(6)
    true = true_array(3, rng, baseline=0.3)
    matches = matches_of(true, rng, noise=0.2, wrong=0.1, count=80)
    solved = check(solve_unknown(matches, SIZE, 3), true, 0.5, 5.0)
    assert solved.array.K[0, 0, 0] == pytest.approx(220, rel=0.03)


def test_two_views_have_points() -> None:
    rng = np.random.default_rng(8)
    true = true_array(2, rng, baseline=0.3)
    solved = solve(matches_of(true, rng, noise=0.1), true.K)
    assert solved is not None and len(solved.points_kept()) > 50


def test_too_few_matches_give_no_pose() -> None:
    rng = np.random.default_rng(7)
    true = true_array(3, rng)
    matches = {pair: m for pair, m in matches_of(true, rng).items() if 2 not in pair}
    assert solve(matches, true.K) is None
    assert solve({}, true.K) is None


def test_an_adjustment_from_the_truth_stays_there() -> None:
    rng = np.random.default_rng(8)
    true = true_array(4, rng)
    scale = np.sqrt((true.centers**2).sum(1)[1:].mean())
    array = Array(true.R, true.centers / scale, true.K)
    found = adjust(array, make_tracks(matches_of(true, rng), 50, rng))
    assert found.cost < 1e-8
    np.testing.assert_allclose(found.array.R, true.R, atol=1e-6)
