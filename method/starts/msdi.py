"""The initialisation `msdi`: points by MSDI's network (section 3.3).

The network sees the ticks around the middle of the clip in all training views at once, shrunk to about the size that it
was trained at, and corrected by the cameras' calibrations where a scene has them. It gives the point of every pixel in
view 0's frame, at a scale of its own.

Poses are the calibrated ones, which are better than any estimate. From known poses, matches of the views are measured
better than a network guesses them: those are the points of `rig` with `flat_field`. Where nothing matches, for lack of
texture, the network's points replace the nearest depth: those of view 0, as inverse depths that a line brings to the
matched ones. Cameras around their subject start as `rig` does there, without the network.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch.nn import functional

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.scene.camera_state import local_ticks
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.counted_recording import total_counts
from spike4dgs.benchmark.spikes.sensor_model import fired, gathered
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.images.base import window
from spike4dgs.method.msdi.inputs import Sensors, shrink
from spike4dgs.method.msdi.weights import WEIGHTS, load_network
from spike4dgs.method.starts.base import Start
from spike4dgs.method.starts.clip import SpikeClip, white_rates
from spike4dgs.method.starts.rig import Cloud, PointSettings, filled, matched, swept
from spike4dgs.method.starts.surrounding import looked_at
from spike4dgs.method.training_views.pinholes import nearest_pixels

_LEAST = 1e-4  # charge per tick: the mean light of a clip that is dark throughout


@dataclass(frozen=True)
class MsdiSettings(PointSettings):
    """Numbers of `msdi` (prefix `initialization`)."""

    trained_px: int = 104  # longer side of the training images
    least_confidence: float = 0.3  # quantile of a view's confidence below which its points are left out
    least_matches: int = 50  # for a line through inverse depths
    line_rounds: int = 10  # of reweighted least squares
    farthest: float = 2.0  # times the farthest match: points beyond it are left out


DEFAULTS = MsdiSettings()


@dataclass(frozen=True, eq=False)
class Estimate:
    """The network's estimate for V views of h x w pixels."""

    factor: int  # the cameras' pixels are blocks of so many by so many
    cameras: tuple[Camera, ...]  # the training cameras at this size
    images: Float32  # [V, h, w] radiance
    points: Float64  # [V, h, w, 3] in view 0's frame, at any scale
    confidence: Float64  # [V, h, w]

    def sure(self, settings: MsdiSettings) -> NDArray[np.bool_]:
        """Return the pixels [V, h, w] whose points are used."""
        least = np.quantile(self.confidence, settings.least_confidence, axis=(1, 2), keepdims=True)
        return (self.confidence >= least) & np.isfinite(self.points).all(axis=-1)


def msdi(scene: TrainingScene, settings: MsdiSettings = DEFAULTS, device: str = "auto") -> Start:
    """Return points at the calibrated poses; see the module.

    Raises WeightsError where there are no weights, UserError where all cameras have one centre.
    """
    clip = SpikeClip(scene, settings.window_ticks, flat_field=True)
    if looked_at(scene.cameras) is not None:
        return swept(scene, settings, clip)
    estimate = infer(scene, settings, device, calibrated=True)
    cloud, mean = matched(scene, settings, clip)
    return filled(scene, completed(cloud, estimate, settings), mean, settings)


