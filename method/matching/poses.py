"""Poses of an array from matches of all pairs: essential matrices, averages, bundle adjustment.

An array that is small beside its distance has poses that are wrong and locally best (a relief seen from one side looks
like its inverse seen from the other). So the adjustment begins twice, from the averaged essential matrices and from a
plane in front of view 0, and the result that explains the matches better is kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.arrays import Float64, Int64
from spike4dgs.method.matching.adjust import Adjusted, Array, adjust
from spike4dgs.method.matching.tracks import Matches, Tracks, make_tracks
from spike4dgs.method.matching.two_views import averaged, normalized, relative_poses
from spike4dgs.method.msdi.pose import LEAST_POINTS, solve_pose


@dataclass(frozen=True)
class SolveSettings:
    """Numbers of the solver, chosen on variants kept for tests."""

    reach_px: float = 1.5  # of a match to its epipolar line, and of a plane's points to their matches
    plane_px: float = 8.0  # of the plane's points, while nothing is known: a relief is no plane
    points: int = 200  # of each anchor view in the last adjustment
    first_points: int = 60  # in the first ones, which choose where to begin
    focals: tuple[float, ...] = (0.6, 0.8, 1.0, 1.3, 1.7, 2.2, 3.0)  # in image widths, tried where it is unknown
    believed: float = 6.0  # expected errors from which a sight is left out of the last adjustment


DEFAULTS = SolveSettings()
CERTAIN = 3.0  # expected errors of a sight that counts for a point


@dataclass(frozen=True, eq=False)
class Solved:
    """Poses of V views in view 0's frame; the root of the mean square distance of the others from it is 1."""

    array: Array
    tracks: Tracks
    adjusted: Adjusted

    def points_kept(self) -> Int64:
        """Return the numbers of the tracks in front of the views that enough of them see within `CERTAIN` errors.

        That is two beside the track's own, or the other one of two views.
        """
        t, w = self.tracks, self.adjusted.inverse_depth
        good = np.bincount(t.track[self.adjusted.errors < CERTAIN], minlength=len(w))
        return np.flatnonzero((good >= min(2, len(self.array.R) - 1)) & (w > 0))

    @property
    def w2c(self) -> Float64:
        """World to camera [V, 4, 4]."""
        found = np.tile(np.eye(4), (len(self.array.R), 1, 1))
        found[:, :3, :3] = self.array.R
        found[:, :3, 3] = -np.einsum("vij,vj->vi", self.array.R, self.array.centers)
        return found


def solve(matches: Matches, K: Float64, seed: int = 0, settings: SolveSettings = DEFAULTS) -> Solved | None:
    """Return poses from matches of all pairs and intrinsics [V, 3, 3]; None where the matches do not give them."""
    return _best(matches, [K], seed, settings, focal=False)


def solve_unknown(
    matches: Matches, size: tuple[int, int], views: int, seed: int = 0, settings: SolveSettings = DEFAULTS
) -> Solved | None:
    """Return poses and one focal length; square pixels, principal point in the middle of images of `size` (H, W)."""
    height, width = size
    tried = [np.array([[f * width, 0, width / 2], [0, f * width, height / 2], [0, 0, 1]]) for f in settings.focals]
    return _best(matches, [np.tile(K, (views, 1, 1)) for K in tried], seed, settings, focal=True)


def _best(
    matches: Matches, intrinsics: list[Float64], seed: int, settings: SolveSettings, *, focal: bool
) -> Solved | None:
    rng = np.random.default_rng(seed)
    few, many = (make_tracks(matches, count, rng) for count in (settings.first_points, settings.points))
    views = len(intrinsics[0])
    if not _all_seen(few, views):
        return None
    first: list[tuple[float, Array]] = []
    for K in intrinsics:
        for array in _beginnings(matches, K, seed, settings):
            found = adjust(array, few, focal=focal)
            if np.isfinite(found.cost):
                first.append((found.cost, found.array))
    if not first:
        return None
    _, array = min(first, key=lambda x: x[0])
    found = adjust(array, many, focal=focal)
    kept = many.where(found.errors < settings.believed)
    if _all_seen(kept, views):
        many, found = kept, adjust(found.array, kept, focal=focal, rounds=2)
    return Solved(found.array, many, found)


def _all_seen(tracks: Tracks, views: int) -> bool:
    seen = np.bincount(tracks.view, minlength=views) + np.bincount(tracks.anchor[tracks.track], minlength=views)
    return bool((seen >= LEAST_POINTS).all())


def _beginnings(matches: Matches, K: Float64, seed: int, settings: SolveSettings) -> Iterator[Array]:
    pairs = relative_poses(matches, K, settings.reach_px)
    if pairs and (found := averaged(pairs, len(K))):
        yield Array(*found, K)
    if array := from_plane(matches, K, seed, settings):
        yield array


def from_plane(matches: Matches, K: Float64, seed: int, settings: SolveSettings = DEFAULTS) -> Array | None:
    """Return poses for which view 0's matches lie on a plane parallel to its image, as far as they can; or None."""
    R, centers = [np.eye(3)], [np.zeros(3)]
    for view in range(1, len(K)):
        m = matches.get((0, view))
        if m is None or len(m.point) < LEAST_POINTS:
            return None
        points = np.concatenate([normalized(m.at, K[0]), np.ones((len(m.at), 1))], axis=1)
        pose = solve_pose(points, m.uv, K[view], seed, reach_px=settings.plane_px)
        if pose is None:
            return None
        R.append(pose[0])
        centers.append(-pose[0].T @ pose[1])
    away = np.stack(centers)
    scale = np.sqrt((away**2).sum(axis=1)[1:].mean())
    return Array(np.stack(R), away / scale, K) if scale > 0 else None
