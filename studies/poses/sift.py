"""Matches of all pairs of views by SIFT features, which learn nothing: what the matching network is compared with."""

from __future__ import annotations

from itertools import combinations

import cv2
import numpy as np

from spike4dgs.benchmark.arrays import Float32, UInt8
from spike4dgs.method.matching.matches import gray_of
from spike4dgs.method.matching.tracks import Matches, PairMatches

_ENLARGE = 2  # of images 200 px wide: at their own size SIFT finds few features
_RATIO = 0.85  # of the distances to the best and the second best feature
_ERROR_PX = 0.5


def sift_matches(images: Float32) -> Matches:
    """Return matches of SIFT features in images [V, H, W], the first channel of `window_inputs`."""
    sift = cv2.SIFT.create(contrastThreshold=0.01, edgeThreshold=15)
    spots, descriptors = [], []
    for image in images:
        points, described = sift.detectAndCompute(_shown(image), None)
        uv = np.array([p.pt for p in points], np.float64).reshape(-1, 2)
        spots.append((uv + 0.5) / _ENLARGE)  # OpenCV's coordinates have pixel centres at 0
        described = np.zeros((0, 128), np.float32) if described is None else described
        unit = described / np.maximum(np.abs(described).sum(axis=1, keepdims=True), 1e-9)
        descriptors.append(np.sqrt(unit))  # RootSIFT
    found = {}
    for i, j in combinations(range(len(images)), 2):
        a, b = _nearest(descriptors[i], descriptors[j])
        for r, s, mine, theirs in ((i, j, a, b), (j, i, b, a)):
            error = np.full(len(mine), _ERROR_PX)
            found[r, s] = PairMatches(mine, spots[r][mine], spots[s][theirs], error)
    return found


def _shown(image: Float32) -> UInt8:
    size = (_ENLARGE * image.shape[1], _ENLARGE * image.shape[0])
    return np.asarray(cv2.resize(gray_of(image), size, interpolation=cv2.INTER_CUBIC), np.uint8)


def _nearest(a: Float32, b: Float32) -> tuple[np.ndarray, np.ndarray]:
    """Return features [M] of both that are each other's nearest and clearly nearer than the second."""
    if min(len(a), len(b)) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    similar = a @ b.T
    order = np.argpartition(-similar, 1, axis=1)[:, :2]
    two = np.sort(np.take_along_axis(similar, order, axis=1), axis=1)
    distance = np.sqrt(np.maximum(2 - 2 * two, 0))
    forth, back = similar.argmax(axis=1), similar.argmax(axis=0)
    mine = np.arange(len(a))
    kept = (back[forth] == mine) & (distance[:, 1] < _RATIO * distance[:, 0])
    return mine[kept], forth[kept]