def infer(
    scene: TrainingScene, settings: MsdiSettings = DEFAULTS, device: str = "auto", *, calibrated: bool
) -> Estimate:
    """Return the network's estimate for the middle of the clip, told the intrinsics or not; raises as `msdi`."""
    device = choose_device(device, rasterizes=False)
    network = load_network(WEIGHTS.in_use().path, device)
    factor = max(1, round(max(scene.cameras[0].width, scene.cameras[0].height) / settings.trained_px))
    clocks = [scene.state(camera.id).clock for camera in scene.cameras]
    middles = [local_ticks(clock, [scene.n_ticks // 2], scene.n_ticks)[0][0] for clock in clocks]
    windows = [window(s, t, network.config.ticks) for s, t in zip(scene.streams, middles, strict=True)]
    spikes = np.stack(nearest_pixels(scene, windows))
    small = shrink(torch.from_numpy(spikes), factor)[None]
    cameras = tuple(shrunk(camera, factor) for camera in scene.cameras)
    K = torch.from_numpy(np.stack([c.K for c in cameras])[None].astype(np.float32))
    sensors, gain = None, white_rates(scene)
    if calibrations := scene.calibrations:
        of_spikes = [spikes_response(*pair) for pair in zip(scene.streams, calibrations, strict=True)]
        sensors = block_means(at_pinholes(scene, of_spikes), factor, device)
        gain = np.mean([c.radiance_gain for c in calibrations], keepdims=True)
    with torch.inference_mode():
        found = network(small.to(device), K.to(device) if calibrated else None, sensors)
    rates = zip(found.images[0].clamp(min=0).cpu().numpy(), scene.streams, strict=True)
    charge = np.stack([gathered(image, stream.dead_ticks) for image, stream in rates])
    images = np.asarray(charge / gain.astype(np.float32), np.float32)
    points, confidence = (x[0].double().cpu().numpy() for x in (found.points, found.confidence))
    return Estimate(factor, cameras, images, points, confidence)


def shrunk(camera: Camera, factor: int) -> Camera:
    """Return the view of a sensor whose pixels are blocks of `factor` x `factor`, sides rounded up."""
    width, height = -(-camera.width // factor), -(-camera.height // factor)
    fx, fy, cx, cy = (x / factor for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    return replace(camera, width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def spikes_response(stream: SpikeStream, camera: Calibration) -> Calibration:
    """Return the response of a camera's spikes to light, which its calibration tells of the charge.

    With dead ticks spikes are not in proportion to light. The response is then right at the mean light of the clip.
    """
    if not (dead := stream.dead_ticks):
        return camera
    charge = gathered(float(total_counts(stream).mean()) / stream.n_ticks, dead)
    light = max(charge - float(camera.mean_dark), _LEAST)
    dark = fired(camera.dark, dead)
    gain = (fired(camera.gain * light + camera.dark, dead) - dark) / fired(light, dead)
    return replace(camera, gain=gain.astype(np.float32), dark=dark.astype(np.float32))


def at_pinholes(scene: TrainingScene, calibrations: Sequence[Calibration]) -> list[Calibration]:
    """Return the response of the scene's views, by pixel: that of the nearest pixel of the stream."""
    gains, darks = (nearest_pixels(scene, [getattr(c, name) for c in calibrations]) for name in ("gain", "dark"))
    return [replace(c, gain=g, dark=d) for c, g, d in zip(calibrations, gains, darks, strict=True)]


def block_means(calibrations: Sequence[Calibration], factor: int, device: str) -> Sensors:
    """Return the maps [1, V, h, w] of sensors with larger pixels."""

    def small(maps: list[Float32]) -> torch.Tensor:
        whole = torch.from_numpy(np.stack(maps)).to(device)[None]
        return functional.avg_pool2d(whole, factor, ceil_mode=True, count_include_pad=False)

    return Sensors(small([c.gain for c in calibrations]), small([c.dark for c in calibrations]))


def completed(cloud: Cloud, estimate: Estimate, settings: MsdiSettings = DEFAULTS) -> Cloud:
    """Return the matched points, and the network's where view 0 sees none; the same cloud where no line fits."""
    camera, depth, sure = estimate.cameras[0], estimate.points[0, :, :, 2], estimate.sure(settings)[0]
    uv, z = camera.project(cloud.points)
    uv, z = uv[z > 0], z[z > 0]
    line = inverse_depth_line(np.where(sure, depth, np.nan), uv, z, settings)
    if line is None:
        return cloud
    v, u = np.nonzero(sure & (depth > 0))
    at, inverse = np.stack([u + 0.5, v + 0.5], axis=-1), np.polyval(line, 1 / depth[v, u])
    empty = cKDTree(uv).query(at)[0] > settings.hole_px / estimate.factor
    hole = empty & (inverse * z.max() * settings.farthest > 1)
    points = np.concatenate([cloud.points, camera.unproject(at[hole], 1 / inverse[hole])])
    return Cloud(points, np.concatenate([cloud.values, estimate.images[0, v[hole], u[hole]]]))


def inverse_depth_line(depth: Float64, uv: Float64, z: Float64, settings: MsdiSettings = DEFAULTS) -> Float64 | None:
    """Return (a, b) of the line a / depth + b that is closest to the inverse depths 1 / z of points at pixels uv.

    The sum of the absolute differences is made smallest, by least squares that the last residuals weigh. `depth` [h, w]
    is NaN where nothing is known. None for fewer than `least_matches` points, or where the line does not rise.
    """
    inside = (uv >= 0).all(axis=1) & (uv < depth.shape[::-1]).all(axis=1)
    u, v = uv[inside].astype(np.int64).T
    known = depth[v, u] > 0
    if known.sum() < settings.least_matches:
        return None
    x, y = 1 / depth[v, u][known], 1 / z[inside][known]
    if np.ptp(x) == 0:
        return None
    weights, line = np.ones(len(x)), np.zeros(2)
    for _ in range(settings.line_rounds):
        line = np.polyfit(x, y, 1, w=np.sqrt(weights))
        weights = 1 / np.maximum(np.abs(np.polyval(line, x) - y), 1e-6 * y.mean())
    return line if line[0] > 0 else None
