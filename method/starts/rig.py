"""The initialisation `rig`: the calibrated poses, and points by plane sweep over the training views.

Static pixels are matched on the mean of the whole clip, where the spikes' quantisation noise has averaged out. Pixels
that change are matched on short windows: all of them at the middle of the clip, where the trainer begins, and at both
ends those that are quiet just then, which is the background that something moving hides in the middle.

With `follow_array` the clip tells whether the array moves (`array_motion`). Where it does, all points are of short
windows, in the frame of the world, with the array's path.

With `flat_field` every image is corrected by its camera's calibrated gain and dark rate, where a scene has them. A
recipe of other sensors has their images in the place of spikes (`clip`).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from spike4dgs.benchmark.arrays import Float32, Mask
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.images.recorded import Recorded
from spike4dgs.method.settings import Settings, check_numbers
from spike4dgs.method.starts.array_motion import find_path, may_move
from spike4dgs.method.starts.base import Start
from spike4dgs.method.starts.clip import Clip, ImageClip, SpikeClip
from spike4dgs.method.starts.plane_sweep import (
    DepthMap,
    SweepSettings,
    agreed,
    find_range,
    inverse_depth_step,
    lift,
    pixels_of,
    sweep_all,
    widest_baseline,
)
from spike4dgs.method.starts.surrounding import looked_at, points_inside
from spike4dgs.method.training_views.pinholes import seen_pixels


@dataclass(frozen=True)
class CloudSettings(Settings):
    """Numbers of thinning and filling a cloud of points (prefix `initialization`)."""

    cell_px: float = 1.6  # one point per cell of this size: about 0.4 points per pixel
    cell_parallax_px: float = 2.0  # a cell's depth, as parallax of the widest pair: about its size
    hole_px: float = 2.0  # from the nearest point: further away it is empty
    neighbours: int = 5  # points that tell the depth where there are none


@dataclass(frozen=True)
class PointSettings(CloudSettings, SweepSettings):
    """Numbers of points by plane sweep (prefix `initialization`)."""

    window_ticks: int = 40  # 2 ms at 20 kHz: a window within which things count as static

    def __post_init__(self) -> None:
        wanted = {
            "window_ticks of 1 or more": (self.window_ticks, self.window_ticks >= 1),
            "neighbours of 2 or more": (self.neighbours, self.neighbours >= 2),
        }
        check_numbers("initialization", wanted)


@dataclass(frozen=True)
class RigSettings(PointSettings):
    """Numbers of `rig` (prefix `initialization`)."""

    flat_field: bool = False  # correct images by each camera's calibration, if known
    follow_array: bool = False  # find whether the array moves, and its path; the trainer fits in the world's frame
    window_noise: float = 4e-4  # variance of the noise of a window's image, where nothing else can be matched


DEFAULTS = RigSettings()


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points [N, 3] in the world and their gray values [N]."""

    points: NDArray[np.float64]
    values: Float32


def rig(scene: TrainingScene, settings: RigSettings = DEFAULTS, recorded: Recorded | None = None) -> Start:
    """Return the calibrated poses and first points of a scene, from `recorded` images where a recipe has some.

    Raises UserError where all cameras have one centre.
    """
    length = settings.window_ticks
    if recorded:
        return swept(scene, settings, ImageClip(scene, recorded, length))
    clip = SpikeClip(scene, length, settings.flat_field)
    return (moving(scene, settings, clip) if settings.follow_array else None) or swept(scene, settings, clip)


def moving(scene: TrainingScene, settings: RigSettings, clip: SpikeClip) -> Start | None:
    """Return the first points in the world through which the array moves, and its path, and say so on stderr.

    They are of the middle window and, where that sees none, of the first and the last. None: the array stands still.
    """
    cameras, middle = scene.cameras, len(clip) // 2
    apart = len(cameras) > 1 and widest_baseline(cameras) > 0 and looked_at(cameras) is None
    if not apart or not may_move(clip.moving()):
        return None
    noisy, images = replace(settings, noise=max(settings.noise, settings.window_noise)), clip.mean(middle)
    planes = find_range(cameras, images, noisy)
    maps = sweep_all(cameras, images, planes, settings=noisy)
    found = find_path(cameras, clip, maps, noisy)
    if not found.believed:
        return None
    share = f"{found.share:.0%} of what tells it from an array that stands still"
    print(f"{scene.id}: the array moves, the image by {found.motion_px:.1f} px: it explains {share}", file=sys.stderr)
    every = [np.ones(image.shape, bool) for image in images]
    seen = seen_pixels(scene) or every
    cloud = thin(cameras, Cloud(*_points(cameras, maps, images, seen, noisy)), noisy)
    for at in sorted({0, len(clip) - 1} - {middle}):
        posed, there = found.path.posed(cameras, clip.time(at)), clip.mean(at)
        points = _points(posed, sweep_all(posed, there, planes, settings=noisy), there, seen, noisy)
        cloud = _joined(cameras, cloud, thin(cameras, Cloud(*points), noisy), noisy)
    return replace(filled(scene, cloud, images, noisy), path=found.path)


