"""Adaptive windows: every pixel's rate over the longest window in which its light does not change.

Between two of its spikes a pixel gathers a whole number of thresholds of light, whatever the light does. With the
spikes i ... j in the window of h ticks on either side of tick t, the ones before and after t always among them, and
T = t_j - t_i ticks between them, the rate is

    r_h = (j - i) / T,    and under constant light it lies between (j - i) / (T + 1) and (j - i) / (T - 1),

for both spikes are known to the tick. A count over the same window would leave 1 / 2h to either side of j - i over 2h:
r_h is 1 / r_h times as precise. Of a recording that lacks ticks, rates and bounds are those of `lost_spikes`.

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
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Float64, Int64, UInt8, UInt32, UInt64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.spikes.bits import in_threads, kernel
from spike4dgs.benchmark.spikes.lost_spikes import doubtful_between, fewest, most
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.spikes.trains import count_before, first_from, last_before, spike_trains
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.images.light import PixelLight, steady
from spike4dgs.method.settings import Settings

_MOST_WINDOWS = 256  # a pixel's own is a number of 8 bits


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
    """Return the windows' half lengths in ticks, ascending; the last covers a clip of `n_ticks` from anywhere in it.

    Raises UserError where more than 256 are needed.
    """
    s = settings or AdaptiveSettings()
    steps = max(0, math.ceil(math.log(max(n_ticks, 1) / s.shortest, s.growth)))
    if steps >= _MOST_WINDOWS:
        expected = f"at most {_MOST_WINDOWS} windows for a clip of {n_ticks} ticks"
        raise problem("adaptive", expected, f"{steps + 1} with {s}", "raise growth or shortest")
    return np.asarray(s.shortest * s.growth ** np.arange(steps + 1), np.float64)


def adaptive_image(
    stream: SpikeStream, tick: int, settings: AdaptiveSettings | None = None, light: PixelLight | None = None
) -> Float32:
    """Return spikes per tick [H, W] float32 at the start of `tick`, each over its pixel's own window.

    They are those of mean light, or of the tick's own where `light` has shares; None: light is steady.
    """
    s = settings or AdaptiveSettings()
    levels = shared_levels(stream, tick, s, light)
    image = rates(stream, tick, s, levels, light).reshape(stream.height, stream.width)
    return image[::-1] if stream.rows_bottom_up else image


def rates(
    stream: SpikeStream, tick: int, s: AdaptiveSettings, levels: UInt8, light: PixelLight | None = None
) -> Float32:
    """Return spikes per tick [H * W] over the windows of `shared_levels`, in the stored order of pixels."""
    image = np.empty(len(levels), np.float32)
    arguments = (*_arguments(stream, tick, s, light), levels, image)
    in_threads(_estimate, len(levels), *arguments, small=len(levels) < 1 << 12)
    if light and len(light.shares):
        image *= light.at(tick)
    return image


def shared_levels(stream: SpikeStream, tick: int, s: AdaptiveSettings, light: PixelLight | None = None) -> UInt8:
    """Return the window that each pixel takes [H * W], an index into `half_windows`, in the stored order of pixels."""
    pixels = stream.height * stream.width
    level = np.empty(pixels, np.uint8)
    in_threads(_choose, pixels, *_arguments(stream, tick, s, light), level, small=pixels < 1 << 12)
    square = np.ones((s.shared_px, s.shared_px), np.uint8)
    return np.asarray(cv2.erode(level.reshape(stream.height, stream.width), square).reshape(-1), np.uint8)


def _arguments(stream: SpikeStream, tick: int, s: AdaptiveSettings, light: PixelLight | None) -> tuple[Any, ...]:
    """Return what both kernels take: the trains, its light, the tick, and the windows' ticks [starts, stops)."""
    trains, halves = spike_trains(stream), half_windows(stream.n_ticks, s)
    edges = np.ceil([tick - halves, tick + halves]).clip(0, stream.n_ticks).astype(np.int64)
    own = light or steady(stream.n_ticks)
    return *trains.arrays, own.gathered, own.shares, tick, *edges


