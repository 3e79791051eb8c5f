"""First offsets of an array's clocks, up to hundreds of ticks, by trying them all for each pair of cameras.

For a pair, patches of the first camera in which something moves are looked for in the second one at every offset, each
at the inverse depth at which it fits best. The offset of a pair is known badly where things move along the line between
its cameras, because another depth looks like another time. All pairs together tell the offsets of all cameras: they
are the ones at which the pairs' costs add up to least.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.method.self_calibration.clock_fit import ClockSettings, least_change, reach_ticks
from spike4dgs.method.self_calibration.patches import CAP, Patches, Rays, Viewer, moment, rays, strongest, window_image

FAR_COST = 2.0  # of a pair whose offset was not tried, both ways: that of a pair of images that have nothing in common
MOST_ROUNDS = 20  # of moving each camera in turn; three are usual


@dataclass(frozen=True)
class SearchSettings:
    """Numbers of the search."""

    most_ticks: int = 300  # between two cameras: each up to 200 from their mean, nearly
    clip_share: float = 0.6  # of the clip, that an offset is at most: the rest is what both cameras see
    step_ticks: int = 5
    times: int = 8
    patches: int = 30  # of a camera at a time
    depths: int = 12
    blur_px: float = 2.5
    cell_px: int = 8
    shrink: int = 2  # only every so many pixels of the blurred images are looked at


def candidates(n_ticks: int, s: SearchSettings) -> NDArray[np.int64]:
    """Return the offsets between two cameras that are tried, symmetric around 0."""
    most = int(min(s.most_ticks, s.clip_share * n_ticks)) // s.step_ticks
    return s.step_ticks * np.arange(-most, most + 1)


def search_offsets(seen: Sequence[Viewer], planes: Float64, s: SearchSettings, fine: ClockSettings) -> Float64:
    """Return the offsets of all cameras [C] in ticks, whose mean is 0: multiples of the step but for the mean."""
    offsets = candidates(seen[0].stream.n_ticks, s)
    found = best_offsets(pair_costs(seen, planes, offsets, s, fine))
    ticks = s.step_ticks * found.astype(np.float64)
    return ticks - ticks.mean()


def pair_costs(
    seen: Sequence[Viewer], planes: Float64, offsets: NDArray[np.int64], s: SearchSettings, fine: ClockSettings
) -> Float64:
    """Return the mean cost [C, C, O] of camera c at an offset after camera r, relative to that of all offsets."""
    half, n_ticks, cameras = fine.half_ticks, seen[0].stream.n_ticks, [v.camera for v in seen]
    margin = reach_ticks(fine)
    depths = np.linspace(planes[0], planes[-1], s.depths)
    total = np.zeros((len(seen), len(seen), len(offsets)))
    count = np.zeros_like(total)
    for time in np.linspace(margin, n_ticks - margin, s.times).astype(int):
        stacks = [_images(v, time + offsets, half, s) for v in seen]
        for r, viewer in enumerate(seen):
            m = moment(viewer, float(time), half, s.blur_px)
            if m is None:
                continue
            centers = strongest(np.abs(m.by_time), least_change(viewer, s.blur_px, fine), s.cell_px, s.patches)
            if not len(centers):
                continue
            patches = Patches(np.full(len(centers), r), centers, np.zeros((len(centers), 3)))
            own = m.image[:: s.shrink, :: s.shrink].astype(np.float32)[None]
            here = _look_up(own, rays(cameras, patches, viewer.camera), 0.0, s)[0]
            for c, other in enumerate(seen):
                if c == r:
                    continue
                cost = _costs(stacks[c], here, rays(cameras, patches, other.camera), depths, s)  # [O, P]
                known = np.isfinite(cost)
                mean = np.nanmean(np.where(known.any(axis=0), cost, 0.0), axis=0)
                usable = known & (mean > 0)
                total[r, c] += np.where(usable, cost / np.where(mean > 0, mean, 1.0), 0.0).sum(axis=1)
                count[r, c] += usable.sum(axis=1)
    return np.where(count > 0, total / np.maximum(count, 1), 1.0)


def _images(viewer: Viewer, ticks: NDArray[np.int64], half: int, s: SearchSettings) -> NDArray[np.float32]:
    """Return the camera's images at ticks, shrunk [O, h, w]; NaN where it has none."""
    camera, k = viewer.camera, s.shrink
    out = np.full((len(ticks), -(-camera.height // k), -(-camera.width // k)), np.nan, np.float32)
    for image, tick in zip(out, ticks, strict=True):
        found = window_image(viewer, int(tick), half, s.blur_px)
        if found is not None:
            image[:] = found[::k, ::k]
    return out


def _look_up(images: NDArray[np.float32], lines: Rays, inverse: float, s: SearchSettings) -> NDArray[np.float32]:
    """Return the values [O, P, K] at the pixels nearest to the patches' points at one inverse depth; NaN outside."""
    uv, _ = lines.project(np.full(lines.far.shape[:2], inverse))
    at = np.floor(uv / s.shrink)
    height, width = images.shape[1:]
    inside = np.asarray(((at >= 0) & (at < [width, height])).all(axis=-1))
    x, y = np.where(inside[..., None], at, 0).astype(np.int64).reshape(-1, 2).T
    values = images.reshape(len(images), -1)[:, y * width + x].reshape(-1, *inside.shape)
    return np.where(inside, values, np.float32(np.nan))


def _costs(
    images: NDArray[np.float32], here: NDArray[np.float32], lines: Rays, depths: Float64, s: SearchSettings
) -> Float64:
    """Return the cost [O, P] of patches whose own view shows `here` [P, K], in the images of another camera."""
    best = np.full((len(images), len(here)), np.inf)
    for depth in depths:
        difference = np.abs(_look_up(images, lines, float(depth), s) - here)
        best = np.fmin(best, np.minimum(difference, np.float32(CAP)).mean(axis=-1))
    return np.where(np.isfinite(best), best, np.nan)


def best_offsets(costs: Float64) -> NDArray[np.int64]:
    """Return the offsets [C], in steps, that make the sum of all pairs' costs [C, C, O] least, the first one's 0.

    From each camera as a root, the others start where they fit the root best; then each camera in turn moves to where
    it fits all others best, until none moves. The best of all roots is returned.
    """
    cameras, middle = len(costs), costs.shape[2] // 2
    both = costs + costs.transpose(1, 0, 2)[:, :, ::-1]  # [r, c, offset of c after r]
    found = [_settled(both, both[root].argmin(axis=1) - middle, root) for root in range(cameras)]
    best = min(found, key=lambda offsets: _total(both, offsets))
    return best - best[0]


def _settled(both: Float64, start: NDArray[np.intp], root: int) -> NDArray[np.int64]:
    middle = both.shape[2] // 2
    offsets = start.astype(np.int64)
    offsets[root] = 0
    for _ in range(MOST_ROUNDS):
        before = offsets.copy()
        for c in range(len(offsets)):
            tried = np.arange(-middle, middle + 1) + int(np.median(np.delete(offsets, c)))
            offsets[c] = tried[int(np.argmin(_cost_of(both, offsets, c, tried)))]
        if (offsets == before).all():
            break
    return offsets


def _cost_of(both: Float64, offsets: NDArray[np.int64], c: int, tried: NDArray[np.int64]) -> Float64:
    """Return the costs of a camera at offsets beside all others; a pair too far apart costs as much as any other."""
    middle, others = both.shape[2] // 2, np.delete(np.arange(len(offsets)), c)
    apart = tried[:, None] - offsets[others]
    values = both[others, c, np.clip(apart + middle, 0, 2 * middle)]
    return np.asarray(np.where(np.abs(apart) <= middle, values, FAR_COST).sum(axis=1))


def _total(both: Float64, offsets: NDArray[np.int64]) -> float:
    return sum(float(_cost_of(both, offsets, c, offsets[c : c + 1])[0]) for c in range(len(offsets)))
