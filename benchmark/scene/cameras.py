"""Cameras. Inside: OpenCV world-to-camera. At the edge: nerfstudio, COLMAP and Mitsuba conventions.

| convention | pose | camera axes | pixel centres |
|---|---|---|---|
| ours, OpenCV, COLMAP | world to camera | +x right, +y down, +z forward | +0.5 |
| nerfstudio / Blender / OpenGL | camera to world | +x right, +y up, -z forward | +0.5 |
| Mitsuba `perspective` | camera to world | +x left, +y up, +z forward | +0.5 |
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_json
from spike4dgs.benchmark.scene.lens import NAMES, Distortion, distort, make_distortion, undistort
from spike4dgs.benchmark.untrusted import MAX_LENGTH, MAX_SIDE, check_ids, number, positive, shown, whole

_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # flips y and z between OpenCV and OpenGL camera axes
_GRID = 33  # points each way, corners included, at which distortion is measured
_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])  # flips x and y between OpenCV and Mitsuba camera axes


@dataclass(frozen=True, eq=False)
class Camera:
    """A calibrated camera: x_cam = R x_world + t (OpenCV axes), pixel centres at +0.5.

    R is [3, 3], t is [3], float64, metres. fx, fy, cx, cy are in pixels; cx = width / 2 is the middle. `distortion`
    holds OpenCV's k1, k2, p1, p2, k3; it is empty for a pinhole.
    """

    id: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    R: Float64
    t: Float64
    distortion: Distortion = ()

    @property
    def K(self) -> Float64:
        """Intrinsic matrix [3, 3]."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def w2c(self) -> Float64:
        """World-to-camera matrix [4, 4]."""
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = self.R, self.t
        return m

    @property
    def c2w(self) -> Float64:
        """Camera-to-world matrix [4, 4], OpenCV axes."""
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = self.R.T, self.center
        return m

    @property
    def center(self) -> Float64:
        """Centre of projection [3] in world coordinates."""
        return -self.R.T @ self.t

    def project(self, points: Float64) -> tuple[Float64, Float64]:
        """Return pixel coordinates [N, 2] and depths z [N] of world points [N, 3] (z <= 0 is behind the camera).

        Coordinates are NaN where the lens shows no such point.
        """
        p = np.asarray(points, dtype=np.float64) @ self.R.T + self.t
        z = p[:, 2]
        if self.distortion:
            return distort(p[:, :2] / z[:, None], self.distortion) * (self.fx, self.fy) + (self.cx, self.cy), z
        return np.stack([self.fx * p[:, 0] / z + self.cx, self.fy * p[:, 1] / z + self.cy], axis=-1), z

    def unproject(self, uv: Float64, z: Float64) -> Float64:
        """Return the world points [N, 3] of pixel coordinates [N, 2] and depths z [N]."""
        xy = self.normalized(uv)
        p = np.stack([xy[:, 0] * z, xy[:, 1] * z, z], axis=-1)
        return (p - self.t) @ self.R

    def normalized(self, uv: Float64) -> Float64:
        """Return where the rays of pixel coordinates [..., 2] cross the plane z = 1 of the camera's frame: x, y.

        NaN where the lens has no such ray.
        """
        xy = np.stack([(uv[..., 0] - self.cx) / self.fx, (uv[..., 1] - self.cy) / self.fy], axis=-1)
        return undistort(xy, self.distortion) if self.distortion else xy

    def scaled(self, width: int, height: int) -> Camera:
        """Return the same view in `width` x `height` pixels, which need not be square."""
        x, y = width / self.width, height / self.height
        fx, fy, cx, cy = self.fx * x, self.fy * y, self.cx * x, self.cy * y
        return replace(self, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def look_at(id: str, origin: Float64, target: Float64, up: Float64, *, focal: float, width: int, height: int) -> Camera:
    """Return a camera at `origin` that looks at `target`, square pixels, principal point in the middle."""
    forward = np.asarray(target, dtype=np.float64) - origin
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    return Camera(id, width, height, focal, focal, width / 2, height / 2, R, -R @ np.asarray(origin, dtype=np.float64))


def array_axes(cameras: Sequence[Camera]) -> Float64:
    """Return the directions right, forward and up [3, 3] of an array, the means of its cameras'."""
    u, _, vt = np.linalg.svd(np.sum([c.R for c in cameras], axis=0))
    right, down, forward = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return np.stack([right, forward, -down])


def to_nerfstudio(camera: Camera) -> dict[str, Any]:
    """Return per-frame nerfstudio keys (fl_x ... transform_matrix), OpenGL camera-to-world; k1 ... of a lens."""
    return {
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
        **dict(zip(NAMES, camera.distortion, strict=False)),
        "transform_matrix": (camera.c2w @ _OPENGL).tolist(),
    }


def from_nerfstudio(id: str, frame: Mapping[str, Any], where: str = "transforms") -> Camera:
    """Return the camera of per-frame nerfstudio keys.

    Raises UserError for an id that no file can have, for missing keys, for numbers out of bounds and for non-rigid
    poses.
    """
    check_ids([id], "camera", where)
    try:
        m = np.array([_numbers(row, 4) for row in _listed(frame["transform_matrix"], 4)]) @ _OPENGL
        fx, fy = (positive(frame[k], MAX_LENGTH) for k in ("fl_x", "fl_y"))
        cx, cy = _numbers([frame[k] for k in ("cx", "cy")], 2)
        width, height = (whole(frame[k], 1, MAX_SIDE) for k in ("w", "h"))
        lens = make_distortion(_numbers([frame.get(name, 0.0) for name in NAMES], len(NAMES)))
    except (KeyError, TypeError, ValueError) as e:
        keys = "fl_x, fl_y, cx, cy, w, h and a 4x4 transform_matrix"
        raise problem(where, f"{keys} for camera {id}", repr(e), "write the scene again") from None
    check_rotation(m[:3, :3], f"{where}, camera {id}")
    R = m[:3, :3].T
    camera = Camera(id, width, height, fx, fy, cx, cy, R, -R @ m[:3, 3], lens)
    check_lens(camera, where)
    return camera


def _listed(values: Any, count: int) -> list[Any]:
    if not isinstance(values, list) or len(values) != count:
        raise ValueError(f"{shown(values)} is no list of {count}")
    return values


def _numbers(values: Any, count: int) -> list[float]:
    return [number(value, -MAX_LENGTH, MAX_LENGTH) for value in _listed(values, count)]


def border(camera: Camera) -> Float64:
    """Return points [N, 2] px around the image, its corners among them, a pixel or less apart."""
    across, down = np.linspace(0, camera.width, camera.width + 1), np.linspace(0, camera.height, camera.height + 1)
    rows = [np.stack([across, np.full_like(across, y)], axis=-1) for y in (0, camera.height)]
    columns = [np.stack([np.full_like(down, x), down], axis=-1) for x in (0, camera.width)]
    return np.concatenate(rows + columns)


def distortion_px(camera: Camera, other_lens: Callable[[Float64], Float64] | None = None) -> float:
    """Return the farthest that the lens moves a point of the pinhole's image, in pixels; infinite beyond its fold.

    `other_lens` takes normalised coordinates [N, 2] of the pinhole to the lens's, in place of the camera's own.
    """
    if not (camera.distortion or other_lens):
        return 0.0
    across, down = np.linspace(0, camera.width, _GRID), np.linspace(0, camera.height, _GRID)
    uv = np.stack(np.meshgrid(across, down), axis=-1).reshape(-1, 2)
    focal = np.array([camera.fx, camera.fy])
    xy = (uv - (camera.cx, camera.cy)) / focal
    bent = other_lens(xy) if other_lens else distort(xy, camera.distortion)
    moved = np.linalg.norm((bent - xy) * focal, axis=1)
    return float(moved.max()) if np.isfinite(moved).all() else float("inf")


def check_lens(camera: Camera, where: str | Path, fix: str = "calibrate with fewer coefficients") -> None:
    """Raise UserError unless the lens's model gives a ray for every pixel."""
    if camera.distortion and not np.isfinite(camera.normalized(border(camera))).all():
        values = ", ".join(f"{name} {value:g}" for name, value in zip(NAMES, camera.distortion, strict=True))
        expected = f"a lens of {camera.id} whose model holds up to the image's corners"
        raise problem(where, expected, values, fix)


def check_rotation(R: Float64, where: str) -> None:
    """Raise UserError unless R [3, 3] is a proper rotation to 1e-6."""
    error = float(np.abs(R @ R.T - np.eye(3)).max()) if np.isfinite(R).all() else float("inf")
    if error > 1e-6 or np.linalg.det(R) < 0:
        found = f"a matrix off by {error:.1e}, determinant {np.linalg.det(R) if error < 1e9 else 'undefined'}"
        raise problem(where, "a rotation matrix", found, "check the pose's convention (scene.json says which is used)")


def mitsuba_to_world(camera: Camera) -> Float64:
    """Return the `to_world` matrix [4, 4] of Mitsuba's `perspective` sensor for this pose."""
    return np.asarray(camera.c2w @ _MITSUBA)


def mitsuba_sensor(camera: Camera) -> dict[str, Any]:
    """Return the intrinsics of Mitsuba's `perspective` sensor (fov along x in degrees, principal point offsets).

    Mitsuba's offsets are relative to the film size and count opposite to ours: cx = W (0.5 - offset_x).
    Raises UserError for non-square pixels and lens distortion, which the sensor cannot model.
    """
    if camera.distortion:
        fix = "render with Mitsuba's LLVM or CUDA variant, see `spike4dgs doctor`"
        raise problem(f"camera {camera.id}", "a pinhole for Mitsuba's sensor", "lens distortion", fix)
    if abs(camera.fx - camera.fy) > 1e-9 * camera.fx:
        found = f"{camera.fx} and {camera.fy}"
        raise problem(f"camera {camera.id}", "fx = fy", found, "use square pixels for rendering")
    return {
        "fov_axis": "x",
        "fov": float(np.degrees(2 * np.arctan(0.5 * camera.width / camera.fx))),
        "principal_point_offset_x": 0.5 - camera.cx / camera.width,
        "principal_point_offset_y": 0.5 - camera.cy / camera.height,
    }


def read_cameras(root: Path) -> dict[str, Camera]:
    """Read the cameras of a scene folder by id, from transforms_train.json and transforms_test.json.

    Raises UserError where a file is missing or damaged.
    """
    cameras: dict[str, Camera] = {}
    for path, frame in _frames(root):
        camera = from_nerfstudio(str(frame.get("camera")), frame, str(path))
        cameras.setdefault(camera.id, camera)
    return cameras


def camera_facts(root: Path) -> dict[str, dict[str, Any]]:
    """Return the numbers that `read_cameras` reads, by camera, as the files have them: without a last bit of rounding.

    The folder is one that `read_cameras` has read.
    """
    facts: dict[str, dict[str, Any]] = {}
    for _, frame in _frames(root):
        numbers: dict[str, Any] = {name: float(frame[name]) for name in ("fl_x", "fl_y", "cx", "cy")}
        numbers |= {"w": int(frame["w"]), "h": int(frame["h"])}
        lens = make_distortion([float(frame.get(name, 0.0)) for name in NAMES])
        pose = [[float(v) for v in row] for row in frame["transform_matrix"][:3]]
        facts.setdefault(str(frame.get("camera")), {**numbers, "lens": list(lens), "pose": pose})
    return facts


def _frames(root: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    for name in ("transforms_train.json", "transforms_test.json"):
        frames = read_json(root / name, "camera poses").get("frames")
        if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
            raise problem(root / name, "a list `frames` of objects", "none", "make or import the scene again")
        yield from ((root / name, frame) for frame in frames)
