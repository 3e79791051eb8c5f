"""The synchrony of a capture's cameras, from the arrival times of their data.

For each camera a line is fitted to (ticks complete, time of arrival). Its slope against the nominal rate is the drift
of the camera's clock against the computer's, its height the time of tick 0. Operating system and bus can only delay an
arrival, often by milliseconds, so the fit uses medians (Theil and Sen): a third of the reads may be late without moving
it. Where frames have a common counter, it determines the ticks, and these figures are a check of it.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.generators.recorder.frames.clip import Clip
from spike4dgs.generators.recorder.frames.layouts import Layout
from spike4dgs.generators.recorder.frames.ring import Block
from spike4dgs.generators.recorder.usb.reader import Reader

_EVERY_S = 0.2
_FRAMES = 4  # whose spikes are counted


@dataclass(frozen=True)
class Rate:
    """One camera's state, several times a second."""

    bytes_per_s: float
    ticks: int  # received since the trigger
    spikes_per_tick: float  # mean over the pixels of the newest frames, 0..1; NaN where they are not available
    backlog: int  # ring slots that wait
    lost_ticks: int  # for want of a free slot


class Rates:
    """Calls `on_rate` every 0.2 s, if there is one."""

    def __init__(
        self,
        layout: Layout,
        readers: Mapping[str, Reader],
        on_rate: Callable[[Mapping[str, Rate]], None] | None,
    ) -> None:
        self._layout, self._readers, self._on_rate = layout, readers, on_rate
        self._last_s = time.monotonic()
        self._last = {camera: reader.ring.position for camera, reader in readers.items()}

    def tell(self) -> None:
        """Call `on_rate` if the interval has passed."""
        now = time.monotonic()
        if self._on_rate is None or now - self._last_s < _EVERY_S:
            return
        rates = {}
        for camera, reader in self._readers.items():
            position, size = reader.ring.position, self._layout.frame_bytes
            rates[camera] = Rate(
                bytes_per_s=(position - self._last[camera]) / (now - self._last_s),
                ticks=(position - (reader.origin or 0)) // size,
                spikes_per_tick=spikes_per_tick(self._layout, reader.newest),
                backlog=reader.ring.waiting,
                lost_ticks=reader.ring.dropped // size,
            )
            self._last[camera] = position
        self._last_s = now
        self._on_rate(rates)


def spikes_per_tick(layout: Layout, block: Block | None) -> float:
    """Return the mean spikes per pixel and tick in a block's first whole frames; NaN where it has none."""
    if block is None or block.data is None:
        return math.nan
    size = layout.frame_bytes
    data = block.data[: (_FRAMES + 1) * size]
    start = layout.find(data) if layout.has_tags else -block.position % size
    n = (len(data) - start) // size if start >= 0 else 0
    if n < 1:
        return math.nan
    pixels = np.empty((n, layout.payload_bytes), np.uint8)
    layout.unpack(data[start : start + n * size].reshape(n, size), pixels)
    return int(np.bitwise_count(pixels).sum()) / (n * layout.width * layout.height)


SUSPECT_PPM = 100.0  # crystals keep 50 ppm each: more means a rate that differs from the profile's, or lost data
TELLING_PPM = 50.0  # a larger standard error than crystals' own differences tells nothing: the clip is too short
# In such a clip, delays that grow or shrink look like drift, many times beyond its standard error: up to 16 of them in
# 20 ms. Only a rate that is wrong altogether is a hundred away.
_ERRORS, _ERRORS_TOO_SHORT = 3, 100
_APART_US = 20_000.0  # a computer's delays reach it; cameras on one trigger start within microseconds
_READS, _SCATTERS = 2, 5  # within which cameras that cannot be stopped begin
_MOST_READS = 400  # of each camera that are used: all pairs of them are compared


