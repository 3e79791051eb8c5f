"""What a clip tells of its cameras before a fit: dark rates of today, and given poses that are not quite right.

A tenth of a pixel between views blurs what they agree on. Features of the clip's mean images tell it: first few, of the
images as they are, which cost a twentieth of a short fit. Only where these say that the poses are off, many features of
enlarged images mend them. Poses that are right stay, to the bit.
"""

from __future__ import annotations

import sys
from dataclasses import replace

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.self_calibration.dark_drift import in_todays_dark
from spike4dgs.method.self_calibration.pose_adjustment import AdjustSettings
from spike4dgs.method.self_calibration.poses import check_poses
from spike4dgs.method.starts.structure_from_motion import FEATURES, FeatureSettings

# A calibrated array: 0.2 px of a camera 200 px wide, and centres to a two-thousandth of the largest distance. Weaker
# knowledge lets turns and shifts of a narrow array explain one another, and adds 0.07 px to poses that were right.
PRIOR = AdjustSettings(turn_deg=0.05, shift=0.0005)
FEW = FeatureSettings(enlarge=1)
LEAST_PX = 64  # of a side: smaller images have too few features, at a price that a fit of them feels
# Of the features' median error with the given poses, in that with mended ones, from which poses are off. Right ones
# give 1.00 on development scenes, those 0.08 px off 1.3 to 1.4.
OFF = 1.15


def as_in_clip(scene: TrainingScene, seed: int, poses: bool) -> TrainingScene:
    """Return a scene with the dark rates that its clip tells and, where `poses` are used, with mended ones; say so."""
    found = in_todays_dark(scene)
    if changed := [state.dark for state in found.states.values() if state.dark != 1]:
        text = f"{len(changed)} of {len(scene.cameras)} cameras have {min(changed):.2f} to {max(changed):.2f} times"
        print(f"{text} the dark rate of their calibration", file=sys.stderr)
    return at_mended_poses(found, seed) if poses else found


def at_mended_poses(scene: TrainingScene, seed: int) -> TrainingScene:
    """Return a scene with mended poses, and say so: `scene` itself where features do not tell that they are off.

    The given ones are a prior with the standard deviations of `PRIOR`, which holds the frame and the scale.
    """
    if len(scene.streams) < 2 or min(scene.cameras[0].width, scene.cameras[0].height) < LEAST_PX:
        return scene
    for features in (FEW, FEATURES):
        found = check_poses(scene, seed, PRIOR, features)
        if not found.given_px > OFF * found.adjusted_px:  # NaN where views have too few points in common
            return scene
    text = f"{found.points} points that views have in common miss their features by {found.given_px:.2f} px"
    print(f"the given poses are off: {text}, mended {found.adjusted_px:.2f}", file=sys.stderr)
    return replace(scene, cameras=found.cameras)
