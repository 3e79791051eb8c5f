"""The motion of the array, from the clip: one rigid motion that explains what all cameras see of a world at rest.

The windows of the clip are compared with its middle one. There every view's depths come from the plane sweep, so a path
(`array_path`) says where each of its pixels is in any other window. The path is fitted for which the pixels keep their
values, all cameras and windows together, by Gauss-Newton with Geman and McClure's weights: things that move by
themselves are explained by no path and lose theirs. Windows are added outwards from the middle, where the path so far
foretells them.

A path is believed where it explains most of what changes as far as noise goes, and moves the image by more than a part
of a pixel. Else the array stands still. (What falls or flies together follows a path too, but not to the noise.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from spike4dgs.benchmark.arrays import Float32, Float64, Mask
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.array_path import DEGREE, ArrayPath
from spike4dgs.method.starts.clip import SpikeClip
from spike4dgs.method.starts.plane_sweep import DepthMap, SweepSettings, agreed, lift

LEAST_CHANGING = 0.25  # share of a view's pixels that change, median of the views: below it the array stands still
# Share by a path of the pixels that only it or only an array that stands still explains. Development scenes and toy
# worlds: up to 0.63 where the array stands still, from 0.85 where the image moves by 1.3 px or more.
LEAST_EXPLAINED = 0.75
LEAST_PX = 1.0  # motion of a still point between the clip's ends, median: what moves by itself can feign half a pixel
MOST_WINDOWS = 15  # that are compared; of longer clips some are left out
_MOST_PIXELS = 8000  # of a view, evenly chosen
_BLURS_PX = (3.0, 1.5)  # of the images, to find the first step and then; what is left of fixed patterns pulls at less
_STEPS, _LAST_STEPS = 4, 10  # of Gauss-Newton
_QUARTER_IN_DEVIATIONS = 0.3186  # a quarter of normal errors is smaller
_LONG_WINDOWS = 15  # a clip of more is long enough for a third power of time


@dataclass(frozen=True, eq=False)
class Explained:
    """A path, and what it explains."""

    path: ArrayPath
    share: float  # of the pixels that only it or only an array that stands still explains
    motion_px: float  # between the clip's ends, median of the still points

    @property
    def believed(self) -> bool:
        """Whether the array moves."""
        return self.share >= LEAST_EXPLAINED and self.motion_px >= LEAST_PX


def may_move(moving: Sequence[Mask]) -> bool:
    """Return whether so much changes in the views [H, W] that the array may move."""
    return float(np.median([mask.mean() for mask in moving])) >= LEAST_CHANGING


def find_path(
    cameras: Sequence[Camera], clip: SpikeClip, maps: Sequence[DepthMap], settings: SweepSettings
) -> Explained:
    """Return the path of the array that explains a clip best; `maps` are the depths of its middle window."""
    return _Search(cameras, clip, maps, settings).found()


class _Search:
    """The pixels of the middle window, the other windows, and the path so far."""

    def __init__(
        self, cameras: Sequence[Camera], clip: SpikeClip, maps: Sequence[DepthMap], settings: SweepSettings
    ) -> None:
        self.cameras, self.clip, self.middle = cameras, clip, len(clip) // 2
        count = min(len(clip), MOST_WINDOWS)
        chosen = {self.middle, *np.rint(np.linspace(0, len(clip) - 1, count)).astype(int).tolist()}
        self.others = sorted(chosen - {self.middle}, key=lambda w: (abs(w - self.middle), w))
        self.images: dict[tuple[int, float], list[Float32]] = {}
        self.points, self.pixels = [], []
        for index, camera in enumerate(cameras):
            known = agreed(cameras, maps, index, settings)
            every = np.flatnonzero(known)
            mask = np.zeros(known.shape, bool)
            mask.ravel()[every[:: max(1, round(len(every) / _MOST_PIXELS))]] = True
            self.points.append(lift(camera, maps[index].inverse, mask))
            self.pixels.append(mask)
        pivot = np.mean([c.center for c in cameras], axis=0)
        self.path = ArrayPath(np.zeros((DEGREE, 6)), pivot, self.clip.time(self.middle))

    def found(self) -> Explained:
        """Return the path that was found."""
        most = DEGREE if len(self.clip) > _LONG_WINDOWS else DEGREE - 1
        reaches = sorted({abs(w - self.middle) for w in self.others})
        for number, reach in enumerate(reaches):
            near = [w for w in self.others if abs(w - self.middle) <= reach]
            for blur in _BLURS_PX if number == 0 else _BLURS_PX[1:]:
                self._improve(near, min(most, 1 + number // 2), blur, _STEPS)
        self._improve(self.others, min(most, max(1, len(self.others))), _BLURS_PX[1], _LAST_STEPS)
        return Explained(self.path, *self._judged())

    def _blurred(self, window: int, blur: float) -> list[Float32]:
        """Return each view's blurred image and its slopes [H, W, 3] to the right and down; NaN near what is unseen."""
        if (window, blur) not in self.images:
            self.images[window, blur] = [_with_slopes(image, blur) for image in self.clip.mean(window)]
        return self.images[window, blur]

    def _improve(self, windows: Sequence[int], degree: int, blur: float, steps: int) -> None:
        """Take some steps of Gauss-Newton with these windows."""
        for _ in range(steps):
            normal, right = np.zeros((DEGREE, 6, DEGREE, 6)), np.zeros((DEGREE, 6))
            for window in windows:
                powers = self.path.powers(self.clip.time(window))
                hessian, gradient = self._equations(window, blur)
                normal += np.einsum("k,l,ab->kalb", powers, powers, hessian)
                right += np.outer(powers, gradient)
            n = 6 * degree
            some = normal.reshape(6 * DEGREE, -1)[:n, :n]
            scale = np.sqrt(np.diag(some) + 1e-30)  # metres and radians, and powers of a small number
            step = np.linalg.solve(some / np.outer(scale, scale) + 1e-9 * np.eye(n), right.ravel()[:n] / scale) / scale
            change = np.zeros(6 * DEGREE)
            change[:n] = step
            self.path = replace(self.path, coefficients=self.path.coefficients - change.reshape(DEGREE, 6))

    def _equations(self, window: int, blur: float) -> tuple[Float64, Float64]:
        """Return the sums [6, 6] and [6] of a window, by the pose's turn and shift."""
        pose = self.path.to_array(self.clip.time(window))
        origin = pose[:3, :3] @ self.path.pivot + pose[:3, 3]  # about which a turn is, as it is now
        rows, errors = [], []
        for index, camera in enumerate(self.cameras):
            points = self.points[index] @ pose[:3, :3].T + pose[:3, 3]
            error, slopes = self._errors(index, window, blur, points)
            in_camera = points @ camera.R.T + camera.t
            z = in_camera[:, 2]
            x, y = in_camera[:, 0] / z, in_camera[:, 1] / z
            across, down = slopes[:, 0] * camera.fx / z, slopes[:, 1] * camera.fy / z
            to_point = np.stack([across, down, -(across * x + down * y)], axis=1) @ camera.R  # d error / d point
            row = np.concatenate([np.cross(points - origin, to_point), to_point], axis=1)
            known = np.isfinite(error) & np.isfinite(row).all(axis=1)
            rows.append(row[known])
            errors.append(error[known])
        row, error = np.concatenate(rows), np.concatenate(errors)
        weight = 1 / np.square(1 + np.square(error / deviation(error)))
        weighted = row * weight[:, None]
        return weighted.T @ row, weighted.T @ error

    def _errors(self, index: int, window: int, blur: float, points: Float64) -> tuple[Float64, Float64]:
        """Return how values [N] of a view's points [N, 3] in a window differ, and the image's slopes [N, 2] there."""
        uv, _ = self.cameras[index].project(points)
        found = _sampled(self._blurred(window, blur)[index], uv)
        before = self._blurred(self.middle, blur)[index][self.pixels[index]][:, 0]
        return found[:, 0] - before, found[:, 1:]

    def _judged(self) -> tuple[float, float]:
        """Return the share of what changes that the path explains, and the motion between the clip's ends, px."""
        votes = np.zeros(2, np.int64)  # for the path, for an array that stands still
        for window in self.others:
            pose = self.path.to_array(self.clip.time(window))
            for index, points in enumerate(self.points):
                still = self._errors(index, window, _BLURS_PX[1], points)[0]
                moved = self._errors(index, window, _BLURS_PX[1], points @ pose[:3, :3].T + pose[:3, 3])[0]
                known = np.isfinite(still) & np.isfinite(moved)
                limit = min(_noise(still[known]), _noise(moved[known]))
                by_still, by_path = (np.abs(errors[known]) < limit for errors in (still, moved))
                votes += np.count_nonzero(by_path & ~by_still), np.count_nonzero(by_still & ~by_path)
        ends = [self.path.posed(self.cameras, t) for t in (0.0, 1.0)]
        motions = [
            np.linalg.norm(a.project(points)[0] - b.project(points)[0], axis=1)
            for a, b, points in zip(*ends, self.points, strict=True)
        ]
        together = np.concatenate(motions)
        return float(votes[0] / max(votes.sum(), 1)), float(np.median(together)) if len(together) else 0.0


