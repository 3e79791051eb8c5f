"""A recording whose clocks and given poses are checked against its clip before a fit, and used where they differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from spike4dgs.benchmark.metrics.pose_error import angle_deg
from spike4dgs.benchmark.scene.camera_state import Clock
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.images.light import estimate_light
from spike4dgs.method.recordings.recording import Recording
from spike4dgs.method.self_calibration.clock_fit import ClockSettings
from spike4dgs.method.self_calibration.clock_search import SearchSettings
from spike4dgs.method.self_calibration.clocks import (
    DEFAULTS,
    LEAST_CAMERAS,
    SEARCH,
    ArrayClocks,
    ClockEstimate,
    estimate_clocks,
    least_ticks,
)
from spike4dgs.method.self_calibration.poses import LEAST_POINTS, check_poses

Columns = Mapping[str, Mapping[str, str]]  # of the report's table of cameras: head -> camera -> cell
Surveyed = tuple[TrainingScene, tuple[str, ...], Columns]

LARGEST_ERROR_TICKS = 2.0  # with a larger standard error an offset is not used
SIGNIFICANT = 2.0  # standard errors by which a clock must differ from the array's
HALF_TICK = 0.5  # less changes no tick


def survey_clocks(
    scene: TrainingScene, settings: ClockSettings = DEFAULTS, search: SearchSettings = SEARCH
) -> Surveyed:
    """Return the scene with the clocks that its clip tells, notes, and columns for the report.

    It is the same scene where the clip tells nothing, where its light changes, or where the clocks agree.
    """
    if len(scene.cameras) < LEAST_CAMERAS or scene.n_ticks < least_ticks(settings):
        least = f"they need {LEAST_CAMERAS} cameras and {least_ticks(settings)} ticks"
        here = f"this clip has {len(scene.cameras)} and {scene.n_ticks}"
        return scene, (f"clocks: taken as given, because {least}; {here}",), {}
    if light_changes(scene.streams):
        return scene, ("clocks: taken as given, because the light changes",), {}
    found = estimate_clocks(scene, settings, search)
    told = {c: e for c, e in found.cameras.items() if e.error_ticks <= LARGEST_ERROR_TICKS}
    columns = _columns(found)
    if not told:
        best = min(e.error_ticks for e in found.cameras.values())
        text = f"too little moves to tell them (standard error {best:.1f} ticks and more)"
        return scene, (f"clocks: taken as given, because {text}",), columns
    worst = max(departure(e, scene.n_ticks) for e in told.values())
    if not any(_differs(e, scene.n_ticks) for e in told.values()):
        error = max(e.error_ticks for e in told.values())
        text = f"they agree within {worst:.2f} ticks (standard error {error:.2f})"
        return scene, (f"clocks: taken as given; estimated from what moves, {text}",), columns
    states = {**scene.states}
    for camera, e in told.items():
        states[camera] = replace(scene.state(camera), clock=e.clock)
    notes = [f"clocks: estimated from what moves, and used; cameras are up to {worst:.2f} ticks off their mean"]
    if lost := [c for c in found.cameras if c not in told]:
        notes.append(f"the clocks of {', '.join(lost)} are not told by the clip: taken as given")
    return replace(scene, states=states), tuple(notes), columns


def light_changes(streams: Sequence[SpikeStream]) -> bool:
    """Return whether the light changes in any camera's clip: flicker looks like motion, a period late like on time.

    Each is looked at for itself: clocks that differ would smear what all see together.
    """
    return any(estimate_light([stream], [Clock()]) is not None for stream in streams)


def departure(e: ClockEstimate, n_ticks: int) -> float:
    """Return by how many ticks a clock differs from the array's at most, within the clip."""
    return max(abs(e.clock.local(t) - t) for t in (0, n_ticks))


def _differs(e: ClockEstimate, n_ticks: int) -> bool:
    """Return whether a clock differs by more than half a tick, and by more than its errors explain."""
    half = 0.5 * n_ticks
    error = (e.error_ticks**2 + (e.error_ppm * 1e-6 * half) ** 2) ** 0.5
    off = abs(e.middle_ticks) > max(HALF_TICK, SIGNIFICANT * e.error_ticks)
    return off or departure(e, n_ticks) > max(HALF_TICK, SIGNIFICANT * error)


def _columns(found: ArrayClocks) -> Columns:
    cameras = found.cameras.items()
    return {
        "clock, ticks": {c: f"{e.middle_ticks:+.2f} ± {e.error_ticks:.2f}" for c, e in cameras},
        "drift, ppm": {c: f"{e.clock.drift_ppm:+.0f} ± {e.error_ppm:.0f}" for c, e in cameras},
    }


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


Source = Literal["auto", "given"]


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A recording to fit, the cameras as they were given, what was changed, and columns for the report."""

    recording: Recording
    given: tuple[Camera, ...]
    changed: tuple[str, ...]  # of "poses" and "clocks"
    columns: Columns


def self_calibrated(recording: Recording, poses: Source, clocks: Source, seed: int) -> Calibrated:
    """Return the recording with its poses and then its clocks checked, unless they are to be taken as given."""
    given, changed, columns = recording.training.cameras, [], dict[str, dict[str, str]]()
    surveys = {
        "poses": lambda scene: survey_poses(scene, seed),
        "clocks": survey_clocks,
    }
    for name, source in (("poses", poses), ("clocks", clocks)):
        if source == "given":
            continue
        scene, notes, found = surveys[name](recording.training)
        if scene is not recording.training:
            changed.append(name)
        recording = replace(recording, training=scene, notes=(*recording.notes, *notes))
        columns |= {head: dict(cells) for head, cells in found.items()}
    return Calibrated(recording, given, tuple(changed), columns)
