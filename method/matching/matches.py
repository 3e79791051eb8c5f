"""Matches of all pairs of views: by the network, or by SIFT features, which learn nothing."""

from __future__ import annotations

from itertools import combinations

import cv2
import numpy as np
import torch
from torch import Tensor

from spike4dgs.benchmark.arrays import Float32, UInt8
from spike4dgs.method.matching.losses import middle_of_cell
from spike4dgs.method.matching.network import Features, Matcher, points_of_cells
from spike4dgs.method.matching.tracks import Matches, PairMatches

LEAST_PROBABILITY = 0.1  # that two cells are each other's best: below it most are wrong
_LEAST_ERROR, _MOST_ERROR = 0.05, 7.0  # px, expected
_ENLARGE = 2  # of images 200 px wide, for SIFT: at their own size it finds few features
_RATIO = 0.85  # of the distances to the best and the second best feature
_SIFT_ERROR_PX = 0.5
_ROOTS = (-1.0, 1.0)  # of `window_inputs`' channel 0: from black to four times the mean


@torch.inference_mode()
def learned_matches(network: Matcher, inputs: Float32) -> Matches:
    """Return the network's matches from inputs [V, 4, H, W] of `window_inputs`."""
    device = next(network.parameters()).device
    seen = [network.extractor(torch.from_numpy(view[None]).to(device)) for view in inputs]
    features = Features(torch.cat([f.coarse for f in seen]), torch.cat([f.fine for f in seen]), seen[0].size)
    found: dict[tuple[int, int], PairMatches] = {}
    for i, j in combinations(range(len(inputs)), 2):
        logs = network.log_probabilities(features.coarse[i, None], features.coarse[j, None])[0]
        a, b = mutual(logs, LEAST_PROBABILITY)
        found[i, j] = _refined(network, features, (i, j), a, b)
        found[j, i] = _refined(network, features, (j, i), b, a)
    return found


def mutual(logs: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Return the cells [M] of both views that are each other's best in `logs` [n, m], with probability `least`."""
    best, forth = logs.max(dim=1)
    back = logs.argmax(dim=0)
    cells = torch.arange(len(logs), device=logs.device)
    kept = (back[forth] == cells) & (best.exp() >= least)
    return cells[kept], forth[kept]


def _refined(network: Matcher, features: Features, pair: tuple[int, int], a: Tensor, b: Tensor) -> PairMatches:
    points = points_of_cells(*features.coarse.shape[2:], device=features.coarse.device)
    at, near = points[a], middle_of_cell(points[b])
    views = torch.full_like(a, pair[0]), torch.full_like(a, pair[1])
    refined = network.refined(features.fine, features.fine, at, near, views)
    error = refined.log_error.exp().clamp(_LEAST_ERROR, _MOST_ERROR)
    return PairMatches(a.cpu().numpy(), *(x.double().cpu().numpy() for x in (at, refined.uv, error)))


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
            error = np.full(len(mine), _SIFT_ERROR_PX)
            found[r, s] = PairMatches(mine, spots[r][mine], spots[s][theirs], error)
    return found


def _shown(image: Float32) -> UInt8:
    low, high = _ROOTS
    gray = np.asarray(np.clip((image - low) / (high - low), 0, 1) * 255, np.uint8)
    return np.asarray(cv2.resize(gray, None, fx=_ENLARGE, fy=_ENLARGE, interpolation=cv2.INTER_CUBIC), np.uint8)


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