def _joined(cameras: Sequence[Camera], cloud: Cloud, more: Cloud, settings: CloudSettings) -> Cloud:
    """Return a cloud and those points of another that are where the middle camera sees none of the first."""
    camera = middle_camera(cameras)
    if not len(cloud.points) or not len(more.points):
        return more if not len(cloud.points) else cloud
    distance, _ = cKDTree(camera.project(cloud.points)[0]).query(camera.project(more.points)[0])
    new = distance > settings.hole_px
    values = np.concatenate([cloud.values, more.values[new]])
    return Cloud(np.concatenate([cloud.points, more.points[new]]), values)


def swept(scene: TrainingScene, settings: PointSettings, clip: Clip) -> Start:
    """Return the same from a clip; for cameras around their subject see `surrounding`."""
    if (ball := looked_at(scene.cameras)) is not None:
        mean = clip.mean()
        points = points_inside(ball, scene.cameras)
        seen = np.stack([look_up(c, m, points) for c, m in zip(scene.cameras, mean, strict=True)])
        known = np.isfinite(seen).any(axis=0)
        values = np.nanmedian(seen[:, known], axis=0)
        return Start(scene.cameras, points[known].astype(np.float32), values.astype(np.float32))
    return filled(scene, *matched(scene, settings, clip), settings)


def matched(scene: TrainingScene, settings: PointSettings, clip: Clip) -> tuple[Cloud, Float32]:
    """Return the points on which views agree, thinned, and the means of the clip [C, H, W]; raises as `rig`."""
    if len(scene.cameras) < 2 or widest_baseline(scene.cameras) == 0:
        found = f"{len(scene.cameras)} at one position"
        raise problem(f"scene {scene.id}", "training cameras apart from each other", found, "use another split")
    mean, moving = clip.mean(), clip.moving()
    planes = find_range(scene.cameras, mean, settings)
    maps = sweep_all(scene.cameras, mean, planes, settings=settings)
    seen = seen_pixels(scene)
    static = [~m & s for m, s in zip(moving, seen, strict=True)] if seen else [~m for m in moving]
    clouds = [_points(scene.cameras, maps, mean, static, settings)]
    middle, last = len(clip) // 2, len(clip) - 1
    for at in sorted({0, middle, last}) if any(m.any() for m in moving) else ():
        images = clip.mean(at)
        quiet = [~m | (at == middle) for m in clip.moving(slice(max(0, at - 1), at + 2))]
        short = sweep_all(scene.cameras, images, planes, moving, settings)
        pixels = [m & q for m, q in zip(moving, quiet, strict=True)]
        clouds.append(_points(scene.cameras, short, images, pixels, settings))
    points, values = (np.concatenate(parts) for parts in zip(*clouds, strict=True))
    return thin(scene.cameras, Cloud(points, values), settings), mean


def filled(scene: TrainingScene, cloud: Cloud, mean: Float32, settings: CloudSettings) -> Start:
    """Return the start from a cloud, filled where the image is empty, with gray of the clip's means [C, H, W]."""
    cloud = fill(scene.cameras, mean, cloud, settings)
    return Start(scene.cameras, cloud.points.astype(np.float32), cloud.values.astype(np.float32))


def _points(
    cameras: Sequence[Camera],
    maps: Sequence[DepthMap],
    images: Float32,
    pixels: Sequence[Mask],
    settings: SweepSettings,
) -> tuple[NDArray[np.float64], Float32]:
    """Return world points [N, 3] and their gray values [N] from the pixels of all views on which views agree."""
    points, values = [], []
    for i, camera in enumerate(cameras):
        chosen = agreed(cameras, maps, i, settings) & pixels[i]
        points.append(lift(camera, maps[i].inverse, chosen))
        values.append(images[i][chosen])
    return np.concatenate(points), np.concatenate(values)


