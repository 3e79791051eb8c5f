"""Matches of all pairs of views, by the network.

The network finds partners that no classical feature finds in the noise of low light, to about a pixel. Where the images
around a match are alike, Lucas and Kanade's alignment (OpenCV) then measures it to a third of a pixel. Its error is
expected from noise and slopes, and from the way back: where that ends elsewhere, the match is as uncertain.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from spike4dgs.benchmark.arrays import Float32, Mask, UInt8
from spike4dgs.method.matching.network import Features, Matcher, middle_of_cell, points_of_cells
from spike4dgs.method.matching.tracks import Matches, PairMatches

LEAST_PROBABILITY = 0.1  # that two cells are each other's best: below it most are wrong
_MOST_AT_ONCE = 10_000**2  # pairs of cells, whose probabilities are held at once several times: 400 MB each time
_BLOCK = 1 << 23  # pairs of a block of rows, where there are more
_LEAST_ERROR, _MOST_ERROR = 0.05, 7.0  # px, expected
_COARSE_ERROR_PX = 1.0  # expected of a match that could not be aligned, at least
# Sides of the windows that are aligned. A point takes the smallest in which noise leaves less than `_ALIGN_NOISE_PX`:
# in a larger one the views' perspectives differ, and the error is the same for all points around.
_ALIGN_PX = (7, 11, 21)
_ALIGN_NOISE_PX = 0.8
_ALIGN_BLUR_PX = 0.7
_ALIGN_REACH_PX = 4.0  # from the network's match: beyond it the alignment has lost its way
_ALIGN_FLOOR_PX = 0.2  # error that is expected of the best alignment
_ALIGN_END = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01)  # rounds, px
_ROOTS = (-1.0, 1.0)  # of `window_inputs`' channel 0: from black to four times the mean


@torch.inference_mode()
def learned_matches(network: Matcher, inputs: Float32) -> Matches:
    """Return the network's matches, aligned, from inputs [V, 4, H, W] of `window_inputs`."""
    device = next(network.parameters()).device
    seen = [network.extractor(torch.from_numpy(view[None]).to(device)) for view in inputs]
    features = Features(torch.cat([f.coarse for f in seen]), torch.cat([f.fine for f in seen]), seen[0].size)
    found: dict[tuple[int, int], PairMatches] = {}
    for i, j in combinations(range(len(inputs)), 2):
        a, b = _partners(network, features.coarse[i, None], features.coarse[j, None])
        found[i, j] = _refined(network, features, (i, j), a, b)
        found[j, i] = _refined(network, features, (j, i), b, a)
    return {(i, j): aligned(inputs[i, 0], inputs[j, 0], m) for (i, j), m in found.items()}


def aligned(first: Float32, second: Float32, matches: PairMatches) -> PairMatches:
    """Return matches whose places in the second image [H, W] are those at which the images agree best.

    A match that the alignment moves far, or not at all, stays as it is.
    """
    if not len(matches.point):
        return matches
    at, near = ((x - 0.5).astype(np.float32) for x in (matches.at, matches.uv))  # OpenCV: pixel centres at 0
    blurred = [cv2.GaussianBlur(image, (0, 0), _ALIGN_BLUR_PX) for image in (first, second)]
    a, b = (gray_of(np.asarray(image, np.float32)) for image in blurred)
    there, back = near.copy(), np.full_like(at, np.inf)
    noise = _noise(first) * np.stack([_error_of_noise(blurred[0], at, side) for side in _ALIGN_PX])  # [windows, M]
    fine = noise < _ALIGN_NOISE_PX
    choice = np.where(fine.any(axis=0), fine.argmax(axis=0), len(_ALIGN_PX) - 1)
    found = np.zeros(len(at), bool)
    for k, side in enumerate(_ALIGN_PX):
        mine = choice == k
        if mine.any():
            there[mine], went = _flow(a, b, at[mine], near[mine], side)
            back[mine], came = _flow(b, a, there[mine], at[mine], side)
            found[mine] = went & came
    good = found & (np.linalg.norm(there - near, axis=1) < _ALIGN_REACH_PX)
    off = np.where(good, np.linalg.norm(back - at, axis=1), 0)
    error = np.sqrt(_ALIGN_FLOOR_PX**2 + off**2 + noise[choice, np.arange(len(at))] ** 2)
    uv = np.where(good[:, None], there.astype(np.float64) + 0.5, matches.uv)
    kept = np.maximum(matches.error, _COARSE_ERROR_PX)
    return replace(matches, uv=uv, error=np.where(good, np.clip(error, _LEAST_ERROR, _MOST_ERROR), kept))


