"""The recording that `fit` takes: a scene folder, or streams without poses, whose cameras are then estimated.

Of a scene folder the fit reads only what `Scene.training` holds: no image, mask or map of the truth, and no held-out
camera. The held-out cameras' streams and recordings are read after it, to judge it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import sha256_file, sha256_json
from spike4dgs.benchmark.metrics.pose_error import Sim3
from spike4dgs.benchmark.scene.cameras import Camera, array_axes
from spike4dgs.benchmark.scene.scene import Scene, TrainingScene, open_scene
from spike4dgs.benchmark.spikes.folder import NAME as STREAMS
from spike4dgs.benchmark.spikes.folder import open_stream_folder
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.untrusted import is_id
from spike4dgs.method.recordings.camera_facts import CameraFacts, camera_facts
from spike4dgs.method.recordings.survey import survey_gains, survey_streams
from spike4dgs.method.starts.plane_sweep import widest_baseline
from spike4dgs.method.starts.structure_from_motion import FEATURES, FOCAL_PRIOR, clip_means, map_views

GIVEN = "given by the scene"
ESTIMATED = "estimated with COLMAP, the focal length too: the unit of length is the array's largest distance"
ALL = "all"  # the split of a recording without poses
_FEWEST = 3  # streams without poses: COLMAP's mapping registers no two views
_NO_ID = re.compile(r"[^A-Za-z0-9._-]+")
LEAST_SIDE = 16  # pixels: views are matched at half their size, with windows of some pixels
WHITE_PERCENTILE = 99.0  # of the mean rates; the rate of white is not known without a scene


@dataclass(frozen=True, eq=False)
class Recording:
    """The data of a fit, and the facts for its report."""

    training: TrainingScene
    split: str
    poses: str  # where they come from
    facts: tuple[CameraFacts, ...]
    scene: Scene | None = None  # the folder, for what is judged after the fit; None: streams without poses
    notes: tuple[str, ...] = ()  # what was found, what was assumed, and what could not be used

    @property
    def held_out(self) -> tuple[str, ...]:
        """The cameras that the fit does not see."""
        return self.scene.test if self.scene else ()


def open_recording(root: Path, seed: int = 0) -> Recording:
    """Return the recording in a scene folder or in a folder of streams without poses, surveyed for faults.

    Raises UserError for another folder, where too little was recorded, and where poses cannot be estimated.
    """
    if (root / STREAMS).is_file():
        return _without_poses(root, open_stream_folder(root, allow_gaps=True), seed)
    scene = open_scene(root, allow_gaps=True)
    notes = (f"the fit does not see the held-out {', '.join(scene.test)}",) if scene.test else ()
    _check_size(root, scene.training.streams)
    recorded = {c: scene.stream(c) for c in scene.train}
    surveyed = survey_streams(replace(scene.training, streams=tuple(recorded.values())))
    training, gain_notes = survey_gains(surveyed.scene)
    facts = camera_facts(training, recorded, surveyed.bad)
    return Recording(training, scene.split, GIVEN, facts, scene, (*notes, *surveyed.notes, *gain_notes))


def _without_poses(root: Path, streams: Mapping[str, SpikeStream], seed: int) -> Recording:
    """Return streams with the cameras that structure from motion finds; those that it does not find are left out."""
    kinds = {(s.width, s.height, s.rate_hz, s.n_ticks) for s in streams.values()}
    if len(streams) < _FEWEST or len(kinds) > 1:
        found = f"{len(streams)} stream(s) of {len(kinds)} kind(s)"
        fix = "record all cameras together, or calibrate two with `spike4dgs calibrate-rig`"
        raise problem(root, "three or more streams of one size, rate and length", found, fix)
    _check_size(root, streams.values())
    names = sorted(streams)
    first = streams[names[0]]
    clock = first.rate_hz, first.n_ticks
    surveyed = survey_streams(
        TrainingScene(
            scene_id(root.resolve().name),
            streams_revision(streams),
            _guess(names, first),
            tuple(streams[c] for c in names),
            *clock,
            1.0,
        )
    )
    scene = surveyed.scene
    rates = clip_means(scene)
    white = max(float(np.percentile(rates, WHITE_PERCENTILE)), 1e-6)
    cameras = map_views(scene.cameras, rates / np.float32(white), seed, FEATURES, FOCAL_PRIOR).cameras
    if len(cameras) < 2:
        fix = "calibrate the array with `spike4dgs calibrate-rig`, and record with its calibration"
        raise problem(root, "poses, or views in which COLMAP finds them", f"poses of {len(cameras)} views", fix)
    kept = [c.id for c in cameras]
    notes = [
        f"white is taken to be {white:.3f} spikes per tick, the {WHITE_PERCENTILE:g}th percentile of all pixels' rates"
    ]
    if lost := [c.id for c in scene.cameras if c.id not in kept]:
        notes.append(f"COLMAP found no pose of {', '.join(lost)}: left out")
    repaired = {c.id: stream for c, stream in zip(scene.cameras, scene.streams, strict=True)}
    training, gain_notes = survey_gains(
        replace(scene, cameras=own_frame(cameras), streams=tuple(repaired[c] for c in kept), radiance_gain=white)
    )
    facts = camera_facts(training, streams, surveyed.bad)
    return Recording(training, ALL, ESTIMATED, facts, notes=(*surveyed.notes, *notes, *gain_notes))


def scene_id(name: str) -> str:
    """Return the id of a folder's streams, which the model's file has: the folder's name where that is one.

    >>> scene_id("clip_"), scene_id("_my clip!"), scene_id("...")
    ('clip_', 'my-clip', 'streams')
    """
    return name if is_id(name) else _NO_ID.sub("-", name).strip("._-")[:100] or "streams"


def streams_revision(streams: Mapping[str, SpikeStream]) -> str:
    """Return the revision of a folder of streams: of its files, and of what its description says of them."""
    said = "width", "height", "rate_hz", "rows_bottom_up", "dead_ticks"
    return sha256_json(
        {
            camera: {
                "sha256": sha256_file(Path(stream.source)),
                "gaps": [(gap.first_tick, gap.ticks) for gap in stream.gaps],
                **{name: getattr(stream, name) for name in said},
            }
            for camera, stream in streams.items()
        }
    )


def _check_size(root: Path, streams: Iterable[SpikeStream]) -> None:
    """Raise UserError for views in which nothing can be matched."""
    side = min(min(stream.width, stream.height) for stream in streams)
    if side < LEAST_SIDE:
        raise problem(root, f"views of {LEAST_SIDE} pixels or more each way", f"{side}", "record all of the sensor")


def _guess(names: Sequence[str], stream: SpikeStream) -> tuple[Camera, ...]:
    """Return cameras side by side that look along y: only a frame for what COLMAP finds."""
    size, R = (stream.width, stream.height), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    focal, middle = FOCAL_PRIOR * stream.width, (stream.width / 2, stream.height / 2)
    return tuple(
        Camera(name, *size, focal, focal, *middle, R, -R @ np.array([float(i), 0.0, 0.0]))
        for i, name in enumerate(names)
    )


def own_frame(cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """Return the cameras in the array's own frame: x right, y forward, z up, as their means are.

    The origin is the mean centre, the unit of length the largest distance between two cameras.
    """
    W, size = array_axes(cameras), widest_baseline(cameras)
    frame = Sim3(1 / size, W, -W @ np.mean([c.center for c in cameras], axis=0) / size)
    return tuple(map(frame.camera, cameras))
