"""The initialisations `msdi` and `msdi-uncalibrated`: poses and points by MSDI's network (section 3.3).

The network sees the ticks around the middle of the clip in all training views at once, shrunk to about the size that
it was trained at, and corrected by the cameras' calibrations where a scene has them. It gives the point of every pixel
in view 0's frame, at a scale of its own.

`msdi` keeps the calibrated poses, which are better than any estimate. They tell the scale: a point s X of view v has to
lie on its pixel's ray d, so s d x R X = -d x t with the pose (R, t) relative to view 0; of all pixels that are sure
enough, the median counts, weighted by their parallax. Of a point only its depth is then believed, for the ray is known.

`msdi-uncalibrated` takes each view's pose from its points, by PnP (`method.msdi.pose`), with one focal length for all,
and moves everything to the scene's frame as COLMAP's result is.

Points are thinned and holes filled as in `rig`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from spike4dgs.baselines.rig import fill, thin
from spike4dgs.baselines.spike_to_image.windows import window
from spike4dgs.benchmark.calibration import Calibration
from spike4dgs.benchmark.cameras import Camera
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.poses import align_cameras
from spike4dgs.benchmark.scene import TrainingScene
from spike4dgs.method.fit import Start
from spike4dgs.method.msdi.inputs import Sensors
from spike4dgs.method.msdi.pose import focal_from_points, solve_poses
from spike4dgs.method.msdi.shrink import shrink
from spike4dgs.method.msdi.weights import load_network, weights_path

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

TRAINED_PX = 104  # longer side of the training pictures
LEAST_CONFIDENCE = 0.3  # quantile of a view's confidence below which its points are left out


@dataclass(frozen=True, eq=False)
class Glance:
    """What the network made of V views of h x w pixels."""

    factor: int  # the cameras' pixels are blocks of so many by so many
    cameras: tuple[Camera, ...]  # the training cameras at this size
    pictures: Float32  # [V, h, w] radiance
    points: Float64  # [V, h, w, 3] in view 0's frame, at any scale
    confidence: Float64  # [V, h, w]

    @property
    def sure(self) -> NDArray[np.bool_]:
        """Pixels [V, h, w] whose points are used."""
        least = np.quantile(self.confidence, LEAST_CONFIDENCE, axis=(1, 2), keepdims=True)
        return (self.confidence >= least) & np.isfinite(self.points).all(axis=-1)


def msdi(scene: TrainingScene, seed: int) -> Start:
    """Points by the network, at the calibrated poses; see the module. Nothing is random, `seed` is not used.

    Raises WeightsError where there are no weights, UserError where the points do not fit the rig.
    """
    return at_rig(scene, look(scene))


def msdi_uncalibrated(scene: TrainingScene, seed: int) -> Start:
    """Poses, intrinsics and points by the network; raises as `msdi`, and where a view gets no pose."""
    return unposed(scene, look(scene), seed)


def look(scene: TrainingScene) -> Glance:
    """What the network in use makes of the middle of the clip; raises as `msdi`."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    network = load_network(weights_path(), device)
    factor = max(1, round(max(scene.cameras[0].width, scene.cameras[0].height) / TRAINED_PX))
    spikes = np.stack([window(stream, scene.n_ticks // 2, network.config.ticks) for stream in scene.streams])
    small = shrink(torch.from_numpy(spikes), factor)[None]
    cameras = tuple(shrunk(camera, factor) for camera in scene.cameras)
    K = torch.from_numpy(np.stack([c.K for c in cameras])[None].astype(np.float32))
    sensors, gain = None, scene.radiance_gain
    if calibrations := scene.calibrations:
        sensors = block_means(calibrations, factor, device)
        gain = float(np.mean([c.radiance_gain for c in calibrations]))
    with torch.inference_mode():
        found = network(small.to(device), K.to(device), sensors)
    pictures = found.images[0].clamp(min=0).cpu().numpy() / np.float32(gain)
    points, confidence = (x[0].double().cpu().numpy() for x in (found.points, found.confidence))
    return Glance(factor, cameras, pictures, points, confidence)


def shrunk(camera: Camera, factor: int) -> Camera:
    """The view of a sensor whose pixels are blocks of `factor` x `factor`, sides rounded up."""
    width, height = -(-camera.width // factor), -(-camera.height // factor)
    fx, fy, cx, cy = (x / factor for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    return replace(camera, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def block_means(calibrations: Sequence[Calibration], factor: int, device: str) -> Sensors:
    """The maps [1, V, h, w] of sensors with larger pixels."""

    def small(maps: list[Float32]) -> torch.Tensor:
        whole = torch.from_numpy(np.stack(maps)).to(device)[None]
        return functional.avg_pool2d(whole, factor, ceil_mode=True, count_include_pad=False)

    return Sensors(small([c.gain for c in calibrations]), small([c.dark for c in calibrations]))


def at_rig(scene: TrainingScene, glance: Glance) -> Start:
    """First points at the scene's own cameras. Raises UserError where no positive scale fits."""
    scale = rig_scale(glance)
    if not scale > 0:
        fix = "use rig, or other weights"
        raise problem(f"MSDI on {scene.id}", "points that fit the rig at some scale", f"{scale:.3g}", fix)
    points, values = [], []
    first = glance.cameras[0].w2c
    for camera, own, sure, picture in zip(glance.cameras, glance.points, glance.sure, glance.pictures, strict=True):
        relative = camera.w2c @ np.linalg.inv(first)
        depth = (scale * own @ relative[:3, :3].T + relative[:3, 3])[..., 2]
        v, u = np.nonzero(sure & (depth > 0))
        points.append(camera.unproject(np.stack([u + 0.5, v + 0.5], axis=-1), depth[v, u]))
        values.append(picture[v, u])
    return _start(scene.cameras, np.concatenate(points), np.concatenate(values), glance)


def rig_scale(glance: Glance) -> float:
    """Metres to a unit of the network's points; NaN where no view tells."""
    first, ratios, weights = glance.cameras[0].w2c, [], []
    for camera, own, sure in zip(glance.cameras[1:], glance.points[1:], glance.sure[1:], strict=True):
        relative = camera.w2c @ np.linalg.inv(first)
        v, u = np.nonzero(sure)
        rays = np.stack([(u + 0.5 - camera.cx) / camera.fx, (v + 0.5 - camera.cy) / camera.fy, np.ones(len(u))], -1)
        across = np.cross(rays, own[v, u] @ relative[:3, :3].T)
        shift = -np.cross(rays, relative[:3, 3])
        square = (across**2).sum(-1)
        seen = square > 0
        ratios.append((across * shift).sum(-1)[seen] / square[seen])
        weights.append(np.linalg.norm(shift[seen], axis=-1))
    ratio, weight = np.concatenate(ratios), np.concatenate(weights)
    if not weight.sum() > 0:
        return float("nan")
    order = np.argsort(ratio)
    total = np.cumsum(weight[order])
    return float(ratio[order][np.searchsorted(total, total[-1] / 2)])


def unposed(scene: TrainingScene, glance: Glance, seed: int) -> Start:
    """Poses by PnP, and points, in the scene's frame. Raises UserError where a view has no pose."""
    first, f = scene.cameras[0], glance.factor
    middle = first.width / 2, first.height / 2
    v, u = np.nonzero(glance.sure[0])
    offsets = np.stack([u + 0.5, v + 0.5], axis=-1) - np.divide(middle, f)
    focal = focal_from_points(glance.points[0, v, u], offsets)
    if focal is None:
        fix = "use rig or colmap"
        raise problem(f"MSDI on {scene.id}", "points that give a focal length", "none before the camera", fix)
    K = np.array([[focal, 0, middle[0] / f], [0, focal, middle[1] / f], [0, 0, 1]])
    poses = solve_poses(glance.points, glance.confidence, np.tile(K, (len(scene.cameras), 1, 1)), seed)
    if bad := [f"{c.id} ({p.reason})" for c, p in zip(glance.cameras, poses, strict=True) if not p.found]:
        fix = "use rig or colmap"
        raise problem(f"MSDI on {scene.id}", "a pose for each view", f"none for {', '.join(bad)}", fix)
    placed = []
    for camera, pose in zip(scene.cameras, poses, strict=True):
        assert pose.w2c is not None
        at = replace(camera, R=pose.w2c[:3, :3], t=pose.w2c[:3, 3])
        placed.append(replace(at, fx=focal * f, fy=focal * f, cx=middle[0], cy=middle[1]))
    move = align_cameras(placed, scene.cameras)
    cameras = tuple(move.camera(c) for c in placed)
    return _start(cameras, move(glance.points[glance.sure]), glance.pictures[glance.sure], glance)


def _start(cameras: tuple[Camera, ...], points: Float64, values: Float32, glance: Glance) -> Start:
    points, values = thin(cameras, points, values)
    pictures = glance.pictures.repeat(glance.factor, axis=1).repeat(glance.factor, axis=2)
    pictures = pictures[:, : cameras[0].height, : cameras[0].width]
    points, values = fill(cameras, pictures, points, values)
    return Start(cameras, points.astype(np.float32), values.astype(np.float32))