@dataclass(frozen=True)
class ArrivalFit:
    """One camera's clock against the computer's. NaN where fewer than three reads ended, its error with three too."""

    camera: str
    drift_ppm: float  # time per tick over the nominal one, less 1; positive: the camera is slow
    drift_error_ppm: float  # standard error of it, from the scatter of the arrivals
    offset_us: float  # time of tick 0, less the array's median
    offset_ticks: float  # the same
    read_us: float  # the time of a read, the median
    residual_us: float  # median distance of an arrival from the line
    worst_us: float  # largest one
    reads: int

    @property
    def too_short(self) -> bool:
        """True if the clip cannot tell the drift of a crystal: its error is larger, or unknown."""
        return not self.drift_error_ppm <= TELLING_PPM

    @property
    def suspect(self) -> bool:
        """True if this is no camera of the array, with one trigger and one rate."""
        return self.wrong_rate or self.apart

    @property
    def apart(self) -> bool:
        """True if tick 0 is farther from the array's than reads and the scatter of the arrivals explain."""
        return abs(self.offset_us) > max(_APART_US, _READS * self.read_us + _SCATTERS * self.residual_us)

    @property
    def wrong_rate(self) -> bool:
        """True if the rate is off by more than crystals can be, beyond the scatter of the arrivals."""
        errors = _ERRORS_TOO_SHORT if self.too_short else _ERRORS
        return abs(self.drift_ppm) - errors * self.drift_error_ppm > SUSPECT_PPM

    @property
    def drift_text(self) -> str:
        """The drift for people, with its standard error, or that the clip is too short to tell."""
        if self.too_short and not self.wrong_rate:
            return "too short to tell"
        return f"{self.drift_ppm:+.0f} +- {self.drift_error_ppm:.0f}" + (" suspect" if self.wrong_rate else "")

    @property
    def offset_text(self) -> str:
        """The offset for people, in microseconds and ticks."""
        return f"{self.offset_us:+.0f} ({self.offset_ticks:+.0f})" + (" suspect" if self.apart else "")


@dataclass(frozen=True)
class SyncReport:
    """The cameras' clocks, and the two that differ most in the time of the first tick or of the last that both have."""

    method: str  # Clip.sync
    cameras: tuple[ArrivalFit, ...]
    worst_pair: tuple[str, str] | None
    worst_pair_us: float
    t0_ns: int | None  # CLOCK_MONOTONIC at tick 0, the median of the cameras

    def as_dict(self) -> dict[str, Any]:
        """Return the report for scene.json; unknown values are null."""
        return _without_nan(asdict(self) | {"suspect": [c.camera for c in self.cameras if c.suspect]})


def fit_arrival(clip: Clip, rate_hz: float) -> SyncReport:
    """Fit every camera of a clip whose nominal rate is `rate_hz` ticks per second."""
    nominal_ns = 1e9 / rate_hz
    lines = {c.camera: _theil_sen(c.arrival.astype(np.float64)) for c in clip.cameras}
    known = {camera: line for camera, line in lines.items() if not math.isnan(line.slope)}
    last = {c.camera: int(c.arrival[:, 0].max()) for c in clip.cameras if c.camera in known}
    middle = float(np.median([line.height for line in known.values()])) if known else math.nan
    fits = tuple(
        ArrivalFit(
            camera=camera,
            drift_ppm=(line.slope / nominal_ns - 1) * 1e6,
            drift_error_ppm=line.slope_error / nominal_ns * 1e6,
            offset_us=(line.height - middle) * 1e-3,
            offset_ticks=(line.height - middle) / nominal_ns,
            read_us=line.read_ticks * nominal_ns * 1e-3,
            residual_us=line.residual * 1e-3,
            worst_us=line.worst * 1e-3,
            reads=line.points,
        )
        for camera, line in lines.items()
    )
    worst, pair = math.nan, None
    for a, b in itertools.combinations(known, 2):
        start = known[a].height - known[b].height
        end = start + (known[a].slope - known[b].slope) * min(clip.n_ticks, last[a], last[b])
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
    read_ticks: float
    points: int


def _theil_sen(arrival: NDArray[np.float64]) -> _Line:
    """Return the median of all slopes between two of the points (tick, ns) [m, 2], and the median height."""
    if len(arrival) < 3 or np.ptp(arrival[:, 0]) == 0:
        return _Line(math.nan, math.nan, math.nan, math.nan, math.nan, math.nan, len(arrival))
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
    if len(x) < 4:  # the median slope of three is that of two, through which a line has no scatter
        error = math.nan
    read_ticks = float(np.median(np.diff(arrival[:, 0])))
    return _Line(slope, error, height + float(base), residual, float(away.max()), read_ticks, len(arrival))


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_nan(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_without_nan(v) for v in value]
    return None if isinstance(value, float) and math.isnan(value) else value
