"""Pinholes in the place of cameras whose lenses distort.

Gaussians are rendered through the lens itself, and a fit compares them with the pixels of the streams. What only knows
straight lines sees pinholes: the first points and poses of a fit, and clocks. `as_pinholes` exchanges a scene's
cameras, and everything that is made from their streams goes through the lens (`undistorted`, `nearest_pixels`). A
pinhole has its camera's pose, focal lengths and distance between pixels; its image is larger, so that the camera's
whole field of view is in it, and NaN where the camera sees nothing. `with_lenses` gives the cameras back.

`through_lens` lets another's model, which knows pinholes alone, render any camera.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache, wraps
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.scene.cameras import Camera, border, check_lens
from spike4dgs.benchmark.scene.lens import Distortion, distort, inside, nearest, resample, undistort
from spike4dgs.benchmark.scene.scene import TrainingScene

M = TypeVar("M")
Pair = tuple[float, float]
_MARGIN_PX = 2  # around the camera's field of view: cubic interpolation reaches so far


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera, the pinhole in its place, and where each sees the pixels of the other."""

    camera: Camera
    pinhole: Camera
    to_camera: Float64  # [h, w, 2] px of the camera that the pinhole's pixels see; NaN: beyond the lens
    to_pinhole: Float64  # [H, W, 2] px of the pinhole that the camera's pixels see

    @property
    def seen(self) -> NDArray[np.bool_]:
        """The pinhole's pixels that the camera sees [h, w]."""
        return inside(self.to_camera, self.camera.width, self.camera.height)


@dataclass(frozen=True, eq=False)
class PinholeScene(TrainingScene):
    """A scene whose `cameras` are pinholes; its streams and recordings are those of the lenses' cameras."""

    lenses: tuple[Lens, ...] = ()  # of the cameras, in their order


def make_lenses(cameras: Sequence[Camera]) -> tuple[Lens, ...]:
    """Return the lenses of cameras, their pinholes of one size and one margin.

    Raises UserError for a lens whose model does not hold up to the image's corners.
    """
    for camera in cameras:
        check_lens(camera, "lens distortion")
    bounds = np.array([_bounds(camera) for camera in cameras])
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    left, top, right, bottom = (int(v) for v in (*low, *high))
    corner, size = (left, top), (right - left, bottom - top)
    lenses = []
    for c in cameras:
        maps = _maps((c.width, c.height), (c.fx, c.fy), (c.cx, c.cy), c.distortion, corner, size)
        pinhole = replace(c, width=size[0], height=size[1], cx=c.cx - left, cy=c.cy - top, distortion=())
        lenses.append(Lens(c, pinhole, *maps))
    return tuple(lenses)


def _bounds(camera: Camera) -> Float64:
    """Return left, top and right, bottom [2, 2] of the camera's field of view in its pinhole, px, with a margin."""
    seen = camera.normalized(border(camera)) * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    return np.stack([np.floor(seen.min(axis=0)) - _MARGIN_PX, np.ceil(seen.max(axis=0)) + _MARGIN_PX])


@lru_cache(maxsize=64)  # a model renders one camera many times
def _maps(
    size: Pair, focal: Pair, principal: Pair, lens: Distortion, corner: Pair, pinhole_size: Pair
) -> tuple[Float64, Float64]:
    """Return `Lens.to_camera` and `Lens.to_pinhole` of a pinhole that begins at the `corner` px of the camera's."""
    f, c = np.array(focal), np.array(principal)
    there = (_centers(pinhole_size) + corner - c) / f
    here = (_centers(size) - c) / f
    if not lens:
        return there * f + c, here * f + c - corner
    return distort(there, lens) * f + c, undistort(here, lens) * f + c - corner


def _centers(size: Pair) -> Float64:
    """Return the centres [height, width, 2] of pixels."""
    v, u = np.mgrid[: size[1], : size[0]] + 0.5
    return np.stack([u, v], axis=-1)


def as_pinholes(scene: TrainingScene) -> TrainingScene:
    """Return a scene whose cameras are pinholes: `scene` itself where no lens distorts."""
    if not any(c.distortion for c in scene.cameras):
        return scene
    lenses = make_lenses(scene.cameras)
    parts: dict[str, Any] = {f.name: getattr(scene, f.name) for f in fields(TrainingScene)}
    return PinholeScene(**{**parts, "cameras": tuple(lens.pinhole for lens in lenses)}, lenses=lenses)


def lenses_of(scene: TrainingScene) -> tuple[Lens, ...]:
    """Return the lenses of a scene, none where its cameras are those of its streams."""
    return scene.lenses if isinstance(scene, PinholeScene) else ()


def undistorted(scene: TrainingScene, images: Float32) -> Float32:
    """Return images [..., C, h, w] of the pinholes from those of the streams' cameras [..., C, H, W].

    Pixels that a camera does not see repeat the image's border.
    """
    lenses = lenses_of(scene)
    if not lenses:
        return images
    height, width = lenses[0].pinhole.height, lenses[0].pinhole.width
    flat = images.reshape(-1, *images.shape[-3:])
    out = np.empty((*flat.shape[:2], height, width), np.float32)
    for c, lens in enumerate(lenses):
        for k, image in enumerate(flat[:, c]):
            out[k, c] = resample(image, lens.to_camera)
    return out.reshape(*images.shape[:-2], height, width)


def nearest_pixels(scene: TrainingScene, arrays: Sequence[NDArray[Any]]) -> list[NDArray[Any]]:
    """Return for each view an array [..., h, w] of the pinhole from that of the stream's camera [..., H, W].

    Each value is that of the nearest pixel: for spikes, masks and maps, which must not be interpolated.
    """
    lenses = lenses_of(scene)
    return [nearest(a, lens.to_camera) for a, lens in zip(arrays, lenses, strict=True)] if lenses else list(arrays)


def seen_pixels(scene: TrainingScene) -> list[NDArray[np.bool_]] | None:
    """Return the pixels [h, w] of each view that its camera sees; None where it sees all."""
    return [lens.seen for lens in lenses_of(scene)] or None


def with_lenses(scene: TrainingScene, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """Return the cameras that took the streams, with the poses and intrinsics that a fit gave to their pinholes."""
    lenses = lenses_of(scene)
    if not lenses:
        return tuple(cameras)
    return tuple(
        replace(
            lens.camera,
            fx=c.fx,
            fy=c.fy,
            cx=c.cx + lens.camera.cx - lens.pinhole.cx,
            cy=c.cy + lens.camera.cy - lens.pinhole.cy,
            R=c.R,
            t=c.t,
        )
        for c, lens in zip(cameras, lenses, strict=True)
    )


def through_lens(render: Callable[[M, Camera, float], Float32]) -> Callable[[M, Camera, float], Float32]:
    """Let a model's `render(self, camera, t_us)`, which knows pinholes alone, render cameras with lens distortion."""

    @wraps(render)
    def any_camera(model: M, camera: Camera, t_us: float) -> Float32:
        if not camera.distortion:
            return render(model, camera, t_us)
        (lens,) = make_lenses([camera])
        return resample(render(model, lens.pinhole, t_us), lens.to_pinhole)

    return any_camera
