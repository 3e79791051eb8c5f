"""Tracks of static points through the views of an array: features that are the same, on one image of each view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.starts.matched_poses import Seen, read_matches
from spike4dgs.method.starts.structure_from_motion import FeatureSettings, find_features

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Tracks:
    """N observations of P points; every point is seen by two or more cameras, and once by each."""

    camera: Int64  # [N]
    point: Int64  # [N]
    uv: Float64  # [N, 2] px

    @property
    def points(self) -> int:
        """P."""
        return int(self.point.max()) + 1 if len(self.point) else 0


def find_tracks(cameras: Sequence[Camera], images: Float32, seed: int) -> Tracks:
    """Return the tracks through images of all views [C, H, W], linear radiance. The same seed gives the same tracks."""
    with find_features(cameras, images, seed, FeatureSettings()) as found:
        return joined(read_matches(found, FeatureSettings().enlarge))


def joined(seen: Seen) -> Tracks:
    """Return the tracks that pairs of matches make; one that has two features of a view is wrong, and left out."""
    starts = np.concatenate([[0], np.cumsum([len(p) for p in seen.pixels])])
    parent = np.arange(starts[-1])

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = int(parent[i])
        return i

    for (a, b), matches in seen.same.items():
        for i, j in matches:
            parent[root(int(starts[a] + i))] = root(int(starts[b] + j))
    roots = np.array([root(i) for i in range(len(parent))], np.int64)
    view = np.repeat(np.arange(len(seen.pixels)), np.diff(starts))
    _, point, count = np.unique(roots, return_inverse=True, return_counts=True)
    point = point.reshape(-1)
    twice = np.unique(np.column_stack([point, view]), axis=0, return_counts=True)
    wrong = np.isin(point, twice[0][twice[1] > 1][:, 0])
    kept = (count[point] >= 2) & ~wrong
    _, renumbered = np.unique(point[kept], return_inverse=True)
    uv = np.concatenate(seen.pixels)[kept] if len(parent) else np.zeros((0, 2))
    return Tracks(view[kept], renumbered.reshape(-1), uv)