def _noise(image: Float32) -> float:
    """Return Immerkaer's estimate (1996) of the noise, by an operator that no plane and no straight edge passes."""
    operator = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)
    return math.sqrt(math.pi / 2) / 6 * float(np.abs(cv2.filter2D(image, cv2.CV_32F, operator)).mean())


def _error_of_noise(image: cv2.typing.MatLike, at: Float32, side: int) -> Float32:
    """Return the errors [M] px that noise of 1 leaves in an alignment of windows of `side` px.

    It is the noise of two images over the root of the window's least sum of squared slopes: along the worst direction.
    """
    slopes = cv2.cornerMinEigenVal(image, side, ksize=3) * (side / 2) ** 2  # OpenCV scales by 4 / side^2
    column, row = np.rint(at).astype(np.int64).T
    least = slopes[row.clip(0, len(image) - 1), column.clip(0, image.shape[1] - 1)]
    return np.asarray(math.sqrt(2) / np.sqrt(np.maximum(least, 1e-9)), np.float32)


def _flow(first: UInt8, second: UInt8, at: Float32, near: Float32, side: int) -> tuple[Float32, Mask]:
    """Return where points are in the second image, begun at `near`, and whether they were found."""
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        first,
        second,
        at,
        near.copy(),
        winSize=(side, side),
        maxLevel=0,
        criteria=_ALIGN_END,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(there, np.float32), found[:, 0] > 0


def _partners(network: Matcher, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Return the cells [M] of views `a` and `b` [1, C, h, w] that are each other's best."""
    cells = a[0, 0].numel()
    if cells**2 <= _MOST_AT_ONCE:
        return mutual(network.log_probabilities(a, b)[0], LEAST_PROBABILITY)
    rows, columns = network.factors(a, b)
    return mutual_by_rows(rows[0], columns[0], LEAST_PROBABILITY, max(1, _BLOCK // cells))


def mutual(logs: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Return the cells [M] of both views that are each other's best in `logs` [n, m], with probability `least`."""
    best, forth = logs.max(dim=1)
    return _each_others(best, forth, logs.argmax(dim=0), least)


def mutual_by_rows(a: Tensor, b: Tensor, least: float, rows: int) -> tuple[Tensor, Tensor]:
    """Return what `mutual` does of `Matcher.factors` [n, C] and [C, m], with memory for `rows` of the n cells."""
    blocks = a.split(rows)
    column = b.new_full(b.shape[1:], -torch.inf)  # [m] logarithms of the sums that the second softmax divides by
    for block in blocks:
        column = torch.logaddexp(column, (block @ b).logsumexp(dim=0))
    highest, back = torch.full_like(column, -torch.inf), torch.zeros_like(column, dtype=torch.long)
    found = []
    for number, block in enumerate(blocks):
        similar = block @ b
        logs = functional.log_softmax(similar, dim=1) + (similar - column)
        found.append(logs.max(dim=1))
        most, row = logs.max(dim=0)
        back = torch.where(most > highest, row + number * rows, back)
        highest = torch.maximum(most, highest)
    best, forth = (torch.cat(parts) for parts in zip(*found, strict=True))
    return _each_others(best, forth, back, least)


def _each_others(best: Tensor, forth: Tensor, back: Tensor, least: float) -> tuple[Tensor, Tensor]:
    """Return the pairs [M] of rows and columns that agree: each row's best column, each column's best row."""
    cells = torch.arange(len(best), device=best.device)
    kept = (back[forth] == cells) & (best.exp() >= least)
    return cells[kept], forth[kept]


def _refined(network: Matcher, features: Features, pair: tuple[int, int], a: Tensor, b: Tensor) -> PairMatches:
    rows, columns = features.coarse.shape[2:]
    points = points_of_cells(rows, columns, device=features.coarse.device)
    at, near = points[a], middle_of_cell(points[b])
    views = torch.full_like(a, pair[0]), torch.full_like(a, pair[1])
    refined = network.refined(features.fine, features.fine, at, near, views)
    error = refined.log_error.exp().clamp(_LEAST_ERROR, _MOST_ERROR)
    return PairMatches(a.cpu().numpy(), *(x.double().cpu().numpy() for x in (at, refined.uv, error)))


def gray_of(root: Float32) -> UInt8:
    """Return an image [H, W], the first channel of `window_inputs`, as OpenCV's features see it."""
    low, high = _ROOTS
    return np.asarray(np.clip((root - low) / (high - low), 0, 1) * 255, np.uint8)
