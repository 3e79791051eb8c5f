"""The cameras' clocks of a recording, before a fit: estimated from the clip, and used where they differ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from spike4dgs.benchmark.scene.scene import TrainingScene
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

Columns = Mapping[str, Mapping[str, str]]  # of the report's table of cameras: head -> camera -> cell
Surveyed = tuple[TrainingScene, tuple[str, ...], Columns]

LARGEST_ERROR_TICKS = 2.0  # with a larger standard error an offset is not used
SIGNIFICANT = 2.0  # standard errors by which a clock must differ from the array's
HALF_TICK = 0.5  # less changes no tick


def survey_clocks(
    scene: TrainingScene, settings: ClockSettings = DEFAULTS, search: SearchSettings = SEARCH
) -> Surveyed:
    """Return the scene with the clocks that its clip tells, notes, and columns for the report.

    It is the same scene where the clip tells nothing, or where the clocks agree.
    """
    if len(scene.cameras) < LEAST_CAMERAS or scene.n_ticks < least_ticks(settings):
        least = f"{LEAST_CAMERAS} cameras and {least_ticks(settings)} ticks"
        return scene, (f"clocks: taken as given, because less than {least} tell nothing about them",), {}
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