def middle_camera(cameras: Sequence[Camera]) -> Camera:
    """Return a camera between all others, with the rotation nearest to their mean rotation.

    It stands a quarter of the way from their mean centre to the camera nearest to that. In an array whose middle camera
    is held out the mean centre is that camera's, and points thinned on its pixels would suit the image that is scored.
    """
    u, _, vt = np.linalg.svd(np.mean([c.R for c in cameras], axis=0))
    R = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    first = cameras[0]
    centers = np.array([c.center for c in cameras])
    mean = centers.mean(axis=0)
    nearest = centers[np.argmin(np.linalg.norm(centers - mean, axis=1).round(9))]
    center = 0.75 * mean + 0.25 * nearest  # halfway, the fill leaves pixels of other views empty
    return Camera("middle", first.width, first.height, first.fx, first.fy, first.cx, first.cy, R, -R @ center)


def thin(cameras: Sequence[Camera], cloud: Cloud, settings: CloudSettings) -> Cloud:
    """Return one point, the mean, per cell of `cell_px` px and `cell_parallax_px` in the middle camera."""
    keep, cells = cells_of(cameras, cloud.points, settings)
    _, inverse, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    inverse = inverse.reshape(-1)

    def mean(x: NDArray[np.floating]) -> NDArray[np.float64]:
        return np.bincount(inverse, weights=x, minlength=len(count)) / count

    merged = np.stack([mean(axis) for axis in cloud.points[keep].T], axis=-1)
    believed = count >= 2  # seen from one view only: not worth a Gaussian
    return Cloud(merged[believed], mean(cloud.values[keep])[believed].astype(np.float32))


def cells_of(
    cameras: Sequence[Camera], points: NDArray[np.float64], settings: CloudSettings
) -> tuple[Mask, NDArray[np.int64]]:
    """Return which points [N, 3] are in front of the middle camera, and the cells [K, 3] that those lie in."""
    uv, z = middle_camera(cameras).project(points)
    step = inverse_depth_step(cameras, settings.cell_parallax_px)
    keep = z > 0
    cells = np.column_stack([np.floor(uv[keep] / settings.cell_px), np.floor(1 / (z[keep] * step))])
    return keep, cells.astype(np.int64)


def fill(cameras: Sequence[Camera], mean: Float32, cloud: Cloud, settings: CloudSettings) -> Cloud:
    """Return the cloud and points where the middle camera sees none, at the nearest points' median inverse depth.

    Fewer points than that are chance: all of the image is then laid far away.
    """
    camera = middle_camera(cameras)
    uv, z = camera.project(cloud.points)
    # The image's border too: outer views see beyond the middle one.
    margin = 0.1 * np.array([camera.width, camera.height])
    axes = [np.arange(-m, n + m, 2.0) + 1.0 for m, n in zip(margin, (camera.width, camera.height), strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    if len(cloud.points) < settings.neighbours:
        far = 1 / inverse_depth_step(cameras)
        gray = np.full(len(grid), np.maximum(mean, 0).mean(), np.float32)
        return Cloud(camera.unproject(grid, np.full(len(grid), far)), gray)
    distance, nearest = cKDTree(uv).query(grid, k=settings.neighbours)
    empty = distance[:, 0] > settings.hole_px
    depth = 1 / np.median(1 / z[nearest[empty]], axis=1)
    added = camera.unproject(grid[empty], depth)
    seen = np.stack([look_up(c, m, added) for c, m in zip(cameras, mean, strict=True)])
    visible = np.isfinite(seen).any(axis=0)
    added, seen = added[visible], seen[:, visible]
    values = np.concatenate([cloud.values, np.nanmedian(seen, axis=0).astype(np.float32)])
    return Cloud(np.concatenate([cloud.points, added]), values)


def look_up(camera: Camera, image: Float32, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the gray value [N] of the pixel that sees each point; NaN outside the image, and where it is negative."""
    inside, u, v, _ = pixels_of(camera, points)
    return np.where(inside & (image[v, u] >= 0), image[v, u], np.nan)
