"""The clocks of an array's cameras from a clip: a search for first offsets, and a fit from there."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.calibration import Recordings
from spike4dgs.benchmark.scene.camera_state import Clock
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.self_calibration.clock_fit import (
    DRIFT,
    NUMBERS,
    OFFSET,
    ClockFit,
    ClockSettings,
    fit_clocks,
    from_clock,
    reach_ticks,
    to_clock,
)
from spike4dgs.method.self_calibration.clock_search import SearchSettings, search_offsets
from spike4dgs.method.self_calibration.patches import viewers
from spike4dgs.method.starts.clip import window_means
from spike4dgs.method.starts.plane_sweep import find_range
from spike4dgs.method.training_views.pinholes import as_pinholes

LEAST_CAMERAS = 3  # with two, another depth looks like another time
# What is left where noise is not: edges of things, shine, surfaces that are no planes. Measured on clean scenes.
SYSTEMATIC_PX = 0.015

DEFAULTS, SEARCH = ClockSettings(), SearchSettings()


@dataclass(frozen=True)
class ClockEstimate:
    """A camera's clock beside the array's; standard errors are of the offset at the clip's middle, and of the drift."""

    clock: Clock
    middle_ticks: float  # the offset at the middle of the clip
    error_ticks: float
    error_ppm: float


@dataclass(frozen=True, eq=False)
class ArrayClocks:
    """The clocks of all cameras, whose mean is the array's, and what they were told from."""

    cameras: Mapping[str, ClockEstimate]
    px_per_tick: float  # at which things move in the patches that moved; noise alone moves them a little too
    patches: int  # in which something moved


def least_ticks(settings: ClockSettings = DEFAULTS) -> int:
    """Return the length of the shortest clip that clocks can be told from."""
    return 4 * reach_ticks(settings)


def estimate_clocks(scene: TrainingScene, s: ClockSettings = DEFAULTS, search: SearchSettings = SEARCH) -> ArrayClocks:
    """Return the clocks of the training cameras, from nothing but the clip and the poses.

    Raises UserError for fewer than three cameras, or a clip that is too short.
    """
    if len(scene.cameras) < LEAST_CAMERAS or scene.n_ticks < least_ticks(s):
        expected = f"{LEAST_CAMERAS} cameras and {least_ticks(s)} ticks or more"
        found = f"{len(scene.cameras)} and {scene.n_ticks}"
        raise problem(f"clocks of {scene.id}", expected, found, "give the clocks, or record a longer clip")
    scene = as_pinholes(scene)
    seen, planes = viewers(scene), _planes(scene)
    return _described(scene, fit_clocks(seen, search_offsets(seen, planes, search, s), planes, s))


def clock_of_another(
    scene: TrainingScene,
    camera: Camera,
    stream: SpikeStream,
    recordings: Recordings | None = None,
    s: ClockSettings = DEFAULTS,
    search: SearchSettings = SEARCH,
) -> ClockEstimate:
    """Return the clock of a camera that `scene`, whose clocks are known, does not have: a held-out one.

    All clocks are estimated together, and the array's is the one on which the known cameras are right on average.
    """
    found = estimate_clocks(with_camera(scene, camera, stream, recordings), s, search)
    middle = 0.5 * scene.n_ticks
    given = np.array([from_clock(scene.state(c.id).clock, scene.n_ticks) for c in scene.cameras])
    seen = np.array([from_clock(found.cameras[c.id].clock, scene.n_ticks) for c in scene.cameras])
    shift, drift = (given - seen).mean(axis=0)
    own = found.cameras[camera.id]
    offset, own_drift = from_clock(own.clock, scene.n_ticks)
    numbers = np.array([offset + shift, own_drift + drift])
    clock = to_clock(numbers, scene.n_ticks)
    return replace(own, clock=clock, middle_ticks=clock.local(middle) - middle)


def with_camera(
    scene: TrainingScene, camera: Camera, stream: SpikeStream, recordings: Recordings | None
) -> TrainingScene:
    """Return a scene with one more camera, the last."""
    known = scene.recordings or (None,) * len(scene.cameras)
    cameras, streams = (*scene.cameras, camera), (*scene.streams, stream)
    return replace(scene, cameras=cameras, streams=streams, recordings=(*known, recordings))


def _planes(scene: TrainingScene) -> NDArray[np.float64]:
    """Return the inverse depths at which things may be."""
    return find_range(scene.cameras, window_means(scene, 0, scene.n_ticks, flat_field=bool(scene.calibrations)))


def _described(scene: TrainingScene, fit: ClockFit) -> ArrayClocks:
    errors = np.sqrt(np.diag(fit.covariance)).reshape(-1, NUMBERS)
    systematic = SYSTEMATIC_PX / max(fit.px_per_tick, 1e-9)
    ppm = 1e6 / (0.5 * scene.n_ticks)
    cameras = {
        camera.id: ClockEstimate(
            to_clock(row, scene.n_ticks),
            float(row[OFFSET]),
            math.hypot(float(error[OFFSET]), systematic),
            math.hypot(float(error[DRIFT]), systematic) * ppm,
        )
        for camera, row, error in zip(scene.cameras, fit.numbers, errors, strict=True)
    }
    return ArrayClocks(cameras, fit.px_per_tick, fit.moving)
