"""A recording whose poses and clocks were checked against its clip, before a fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.recordings.clocks import Columns, survey_clocks
from spike4dgs.method.recordings.poses import survey_poses
from spike4dgs.method.recordings.recording import Recording

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
