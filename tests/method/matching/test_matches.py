"""Matches: alignment of images whose shift is known, and tracks of matches."""

import numpy as np
from scipy.ndimage import gaussian_filter, shift

from spike4dgs.method.matching.matches import aligned
from spike4dgs.method.matching.tracks import PairMatches, make_tracks


def texture(seed: int = 0) -> np.ndarray:
    image = gaussian_filter(np.random.default_rng(seed).normal(size=(100, 140)), 1.5)
    return np.asarray(image / np.abs(image).max(), np.float32)


def test_alignment_finds_a_shift_to_a_tenth_of_a_pixel() -> None:
    moved = (3.3, -1.7)  # right, down
    first = texture()
    second = shift(first, moved[::-1], order=3, mode="nearest")
    a, b = first, np.asarray(second, np.float32)
    rng = np.random.default_rng(1)
    at = rng.uniform(25, 75, (60, 2))
    near = at + moved + rng.uniform(-1.5, 1.5, at.shape)
    found = aligned(a, b, PairMatches(np.arange(60), at, near, np.full(60, 1.2)))
    off = np.linalg.norm(found.uv - at - moved, axis=1)
    assert np.median(off) < 0.1 and np.quantile(off, 0.9) < 0.3
    assert (found.error < 0.5).mean() > 0.8
    # Without texture nothing can be aligned: the match stays, and is uncertain.
    flat = np.zeros_like(a)
    kept = aligned(flat, flat, PairMatches(np.arange(60), at, near, np.full(60, 0.2)))
    np.testing.assert_allclose(kept.uv, near, atol=1e-3)
    assert (kept.error >= 0.3).all()
    empty = PairMatches(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    assert aligned(a, b, empty) is empty


def test_tracks_join_the_sights_of_a_point_and_prefer_those_of_many_views() -> None:
    def pair(points: list[int], view: int) -> PairMatches:
        p = np.array(points)
        at = np.stack([p, 2 * p], 1).astype(float)
        return PairMatches(p, at, at + 10 * view, np.full(len(p), 0.1 * view))

    matches = {(0, 1): pair([3, 5, 8], 1), (0, 2): pair([5, 8], 2), (2, 0): pair([1], 3)}
    tracks = make_tracks(matches, 2, np.random.default_rng(0))
    assert tracks.anchor.tolist() == [0, 0, 2]
    np.testing.assert_array_equal(tracks.at, [[5, 10], [8, 16], [1, 2]])
    sights = sorted(zip(tracks.track.tolist(), tracks.view.tolist(), tracks.uv[:, 0].tolist(), strict=True))
    assert sights == [(0, 1, 15), (0, 2, 25), (1, 1, 18), (1, 2, 28), (2, 0, 31)]
    assert make_tracks({}, 5, np.random.default_rng(0)).anchor.shape == (0,)
