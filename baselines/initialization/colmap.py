"""The initialisations `colmap` and `colmap-uncalibrated`: poses by structure from motion (COLMAP).

SIFT features of one image per training view, the mean of the whole clip: what moves is a blur there, and the static
rest, where the spikes' quantisation noise has averaged out, carries the poses of a static rig. One global
mapping (rotation averaging, global positioning, bundle adjustment) solves for all views at once: an array is small
beside its distance to the scene, and the pair that incremental mapping begins with then easily ends in a wrong but
locally best pose.

`colmap` keeps the calibrated intrinsics; `colmap-uncalibrated` knows nothing and refines one focal length for all
views from a prior of 1.2 image widths. Their points are COLMAP's. With `flat_field`, `colmap` sees images corrected by
the cameras' calibrations, in which views have up to twice as many points in common, and sweeps planes from the poses
found, as `rig` does from given ones.

Poses come out in a frame of their own: the similarity that fits them to the calibrated training poses
(`benchmark.metrics.pose_error`) takes everything to the scene's frame, where held-out cameras are known. Calibrated
poses serve for nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spike4dgs.baselines.initialization.features import MIN_ANGLE_DEG, NOTHING, Mapping, find_features, in_scene
from spike4dgs.baselines.initialization.rig import rig, window_means
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.initialization import Start
from spike4dgs.method.settings import Settings

if TYPE_CHECKING:
    import pycolmap

Float32 = NDArray[np.float32]

WHO = "COLMAP"
MIN_POINTS = 100  # fewer are no start for Gaussians: they come from a plane sweep with the estimated cameras


@dataclass(frozen=True)
class ColmapSettings(Settings):
    """Images of the views (prefix `initialization`)."""

    flat_field: bool = False  # correct them by each camera's calibration, if known, and sweep planes for the points


def colmap(scene: TrainingScene, seed: int, *, flat_field: bool = False) -> Start:
    """Return poses and points with the calibrated intrinsics; see the module.

    Raises UserError unless all training views are registered.
    """
    if flat_field:
        images = window_means(scene, 0, scene.n_ticks, flat_field=True)
        found = map_views(scene, images, seed, calibrated=True).of_all(scene, WHO)
        return rig(replace(scene, cameras=found.cameras), flat_field=True)
    return _start(scene, map_views(scene, clip_means(scene), seed, calibrated=True), seed)


def colmap_uncalibrated(scene: TrainingScene, seed: int) -> Start:
    """Return the same, with intrinsics unknown."""
    return _start(scene, map_views(scene, clip_means(scene), seed, calibrated=False), seed)


def _start(scene: TrainingScene, found: Mapping, seed: int) -> Start:
    if len(found.of_all(scene, WHO).points) < MIN_POINTS:
        return rig(replace(scene, cameras=found.cameras))
    return Start(found.cameras, found.points.astype(np.float32), found.values)


def clip_means(scene: TrainingScene) -> Float32:
    """Return the mean radiance of each training view over the clip (its first 65535 ticks) [C, H, W]."""
    ticks = min(scene.n_ticks, 65535)
    counts = np.stack([s.counts(0, ticks) for s in scene.streams]).astype(np.float32)
    return counts / np.float32(ticks * scene.radiance_gain)


def map_views(scene: TrainingScene, images: Float32, seed: int, *, calibrated: bool) -> Mapping:
    """Return the structure from motion on one image of each training view [C, H, W], linear radiance.

    The same seed gives the same poses: everything runs in one thread. Where fewer than two views are registered,
    nothing can be aligned and the mapping is empty.
    """
    import pycolmap

    with find_features(scene.cameras, images, seed, calibrated=calibrated) as found:
        models = pycolmap.global_mapping(found.database, found.folder, found.folder / "out", _options(seed, calibrated))
        if not models:
            return NOTHING
        return in_scene(max(models.values(), key=lambda m: m.num_reg_images()), scene.cameras, found.names, images)


def _options(seed: int, calibrated: bool) -> pycolmap.GlobalPipelineOptions:
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = 1, seed
    options.mapper.num_threads, options.mapper.random_seed = 1, seed
    options.mapper.min_tri_angle_deg = MIN_ANGLE_DEG
    options.mapper.retriangulation.min_angle = MIN_ANGLE_DEG
    options.mapper.bundle_adjustment.refine_focal_length = not calibrated
    options.mapper.bundle_adjustment.refine_extra_params = False
    return options
