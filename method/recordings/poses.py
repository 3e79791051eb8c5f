"""The given poses of a recording, before a fit: checked against what does not move, and adjusted where wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spike4dgs.benchmark.metrics.pose_error import angle_deg
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.recordings.clocks import Surveyed
from spike4dgs.method.self_calibration.poses import LEAST_POINTS, check_poses


def survey_poses(scene: TrainingScene, seed: int = 0) -> Surveyed:
    """Return the scene with poses that its clip agrees with, notes, and columns for the report.

    It is the same scene where the given poses are right, or where too few features tell.
    """
    found = check_poses(scene, seed)
    columns = {"pose error, px": {c: f"{error:.2f}" for c, error in found.camera_px.items()}}
    if found.points < LEAST_POINTS:
        text = f"the views have {found.points} features in common, {LEAST_POINTS} are needed to check them"
        return scene, (f"poses: taken as given; {text}",), {}
    text = f"{found.points} features of the mean images lie {found.given_px:.2f} px from their points' projections"
    if not found.wrong:
        return scene, (f"poses: taken as given; {text} ({found.adjusted_px:.2f} px at best)",), columns
    pairs = zip(found.cameras, scene.cameras, strict=True)
    turned = np.max([angle_deg(a.R @ b.R.T) for a, b in pairs])
    note = (
        f"poses: the given ones are wrong ({text}); adjusted by up to {turned:.2f} degrees: {found.adjusted_px:.2f} px"
    )
    return replace(scene, cameras=found.cameras), (note,), columns
