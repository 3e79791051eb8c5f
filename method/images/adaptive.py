"""Adaptive windows: every pixel's rate over the longest window in which its light does not change.

Between two of its spikes a pixel gathers a whole number of thresholds of light, whatever the light does. With the
spikes i ... j in the window of h ticks on either side of tick t, the ones before and after t always among them, and
T = t_j - t_i ticks between them, the rate is

    r_h = (j - i) / T,    and under constant light it lies between (j - i) / (T + 1) and (j - i) / (T - 1),

for both spikes are known to the tick. A count over the same window would leave 1 / 2h to either side of j - i over 2h:
r_h is 1 / r_h times as precise.

Windows grow by half an octave each. A pixel takes the longest one before these bounds cease to have a point in common:
beyond it no constant light explains the spikes. The first bounds are those of the interval that t lies in. That no
spike fell there tells a dark stripe between bright ones. (It is the rule of intersecting confidence intervals, with
bounds that are certain but for shot noise.) A neighbour often sees a change that one pixel cannot see: of 3x3 pixels,
all take the shortest window. At rest the window is the whole clip; where things move it shrinks. At the clip's ends
windows are cut. A pixel with fewer than two spikes has their number / the clip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Float64, UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.spikes.bits import in_threads, kernel
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.spikes.times import spike_times
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.settings import Settings


@dataclass(frozen=True)
class AdaptiveSettings(Settings):
    """The windows that are tried, and the pixels that share one."""

    shortest: float = 2.0  # half length of the first window in ticks; the interval that t lies in is always seen
    growth: float = math.sqrt(2)  # of each next window: half an octave
    shared_px: int = 3  # side of the square of pixels that take one window: what one pixel misses, a neighbour may see

    def __post_init__(self) -> None:
        if not (self.shortest > 0 and self.growth > 1 and self.shared_px > 0 and self.shared_px % 2):
            expected = "shortest above 0, growth above 1, shared_px odd and above 0"
            raise problem("adaptive", expected, str(self), "correct the settings")


def half_windows(n_ticks: int, settings: AdaptiveSettings | None = None) -> NDArray[np.float64]:
    """Return the windows' half lengths in ticks, ascending; the last covers a clip of `n_ticks` from anywhere in it."""
    s = settings or AdaptiveSettings()
    steps = max(0, math.ceil(math.log(max(n_ticks, 1) / s.shortest, s.growth)))
    return np.asarray(s.shortest * s.growth ** np.arange(steps + 1), np.float64)


def adaptive_image(
    stream: SpikeStream, tick: int, settings: AdaptiveSettings | None = None, light: Float64 | None = None
) -> Float32:
    """Return spikes per tick [H, W] float32 at the start of `tick`, each over its pixel's own window.

    `light` [n_ticks] is what `images.light.Light.gathered` has of it; None: it is steady.
    """
    s = settings or AdaptiveSettings()
    levels = shared_levels(stream, tick, s, light)
    image = rates(stream, tick, s, levels, light).reshape(stream.height, stream.width)
    return image[::-1] if stream.rows_bottom_up else image


def rates(stream: SpikeStream, tick: int, s: AdaptiveSettings, levels: UInt8, light: Float64 | None = None) -> Float32:
    """Return spikes per tick [H * W] over the windows of `shared_levels`, in the stored order of pixels."""
    spikes, halves = spike_times(stream), half_windows(stream.n_ticks, s)
    image = np.empty(len(levels), np.float32)
    arguments = (spikes.ticks, spikes.starts, tick, halves, gathered(stream, light), levels, image)
    in_threads(_estimate, len(levels), *arguments, small=len(levels) < 1 << 12)
    return image


def gathered(stream: SpikeStream, light: Float64 | None) -> Float64:
    """Return the light gathered up to the middle of each tick [n_ticks]; of steady light where `light` is None."""
    return np.arange(0.5, stream.n_ticks) if light is None else light


def shared_levels(stream: SpikeStream, tick: int, s: AdaptiveSettings, light: Float64 | None = None) -> UInt8:
    """Return the window that each pixel takes [H * W], an index into `half_windows`, in the stored order of pixels."""
    spikes, halves = spike_times(stream), half_windows(stream.n_ticks, s)
    pixels = stream.height * stream.width
    level = np.empty(pixels, np.uint8)
    arguments = (spikes.ticks, spikes.starts, tick, halves, gathered(stream, light), level)
    in_threads(_choose, pixels, *arguments, small=pixels < 1 << 12)
    square = np.ones((s.shared_px, s.shared_px), np.uint8)
    return np.asarray(cv2.erode(level.reshape(stream.height, stream.width), square).reshape(-1), np.uint8)


@kernel
def _around(times: NDArray[np.int32], tick: int) -> tuple[int, int]:
    """Return the indices of the last spike before `tick` and of the first that is not; the nearest where none is."""
    after = int(np.searchsorted(times, tick))
    return max(after - 1, 0), min(after, len(times) - 1)


@kernel
def _choose(
    ticks: NDArray[np.int32],
    starts: NDArray[np.int64],
    tick: int,
    halves: NDArray[np.float64],
    light: NDArray[np.float64],
    level: UInt8,
    start: int,
    stop: int,
) -> None:
    """Set `level` to the longest window of each pixel up to which the bounds of all windows have a point in common."""
    for p in range(start, stop):
        times = ticks[starts[p] : starts[p + 1]]
        i, j = _around(times, tick)  # the first and the last spike of the window
        low, high = -np.inf, np.inf
        level[p] = len(halves) - 1
        for s in range(len(halves)):
            while i > 0 and times[i - 1] >= tick - halves[s]:
                i -= 1
            while j + 1 < len(times) and times[j + 1] < tick + halves[s]:
                j += 1
            if j - i < 1:
                continue
            length = light[times[j]] - light[times[i]]
            low, high = max(low, (j - i) / (length + 1)), min(high, (j - i) / (length - 1) if length > 1 else np.inf)
            if low > high:
                level[p] = s - 1
                break


@kernel
def _estimate(
    ticks: NDArray[np.int32],
    starts: NDArray[np.int64],
    tick: int,
    halves: NDArray[np.float64],
    light: NDArray[np.float64],
    level: UInt8,
    image: Float32,
    start: int,
    stop: int,
) -> None:
    """Set each pixel's rate over its window, or over the next longer one that has two spikes."""
    for p in range(start, stop):
        times = ticks[starts[p] : starts[p + 1]]
        image[p] = np.float32(len(times) / len(light))
        if len(times) < 2:
            continue
        before, after = _around(times, tick)
        for s in range(level[p], len(halves)):
            i = min(before, np.searchsorted(times, tick - halves[s]))
            j = max(after, np.searchsorted(times, tick + halves[s]) - 1)
            if j - i >= 1:
                image[p] = np.float32((j - i) / (light[times[j]] - light[times[i]]))
                break


ADAPTIVE = ImageMaker(
    name="adaptive",
    definition="(spikes - 1) / (ticks from the first to the last) over the longest window that a "
    "constant rate explains, of shared_px x shared_px pixels the shortest",
    source="this project; the rule is that of Goldenshluger and Nemirovski: On spatially adaptive estimation of "
    "nonparametric regression, Math. Methods Stat. 6, 1997",
    rate=adaptive_image,
    knows_light=True,
    settings=AdaptiveSettings(),
    label="from the longest windows of constant light",
)