def _with_slopes(image: Float32, blur: float) -> Float32:
    """Return an image [H, W], blurred, and its slopes: [H, W, 3]; NaN near pixels that are not seen."""
    smooth = cv2.GaussianBlur(image, (0, 0), blur)
    hidden = (image < 0).astype(np.uint8)
    if hidden.any():
        side = 2 * int(np.ceil(3 * blur)) + 1
        smooth[cv2.dilate(hidden, np.ones((side, side), np.uint8)) > 0] = np.nan
    down, across = np.gradient(smooth)
    return np.stack([smooth, across, down], axis=-1)


def _sampled(image: Float32, uv: Float64) -> Float64:
    """Return the values [N, F] of an image [H, W, F] at pixel coordinates [N, 2]; NaN outside."""
    if not len(uv):  # of a view on whose depths no other agrees; OpenCV takes no empty map
        return np.empty((0, image.shape[-1]))
    across, down = (uv - 0.5).astype(np.float32).T[..., None]
    nothing = (np.nan,) * 4
    found = cv2.remap(image, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=nothing)
    return np.asarray(found[:, 0], np.float64)


def _noise(values: Float64) -> float:
    """Return the standard deviation of noise by the smallest quarter of errors, which even much motion leaves."""
    quarter = float(np.quantile(np.abs(values), 0.25)) if len(values) else 0.0
    return max(quarter / _QUARTER_IN_DEVIATIONS, 1e-6)


def deviation(values: Float64) -> float:
    """Return the standard deviation of most values, by the median of their sizes."""
    return max(1.4826 * float(np.median(np.abs(values))) if len(values) else 0.0, 1e-6)
