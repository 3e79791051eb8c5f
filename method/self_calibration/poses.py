"""The poses of an array from a clip: whether the given ones are right, and better ones near them where they are not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.scene.calibration import Recordings
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.self_calibration.clocks import with_camera
from spike4dgs.method.self_calibration.pose_adjustment import Adjusted, AdjustSettings, adjust, find_tracks
from spike4dgs.method.starts.clip import window_means
from spike4dgs.method.starts.structure_from_motion import FEATURES, FeatureSettings
from spike4dgs.method.training_views.pinholes import as_pinholes, with_lenses

LEAST_POINTS = 50  # that views have in common: fewer tell no poses
# Of the given poses' error, in those of the adjusted ones, from which the given ones are wrong. On clean scenes it is
# 1.0; rotations wrong by 0.05 degrees give 1.2, by 0.1 degrees 1.6.
WRONG = 1.5

DEFAULTS = AdjustSettings()


@dataclass(frozen=True, eq=False)
class PoseCheck:
    """Given poses beside adjusted ones: median distances of features from their points' projections, px."""

    points: int  # that features of two or more views have in common
    given_px: float
    adjusted_px: float
    camera_px: dict[str, float]  # of each camera with the given poses
    cameras: tuple[Camera, ...]  # adjusted, in the frame of the given ones

    @property
    def wrong(self) -> bool:
        """Whether the adjusted poses explain the features so much better that the given ones must be wrong."""
        return self.points >= LEAST_POINTS and self.given_px > WRONG * self.adjusted_px


def check_poses(
    scene: TrainingScene, seed: int = 0, s: AdjustSettings = DEFAULTS, features: FeatureSettings = FEATURES
) -> PoseCheck:
    """Return how well the given poses explain what does not move, and poses near them that explain it best."""
    seen = as_pinholes(scene)
    tracks = find_tracks(seen.cameras, _means(seen), seed, features)
    if tracks.points < LEAST_POINTS:
        return PoseCheck(tracks.points, np.nan, np.nan, {}, scene.cameras)
    given = adjust(seen.cameras, tracks, s, free=[False] * len(seen.cameras))
    found = adjust(seen.cameras, tracks, s)
    own = {c.id: _median(given.errors[tracks.camera == i]) for i, c in enumerate(scene.cameras)}
    return PoseCheck(tracks.points, _median(given.errors), _median(found.errors), own, with_lenses(seen, found.cameras))


def pose_of_another(
    scene: TrainingScene,
    camera: Camera,
    stream: SpikeStream,
    recordings: Recordings | None = None,
    seed: int = 0,
    s: AdjustSettings = DEFAULTS,
) -> Camera:
    """Return a camera that `scene` does not have, a held-out one, at the pose that its own stream tells.

    The cameras of the scene stay where they are: after a repair of their poses, this is the held-out view in the
    repaired frame. With too few features in common it is the given one.
    """
    wider = as_pinholes(with_camera(scene, camera, stream, recordings))
    tracks = find_tracks(wider.cameras, _means(wider), seed)
    if int((tracks.camera == len(scene.cameras)).sum()) < LEAST_POINTS:
        return camera
    found: Adjusted = adjust(wider.cameras, tracks, s, free=[False] * len(scene.cameras) + [True])
    return with_lenses(wider, found.cameras)[-1]


def _means(scene: TrainingScene) -> Float32:
    """Return the mean image of each view over the clip [C, H, W]: what moves is a blur."""
    return window_means(scene, 0, scene.n_ticks, flat_field=bool(scene.calibrations))


def _median(errors: Float64) -> float:
    return float(np.median(errors)) if len(errors) else float("nan")