@kernel
def _between(light: Float64, shares: Float32, p: int, first: int, last: int) -> float:
    """Return the light that a pixel's scene gets between two ticks; `light` is that of all pixels without shares."""
    length = light[last] - light[first]
    if len(shares) > 0:
        length = (last - first) + shares[p] * (length - (last - first))
    return length


@kernel
def _of_a_tick(light: Float64, shares: Float32, p: int, first: int, last: int) -> float:
    """Return by how much `_between` is off at most: half the light of both ticks, as a spike is anywhere in its own."""
    share, end = shares[p] if len(shares) > 0 else 1.0, len(light) - 1
    a, b = min(max(first, 1), end - 1), min(max(last, 1), end - 1)  # the clip's first and last tick as their neighbours
    both = light[a + 1] - light[a - 1] + light[b + 1] - light[b - 1]
    return max(1.0, 1 + share * (both / 4 - 1))


@kernel
def _choose(
    words: UInt64,
    before: UInt32,
    lost: Int64,
    doubt_words: UInt64,
    doubt_before: UInt32,
    light: Float64,
    shares: Float32,
    tick: int,
    starts: Int64,
    stops: Int64,
    level: UInt8,
    start: int,
    stop: int,
) -> None:
    """Set `level` to the longest window of each pixel up to which the bounds of all windows have a point in common."""
    for p in range(start, stop):
        level[p] = len(starts) - 1
        total, after = count_before(words, before, p, len(light)), count_before(words, before, p, tick)
        if total < 2:
            continue
        # The window's first and last spike, by number and tick: the nearest ones, until a window holds more.
        i, j = max(after - 1, 0), min(after, total - 1)
        first = last_before(words, p, tick) if after > 0 else first_from(words, p, tick)
        last = first_from(words, p, tick) if after < total else last_before(words, p, tick)
        low, high = -np.inf, np.inf
        wider = True
        for s in range(len(starts)):
            k = count_before(words, before, p, starts[s]) if i > 0 else 0
            if k < i:
                i, first, wider = k, first_from(words, p, starts[s]), True
            k = count_before(words, before, p, stops[s]) - 1 if j + 1 < total else j
            if k > j:
                j, last, wider = k, last_before(words, p, stops[s]), True
            if wider and j > i:
                length = _between(light, shares, p, first, last)
                doubt, filled = 0, 0
                if lost[last] > lost[first]:
                    doubt, filled = doubtful_between(lost, doubt_words, doubt_before, p, first, last)
                off = _of_a_tick(light, shares, p, first, last)
                low = max(low, fewest(j - i, filled, doubt) / (length + off))
                high = min(high, most(j - i, filled, doubt) / (length - off) if length > off else np.inf)
                if low > high:
                    level[p] = s - 1
                    break
            wider = False


@kernel
def _estimate(
    words: UInt64,
    before: UInt32,
    lost: Int64,
    doubt_words: UInt64,
    doubt_before: UInt32,
    light: Float64,
    shares: Float32,
    tick: int,
    starts: Int64,
    stops: Int64,
    level: UInt8,
    image: Float32,
    start: int,
    stop: int,
) -> None:
    """Set each pixel's rate over its window, or over the next longer one that has two spikes."""
    for p in range(start, stop):
        total, after = count_before(words, before, p, len(light)), count_before(words, before, p, tick)
        filled = 0
        if lost[-1] > 0:
            _, filled = doubtful_between(lost, doubt_words, doubt_before, p, 0, len(light))
        image[p] = np.float32((total + filled) / len(light))
        if total < 2:
            continue
        for s in range(level[p], len(starts)):
            i = min(max(after - 1, 0), count_before(words, before, p, starts[s]))
            j = max(min(after, total - 1), count_before(words, before, p, stops[s]) - 1)
            if j > i:
                # The spikes next to `tick` count even where the window is too short for them.
                first = last_before(words, p, tick) if i + 1 == after else first_from(words, p, starts[s])
                last = first_from(words, p, tick) if j == after else last_before(words, p, stops[s])
                filled = 0
                if lost[last] > lost[first]:
                    _, filled = doubtful_between(lost, doubt_words, doubt_before, p, first, last)
                image[p] = np.float32((j - i + filled) / _between(light, shares, p, first, last))
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
