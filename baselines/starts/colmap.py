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

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.starts.base import Start
from spike4dgs.method.starts.features import NOTHING, FeatureSettings, Mapping, find_features, in_scene
from spike4dgs.method.starts.rig import PointSettings, RigSettings, rig, swept, window_means
from spike4dgs.method.training_views.pinholes import undistorted

if TYPE_CHECKING:
    import pycolmap

Float32 = NDArray[np.float32]

WHO = "COLMAP"


@dataclass(frozen=True)
class MappingSettings(FeatureSettings, PointSettings):
    """Numbers of both initialisations by COLMAP: features, and the plane sweep that replaces few points."""

    min_points: int = 100  # fewer are no start for Gaussians: they come from a plane sweep with the estimated cameras


@dataclass(frozen=True)
class ColmapSettings(MappingSettings, RigSettings):
    """Numbers of `colmap` (prefix `initialization`).

    With `flat_field` all points come from a plane sweep.
    """


@dataclass(frozen=True)
class UncalibratedSettings(MappingSettings):
    """Numbers of `colmap-uncalibrated` (prefix `initialization`)."""

    focal_prior: float = 1.2  # image widths, COLMAP's own


DEFAULTS, UNCALIBRATED = ColmapSettings(), UncalibratedSettings()


def colmap(scene: TrainingScene, seed: int, settings: ColmapSettings = DEFAULTS) -> Start:
    """Return poses and points with the calibrated intrinsics; see the module.

    Raises UserError unless all training views are registered.
    """
    if settings.flat_field:
        images = window_means(scene, 0, scene.n_ticks, flat_field=True)
        found = map_views(scene, images, seed, settings).of_all(scene, WHO)
        return rig(replace(scene, cameras=found.cameras), settings)
    return _start(scene, map_views(scene, clip_means(scene), seed, settings), settings)


def colmap_uncalibrated(scene: TrainingScene, seed: int, settings: UncalibratedSettings = UNCALIBRATED) -> Start:
    """Return the same, with intrinsics unknown."""
    return _start(scene, map_views(scene, clip_means(scene), seed, settings, settings.focal_prior), settings)


def _start(scene: TrainingScene, found: Mapping, settings: MappingSettings) -> Start:
    if len(found.of_all(scene, WHO).points) < settings.min_points:
        return swept(replace(scene, cameras=found.cameras), settings, flat_field=False)
    return Start(found.cameras, found.points.astype(np.float32), found.values)


def clip_means(scene: TrainingScene) -> Float32:
    """Return the mean radiance of each training view over the clip (its first 65535 ticks) [C, H, W]."""
    ticks = min(scene.n_ticks, 65535)
    counts = np.stack([s.counts(0, ticks) for s in scene.streams]).astype(np.float32)
    return undistorted(scene, counts / np.float32(ticks * scene.radiance_gain), unseen=None)


def map_views(
    scene: TrainingScene,
    images: Float32,
    seed: int,
    settings: FeatureSettings = DEFAULTS,
    focal_prior: float | None = None,
) -> Mapping:
    """Return the structure from motion on one image of each training view [C, H, W], linear radiance.

    Intrinsics are the calibrated ones; with `focal_prior`, in image widths, they are unknown and one is estimated.
    The same seed gives the same poses: everything runs in one thread. Where fewer than two views are registered,
    nothing can be aligned and the mapping is empty.
    """
    import pycolmap

    with find_features(scene.cameras, images, seed, settings, focal_prior) as found:
        options = _options(seed, settings.min_angle_deg, refine_focal=focal_prior is not None)
        models = pycolmap.global_mapping(found.database, found.folder, found.folder / "out", options)
        if not models:
            return NOTHING
        largest = max(models.values(), key=lambda m: m.num_reg_images())
        return in_scene(largest, scene.cameras, found.names, images, settings.enlarge)


def _options(seed: int, min_angle_deg: float, *, refine_focal: bool) -> pycolmap.GlobalPipelineOptions:
    import pycolmap

    options = pycolmap.GlobalPipelineOptions()
    options.num_threads, options.random_seed = 1, seed
    options.mapper.num_threads, options.mapper.random_seed = 1, seed
    options.mapper.min_tri_angle_deg = min_angle_deg
    options.mapper.retriangulation.min_angle = min_angle_deg
    options.mapper.bundle_adjustment.refine_focal_length = refine_focal
    options.mapper.bundle_adjustment.refine_extra_params = False
    return options
