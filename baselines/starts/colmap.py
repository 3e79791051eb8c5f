"""The initialisation `colmap`: poses by structure from motion (COLMAP).

SIFT features of one image per training view, the mean of the whole clip: what moves is a blur there, and the static
rest, where the spikes' quantisation noise has averaged out, carries the poses of a static rig. One global
mapping solves for all views at once (`structure_from_motion`).

The calibrated intrinsics are kept. Points come from a plane sweep with the poses found, as `rig` has them with given
ones: ten times as many as COLMAP's. With `flat_field` all images are corrected by the cameras' calibrations; views then
have up to twice as many features in common.

Poses come out in a frame of their own: the similarity that fits them to the calibrated training poses
(`benchmark.metrics.pose_error`) takes everything to the scene's frame, where held-out cameras are known. Calibrated
poses serve for nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.starts.base import Start
from spike4dgs.method.starts.clip import window_means
from spike4dgs.method.starts.rig import RigSettings, rig
from spike4dgs.method.starts.structure_from_motion import FeatureSettings, clip_means, map_views

WHO = "COLMAP"


@dataclass(frozen=True)
class ColmapSettings(FeatureSettings, RigSettings):
    """Numbers of `colmap` (prefix `initialization`): of its features, and of its plane sweep."""


DEFAULTS = ColmapSettings()


def colmap(scene: TrainingScene, seed: int, settings: ColmapSettings = DEFAULTS) -> Start:
    """Return poses and points with the calibrated intrinsics; see the module.

    Raises UserError unless all training views are registered.
    """
    flat = settings.flat_field
    images = window_means(scene, 0, scene.n_ticks, flat_field=True) if flat else clip_means(scene)
    found = map_views(scene.cameras, images, seed, settings).of_all(scene, WHO)
    return rig(replace(scene, cameras=found.cameras), settings)
