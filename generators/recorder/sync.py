"""The synchrony of a capture's cameras, from the arrival times of their data.

For each camera a line is fitted to (ticks complete, time of arrival). Its slope against the nominal rate is the drift
of the camera's clock against the computer's, its height the time of tick 0. Operating system and bus can only delay an
arrival, often by milliseconds, so the fit uses medians (Theil and Sen): a third of the reads may be late without moving
it. Where frames have a common counter, it determines the ticks, and these figures are a check of it.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.generators.recorder.clips.clip import Clip

SUSPECT_PPM = 100.0  # crystals keep 50 ppm each: more means a rate that differs from the profile's, or lost data
_MOST_READS = 400  # of each camera that are used: all pairs of them are compared


@dataclass(frozen=True)
class ArrivalFit:
    """One camera's clock against the computer's. NaN where fewer than three reads ended."""

    camera: str
    drift_ppm: float  # time per tick over the nominal one, less 1; positive: the camera is slow
    drift_error_ppm: float  # standard error of it, from the scatter of the arrivals
    offset_us: float  # time of tick 0, less the array's median
    residual_us: float  # median distance of an arrival from the line
    worst_us: float  # largest one
    reads: int

    @property
    def suspect(self) -> bool:
        """True if the rate is off by more than crystals can be, beyond the scatter of the arrivals."""
        return abs(self.drift_ppm) - 3 * self.drift_error_ppm > SUSPECT_PPM


@dataclass(frozen=True)
class SyncReport:
    """The cameras' clocks, and the two that differ most in the time of the first or last tick."""

    method: str  # Clip.sync
    cameras: tuple[ArrivalFit, ...]
    worst_pair: tuple[str, str] | None
    worst_pair_us: float
    t0_ns: int | None  # CLOCK_MONOTONIC at tick 0, the median of the cameras

    def as_dict(self) -> dict[str, Any]:
        """Return the report for scene.json; unknown values are null."""
        return _without_nan(asdict(self) | {"suspect": [c.camera for c in self.cameras if c.suspect]})


def fit_arrival(clip: Clip, fps: float) -> SyncReport:
    """Fit every camera of a clip whose nominal rate is `fps` ticks per second."""
    nominal_ns = 1e9 / fps
    lines = {c.camera: _theil_sen(c.arrival.astype(np.float64)) for c in clip.cameras}
    known = {camera: line for camera, line in lines.items() if not math.isnan(line.slope)}
    middle = float(np.median([line.height for line in known.values()])) if known else math.nan
    fits = tuple(
        ArrivalFit(
            camera=camera,
            drift_ppm=(line.slope / nominal_ns - 1) * 1e6,
            drift_error_ppm=line.slope_error / nominal_ns * 1e6,
            offset_us=(line.height - middle) * 1e-3,
            residual_us=line.residual * 1e-3,
            worst_us=line.worst * 1e-3,
            reads=line.points,
        )
        for camera, line in lines.items()
    )
    worst, pair = math.nan, None
    for a, b in itertools.combinations(known, 2):
        start = known[a].height - known[b].height
        end = start + (known[a].slope - known[b].slope) * clip.n_ticks
        far = max(abs(start), abs(end)) * 1e-3
        if pair is None or far > worst:
            worst, pair = far, (a, b)
    return SyncReport(clip.sync, fits, pair, worst, round(middle) if known else None)


@dataclass(frozen=True)
class _Line:
    slope: float  # ns per tick
    slope_error: float
    height: float  # ns, at tick 0
    residual: float
    worst: float
    points: int


def _theil_sen(arrival: NDArray[np.float64]) -> _Line:
    """Return the median of all slopes between two of the points (tick, ns) [m, 2], and the median height."""
    if len(arrival) < 3 or np.ptp(arrival[:, 0]) == 0:
        return _Line(math.nan, math.nan, math.nan, math.nan, math.nan, len(arrival))
    used = arrival[np.linspace(0, len(arrival) - 1, min(len(arrival), _MOST_READS)).astype(int)]
    base = used[0, 1]  # CLOCK_MONOTONIC in ns needs more digits than the differences
    x, y = used[:, 0], used[:, 1] - base
    i, j = np.triu_indices(len(x), 1)
    apart = x[j] != x[i]
    slope = float(np.median((y[j] - y[i])[apart] / (x[j] - x[i])[apart]))
    rest = y - slope * x
    height = float(np.median(rest))
    away = np.abs(rest - height)
    residual = float(np.median(away))
    # Median absolute deviation -> standard deviation for normal scatter; medians use 64 % of it (hence pi / 2).
    error = 1.4826 * residual * math.sqrt(math.pi / 2) / (math.sqrt(len(x)) * float(np.std(x)))
    return _Line(slope, error, height + float(base), residual, float(away.max()), len(arrival))


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(v) for v in value]
    return None if isinstance(value, float) and math.isnan(value) else value
