"""The initialisation `colmap`: poses by structure from motion (COLMAP).

SIFT features of one image per training view, the mean of the whole clip: what moves is a blur there, and the static
rest, where the spikes' quantisation noise has averaged out, carries the poses of a static rig. One global
mapping solves for all views at once (`structure_from_motion`).

The calibrated intrinsics are kept, and the points are COLMAP's. With `flat_field` it sees images corrected by the
cameras' calibrations, in which views have up to twice as many points in common, and sweeps planes from the poses found,
as `rig` does from given ones.

Poses come out in a frame of their own: the similarity that fits them to the calibrated training poses
(`benchmark.metrics.pose_error`) takes everything to the scene's frame, where held-out cameras are known. Calibrated
poses serve for nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.starts.base import Start
from spike4dgs.method.starts.clip import SpikeClip, window_means
from spike4dgs.method.starts.rig import RigSettings, rig, swept
from spike4dgs.method.starts.structure_from_motion import FeatureSettings, clip_means, map_views

WHO = "COLMAP"


@dataclass(frozen=True)
class ColmapSettings(FeatureSettings, RigSettings):
    """Numbers of `colmap` (prefix `initialization`). With `flat_field` all points come from a plane sweep."""

    min_points: int = 100  # fewer are no start for Gaussians: they come from a plane sweep with the estimated cameras


DEFAULTS = ColmapSettings()


def colmap(scene: TrainingScene, seed: int, settings: ColmapSettings = DEFAULTS) -> Start:
    """Return poses and points with the calibrated intrinsics; see the module.

    Raises UserError unless all training views are registered.
    """
    if settings.flat_field:
        images = window_means(scene, 0, scene.n_ticks, flat_field=True)
        found = map_views(scene.cameras, images, seed, settings).of_all(scene, WHO)
        return rig(replace(scene, cameras=found.cameras), settings)
    found = map_views(scene.cameras, clip_means(scene), seed, settings).of_all(scene, WHO)
    if len(found.points) < settings.min_points:
        posed = replace(scene, cameras=found.cameras)
        return swept(posed, settings, SpikeClip(posed, settings.window_ticks, flat_field=False))
    return Start(found.cameras, found.points.astype(np.float32), found.values)
