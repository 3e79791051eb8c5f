"""The initialisation `dust3r`: poses and points by DUSt3R from weights that users bring.

The network sees the first training view beside each of the others and gives, per pair, the points of both images in
the first one's frame, at a scale of the pair's own. The pairs share the first view's points, so their scales follow
from the ratios of its distances. Each other view then gets its pose by PnP with RANSAC between its pixels and its
points, and all is moved to the scene's frame as COLMAP's result is. Pairs beyond this star, and the joint optimisation
over all of them, are left out: with 8 views of an array every view overlaps the first.

The calibrated intrinsics are kept in PnP; `estimate` can do without, with one focal length from the first view's points
(`focal_from_points`). Images are the means of the clip, as for COLMAP.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from spike4dgs.baselines.starts.dust3r_network import Dust3r, load_dust3r
from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.metrics.pose_error import align_cameras
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.weights import NamedWeights, WeightFile, find_weights
from spike4dgs.method.msdi.pose import focal_from_points, solve_pose
from spike4dgs.method.settings import Settings
from spike4dgs.method.starts.base import Start
from spike4dgs.method.starts.structure_from_motion import clip_means

FILE = WeightFile(
    "dust3r_vitlarge_512_dpt.safetensors",
    None,
    None,
    "DUSt3R's network, 2.28 GB",
    "hf://naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt/model.safetensors",
    "CC BY-NC-SA 4.0",
    remote_name="model.safetensors",
    command="download weights dust3r",
)
WEIGHTS = NamedWeights(
    "DUSt3R's weights, model.safetensors of naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt (2.28 GB, licence "
    "CC BY-NC-SA 4.0)",
    variable="SPIKE4DGS_DUST3R",
    fix=f"run `spike4dgs {FILE.command}`, or get the file and set SPIKE4DGS_DUST3R to its path",
    download=FILE,
)


@dataclass(frozen=True)
class Dust3rSettings(Settings):
    """Numbers of `dust3r` (prefix `initialization`)."""

    long_side_px: int = 512  # the size that the weights were trained at
    ransac_px: float = 5.0  # of the network's image
    least_confidence: float = 0.5  # quantile below which points of a view are left out
    max_points: int = 10_000  # first Gaussians: about 0.4 per pixel of a view of 200x125


DEFAULTS = Dust3rSettings()


def weights_path() -> Path:
    """Return the weight file that users bring. Raises WeightsError where it is missing."""
    return find_weights(WEIGHTS).path


@dataclass(frozen=True, eq=False)
class Pair:
    """The network's answer for two views: points [H, W, 3] in the first one's frame, confidence [H, W] >= 1."""

    points: tuple[Float64, Float64]
    confidence: tuple[Float64, Float64]


Predict = Callable[[int], Pair]  # of view 0 beside view i


def dust3r(scene: TrainingScene, seed: int, settings: Dust3rSettings = DEFAULTS, device: str = "auto") -> Start:
    """Return poses and points with the calibrated intrinsics; see the module.

    Raises WeightsError where the weights are absent, UserError where they are others or a view gets no pose.
    """
    return estimate(scene, clip_means(scene), seed, settings, device, calibrated=True)


def estimate(
    scene: TrainingScene,
    images: Float32,
    seed: int,
    settings: Dust3rSettings = DEFAULTS,
    device: str = "auto",
    *,
    calibrated: bool,
) -> Start:
    """Return poses and points from one image of each training view [C, H, W], linear radiance; raises as `dust3r`."""
    network = load_dust3r(weights_path())
    views = [resized(camera, network.shape.patch, settings.long_side_px) for camera in scene.cameras]
    shown = np.stack([_resize(p, v, settings.long_side_px) for p, v in zip(images, views, strict=True)])
    predict = predictor(network, shown, choose_device(device, rasterizes=False))
    return solve(predict, views, shown, scene, seed, settings, calibrated=calibrated)


def resized(camera: Camera, patch: int, long_side_px: int) -> Camera:
    """Return the view at the network's size: `long_side_px` the long way, cut to whole patches about the middle."""
    scale = long_side_px / max(camera.width, camera.height)
    width, height = (int(n * scale + 1e-9) // patch * patch for n in (camera.width, camera.height))
    cx = camera.cx * scale - (camera.width * scale - width) / 2
    cy = camera.cy * scale - (camera.height * scale - height) / 2
    return replace(camera, width=width, height=height, fx=camera.fx * scale, fy=camera.fy * scale, cx=cx, cy=cy)


def _resize(image: Float32, view: Camera, long_side_px: int) -> Float32:
    """Return linear radiance [H, W] as sRGB-encoded gray in [0, 1] at the network's size [h, w]."""
    scale = long_side_px / max(image.shape)
    left, top = ((n * scale - m) / 2 for n, m in zip(image.shape[::-1], (view.width, view.height), strict=True))
    # From pixel indices of the result to those of the image; the centre of pixel i lies at i + 0.5.
    back = np.array([[1 / scale, 0, (left + 0.5) / scale - 0.5], [0, 1 / scale, (top + 0.5) / scale - 0.5]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    encoded = encode_srgb(image).astype(np.float32) / 255
    size = (view.width, view.height)
    return np.clip(cv2.warpAffine(encoded, back, size, flags=flags, borderMode=cv2.BORDER_REFLECT_101), 0, 1)


def predictor(network: Dust3r, shown: Float32, device: str = "cpu") -> Predict:
    """Return the network on images [C, H, W] in [0, 1]."""
    network = network.to(device)
    inputs = torch.as_tensor(2 * shown - 1, device=device)[:, None].expand(-1, 3, -1, -1)
    with torch.inference_mode():
        tokens = [network.encode(x[None]) for x in inputs]

    def predict(other: int) -> Pair:
        with torch.inference_mode():
            both = network.decode(tokens[0], tokens[other], inputs[:1])
        (p, p_sure), (q, q_sure) = ((x[0].double().cpu().numpy(), c[0].double().cpu().numpy()) for x, c in both)
        return Pair((p, q), (p_sure, q_sure))

    return predict


def solve(
    predict: Predict,
    views: Sequence[Camera],
    shown: Float32,
    scene: TrainingScene,
    seed: int,
    settings: Dust3rSettings = DEFAULTS,
    *,
    calibrated: bool,
) -> Start:
    """Return cameras and points from the network's answers; `views` are the training cameras at the size of `shown`.

    Raises UserError for a single view, and where a view gets no pose.
    """
    if len(views) < 2:
        raise problem(f"DUSt3R on {scene.id}", "two training views or more", str(len(views)), "use rig")
    pairs = [predict(i) for i in range(1, len(views))]
    confidence = np.mean([p.confidence[0] for p in pairs], axis=0)
    sure = confidence >= np.quantile(confidence, settings.least_confidence)
    first = pairs[0].points[0]
    scales = [_scale(first[sure], p.points[0][sure]) for p in pairs]
    shared = np.median([s * p.points[0] for s, p in zip(scales, pairs, strict=True)], axis=0)
    focal = None
    if not calibrated:
        focal = focal_from_points(shared[sure], _pixels(sure) - [views[0].cx, views[0].cy])
        if focal is None:
            fix = "use rig or colmap"
            raise problem(f"DUSt3R on {scene.id}", "points that give a focal length", "none before the camera", fix)
    known = [v if focal is None else replace(v, fx=focal, fy=focal, cx=v.width / 2, cy=v.height / 2) for v in views]
    posed, clouds = [replace(known[0], R=np.eye(3), t=np.zeros(3))], [(shared[sure], shown[0][sure])]
    for view, pair, scale, image in zip(known[1:], pairs, scales, shown[1:], strict=True):
        chosen = pair.confidence[1] >= np.quantile(pair.confidence[1], settings.least_confidence)
        points = scale * pair.points[1][chosen]
        pose = solve_pose(points, _pixels(chosen), view.K, seed, reach_px=settings.ransac_px)
        if pose is None:
            fix = "use rig or colmap"
            raise problem(f"DUSt3R on {scene.id}", f"a pose for {view.id}", "no consistent points", fix)
        posed.append(replace(view, R=pose[0], t=pose[1]))
        clouds.append((points, image[chosen]))
    cameras = [_at_size(p, c, settings.long_side_px) for p, c in zip(posed, scene.cameras, strict=True)]
    move = align_cameras(cameras, scene.cameras)
    points, values = (np.concatenate(parts) for parts in zip(*clouds, strict=True))
    few = np.random.default_rng(seed).permutation(len(points))[: settings.max_points]
    linear = np.asarray(_decode_srgb(values[few]), np.float32)
    return Start(tuple(move.camera(c) for c in cameras), move(points[few]).astype(np.float32), linear)


def _scale(points: Float64, same: Float64) -> float:
    """Return the median ratio of the distances to the camera of `points` [N, 3] and of `same` [N, 3]."""
    return float(np.median(np.linalg.norm(points, axis=-1) / np.maximum(np.linalg.norm(same, axis=-1), 1e-12)))


def _pixels(mask: NDArray[np.bool_]) -> Float64:
    """Return coordinates [N, 2] of the centres of a mask's pixels."""
    v, u = np.nonzero(mask)
    return np.stack([u + 0.5, v + 0.5], axis=-1)


def _at_size(view: Camera, camera: Camera, long_side_px: int) -> Camera:
    """Return a posed view with the size of the scene's camera."""
    scale = max(camera.width, camera.height) / long_side_px
    cx = view.cx * scale + (camera.width - view.width * scale) / 2
    cy = view.cy * scale + (camera.height - view.height * scale) / 2
    return replace(camera, fx=view.fx * scale, fy=view.fy * scale, cx=cx, cy=cy, R=view.R, t=view.t)


def _decode_srgb(x: Float32) -> Float32:
    return np.asarray(np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4), np.float32)
