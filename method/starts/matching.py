"""The initialisation `matched`: poses by the matching network and by features, points as `msdi` finds them.

All training views are seen at the middle of the clip, through `adaptive`'s windows (`method.matching.window_inputs`),
corrected by the cameras' calibrations where a scene has them. The network matches all pairs of views; the poses follow
(`method.matching.poses`) with the calibrated intrinsics, or with one focal length for all that is estimated too. As
for COLMAP, everything is then moved to the scene's frame. From there the features of the corrected means of the clip
are adjusted (`matched_poses`). Where they leave a view out, as in the dark, the network's poses stay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.metrics.pose_error import align_cameras
from spike4dgs.benchmark.scene.camera_state import local_ticks
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.method.matching.matches import learned_matches
from spike4dgs.method.matching.poses import Solved, solve, solve_unknown
from spike4dgs.method.matching.weights import WEIGHTS, load_matcher
from spike4dgs.method.matching.window_inputs import light_of, window_inputs
from spike4dgs.method.starts.base import Start
from spike4dgs.method.starts.clip import window_means
from spike4dgs.method.starts.matched_poses import MatchSettings, bundle
from spike4dgs.method.starts.msdi import MsdiSettings, msdi
from spike4dgs.method.starts.structure_from_motion import NOTHING, Mapping
from spike4dgs.method.training_views.pinholes import nearest_pixels


@dataclass(frozen=True)
class MatchedSettings(MsdiSettings, MatchSettings):
    """Numbers of `matched` (prefix `initialization`)."""


DEFAULTS = MatchedSettings()


def matched(scene: TrainingScene, seed: int, settings: MatchedSettings = DEFAULTS, device: str = "auto") -> Start:
    """Return estimated poses, and points at them; see the module. Raises as `msdi` and `refined_poses` do."""
    return msdi(replace(scene, cameras=refined_poses(scene, seed, settings, device).cameras), settings, device)


def refined_poses(scene: TrainingScene, seed: int, settings: MatchSettings = DEFAULTS, device: str = "auto") -> Mapping:
    """Return the training cameras, whose intrinsics are known, and the points that they match.

    Raises WeightsError where there are no weights, UserError where the network finds no poses.
    """
    first = match_and_solve(scene, seed, device, calibrated=True).of_all(scene, "the matching network")
    images = window_means(scene, 0, scene.n_ticks, flat_field=True)
    better = bundle(scene, [(c.R, c.t) for c in first.cameras], images, seed, settings)
    return better if len(better.cameras) == len(scene.cameras) else first


def seen_inputs(scene: TrainingScene) -> Float32:
    """Return the network's inputs [V, 4, H, W] at the middle of the clip, as the scene's pinhole cameras see them."""
    found = []
    for k, (camera, stream) in enumerate(zip(scene.cameras, scene.streams, strict=True)):
        tick = local_ticks(scene.state(camera.id).clock, [scene.n_ticks // 2], scene.n_ticks)[0][0]
        sensor = scene.calibrations[k] if scene.calibrations else None
        found.append(window_inputs(stream, tick, (sensor.gain, sensor.dark) if sensor else None))
    return np.stack(nearest_pixels(scene, found))


def match_and_solve(scene: TrainingScene, seed: int, device: str = "auto", *, calibrated: bool) -> Mapping:
    """Return the training cameras and the points that they match, in the scene's frame; `NOTHING` where none is found.

    Raises WeightsError where there are no weights.
    """
    network = load_matcher(WEIGHTS.in_use().path, choose_device(device, rasterizes=False))
    inputs = seen_inputs(scene)
    matches = learned_matches(network, inputs)
    first = scene.cameras[0]
    if calibrated:
        found = solve(matches, np.stack([camera.K for camera in scene.cameras]), seed)
    else:
        found = solve_unknown(matches, (first.height, first.width), len(scene.cameras), seed)
    return NOTHING if found is None else in_scene(scene, found, inputs)


def in_scene(scene: TrainingScene, found: Solved, inputs: Float32) -> Mapping:
    """Return the solution in the frame of the calibrated cameras; gray values are those of the first channel."""
    posed = [
        replace(camera, fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2], R=w2c[:3, :3], t=w2c[:3, 3])
        for camera, K, w2c in zip(scene.cameras, found.array.K, found.w2c, strict=True)
    ]
    move = align_cameras(posed, scene.cameras)
    kept = found.points_kept()
    anchor, at = found.tracks.anchor[kept], found.tracks.at[kept]
    world = np.zeros((len(at), 3))
    for view, camera in enumerate(posed):
        mine = anchor == view
        world[mine] = camera.unproject(at[mine], 1 / found.adjusted.inverse_depth[kept][mine])
    u, v = at.astype(np.int64).T
    return Mapping(tuple(move.camera(c) for c in posed), move(world), light_of(inputs[anchor, 0, v, u]))
