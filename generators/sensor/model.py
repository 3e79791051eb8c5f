"""The spike camera: radiance key frames in, packed spikes out, in one pass.

Model (subtractive integrate-and-fire, constants in `benchmark.spikes.sensor_model`). In a tick a pixel gains the charge

    increment = gain * radiance_gain * (mean radiance over the tick) + dark

in units of the firing threshold, limited to [0, 1]; at charge >= 1 it fires and the charge drops by 1, so the rest is
kept. At most one spike a tick: a pixel that would gain more than one threshold in a tick is saturated, fires in every
tick, and the surplus is lost (the well is full), so it recovers at once when the light drops.

Photons arrive at random. With N photons to a threshold, the charge that is expected when the k-th spike fires is the
sum of k independent Gamma(N) / N variables, exactly, whatever the light does; so shot noise costs one random number for
each spike, not for each tick: a spike takes the charge 1 + g / sqrt(N) instead of 1, with g from a sum of four bytes
(mean 0, variance 1, excess kurtosis -0.3, |g| < 3.46) where Gamma's is Gaussian up to a skewness of 2 / sqrt(N). g is a
hash of (seed, pixel, tick), so it does not depend on batches or threads. The limit to a tick's charge is then not 1 but
the most that a spike takes, 1 + 3.46 / sqrt(N), so that a pixel in glaring light still fires in every tick. Reset noise
(kTC) is the random part of the charge that a reset takes: the variance of a spike's charge is 1 / N + reset_noise^2.

Three effects have a slower loop (`sensor.uneven_kernels`). Read noise is the comparator's: in every tick it sees the
charge plus read_noise times such a g, so a spike comes early or late, but the charge that a spike takes stays 1 and the
error does not add up. With dead ticks a pixel collects no light for so long after its charge has crossed the threshold,
from the very moment inside the tick. A charge that takes 1 / x ticks to fill then gives intervals of dead_ticks + 1 / x
in the mean: the rate is x / (1 + x dead_ticks), and light is proportional to 1 / (interval - dead_ticks). With one dead
tick x has no limit below MOST_CHARGE thresholds a tick, and bright pixels may fire in adjacent ticks. A clip begins
amid such intervals: pixels are in all phases of them, as if the light of the first key had been there before. The
readout clock couples into the comparator: a crossing of the threshold a ticks before the tick ends takes the charge
1 - clock_ripple w(a), w(a) = 6 sqrt(3) a (1 - a) (1 - 2 a), a cubic like a sine with extremes 1 and -1. A crossing near
a tick's border moves away from it, so pixels lock: where a charge of x a tick takes 1 / x within about clock_ripple / x
of a whole number of ticks, every interval has that number. The mean of w is 0, and light keeps its law elsewhere.

Radiance between keys is a cubic Hermite (Catmull-Rom) curve: the tangent at a key is the slope between its neighbours,
in the first and last interval the slope of that interval itself. With p0..p3 the keys around the interval from p1 to p2
of n ticks, d = p - p1, m1 and m2 the tangents times n, and u = (tick - first tick + 1/2) / n, the mean over a tick is

    p1 + a2/(12 n^2) + (m1 + a3/(4 n^2)) u + a2 u^2 + a3 u^3,   a2 = 3 d2 - 2 m1 - m2,   a3 = m1 + m2 - 2 d2

exactly (the 1/12 and 1/4 are the tick's own width), and is then clamped to the range of p1 and p2: no overshoot.

Numbers. Charge is an integer in units of 2^-31 (a little larger with shot noise, which needs room below zero), so
adding up loses nothing however long the clip; the sign bit of the 32-bit sum is the spike. Increments of 64 pixels in a
row that do not change over four keys are computed in float64 and rounded down to a unit. Others are computed in
float32, each off by less than 2^-22 of the largest key around it: over N ticks the charge differs from exact arithmetic
by less than N 2^-22 (0.024 at N = 10^5) in unsaturated light, the count by at most one spike. No fused multiply-add is
used, so every processor gives the same bits.
`sensor.reference` is the slow twin, `sensor.kernels` the inner loop.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Float64, Int32, UInt8
from spike4dgs.benchmark.environment import available_cores
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.spikes.sensor_model import SENSOR, THRESHOLD, charge_of_tick
from spike4dgs.benchmark.spikes.stream import bytes_per_tick
from spike4dgs.generators.sensor.kernels import BLOCK, STRIP, integrate
from spike4dgs.generators.sensor.uneven_kernels import integrate_uneven, steady_start

Keys = Sequence[Float32] | Float32  # K images [H, W]; read one at a time, in order, so a lazy sequence is enough

DEVIATE_SD = 21845**0.5  # of `sensor.kernels.deviate`
MOST_DEVIATION = 510 / DEVIATE_SD
MOST_CHARGE = 16  # thresholds that a tick adds at most where a pixel rests after a spike: 0.94 spikes per tick
_BATCH_BYTES = 16 << 20  # of key frames in memory at a time


@dataclass(frozen=True, eq=False)
class Sensor:
    """The response of one camera to light; None is off, and costs nothing.

    Attributes:
        radiance_gain: spikes per tick of a pixel that sees radiance 1.
        gain: [H, W], relative sensitivity, mean 1.
        dark: [H, W], spikes per tick in the dark.
        photons: number of photons per spike, for shot noise; at least 100.
        noise_seed: seed of the noise.
        reset_noise: standard deviation of the charge that a reset takes, in thresholds.
        read_noise: standard deviation of the comparator's error in a tick, in thresholds.
        dead_ticks: ticks after a crossing of the threshold in which a pixel collects no light.
        clock_ripple: how much more or less charge a spike takes, by where in the tick it fell, in thresholds.
    """

    radiance_gain: float = SENSOR.radiance_gain
    gain: Float32 | None = None
    dark: Float32 | None = None
    photons: float | None = None
    noise_seed: tuple[int, ...] = ()
    reset_noise: float = 0.0
    read_noise: float = 0.0
    dead_ticks: float = 0.0
    clock_ripple: float = 0.0

    @property
    def spent_sd(self) -> float:
        """Standard deviation of the charge that a spike takes, in thresholds."""
        return math.hypot(self.photons**-0.5 if self.photons else 0.0, self.reset_noise)

    @property
    def most_over(self) -> float:
        """The most that a spike takes above one threshold, in thresholds."""
        return self.spent_sd * MOST_DEVIATION + self.clock_ripple

    @property
    def is_uneven(self) -> bool:
        """True where spikes come at other ticks than the charge's, or take other charges than shot noise's."""
        return self.read_noise > 0 or self.dead_ticks > 0 or self.clock_ripple > 0

    @property
    def noise_key(self) -> int:
        """32 bits for `deviate`."""
        return int(np.random.SeedSequence(self.noise_seed).generate_state(1)[0])


def random_charge(height: int, width: int, entropy: Sequence[int]) -> Int32:
    """Return initial charges [H, W], uniform in [0, threshold), a function of `entropy` (seed, camera, ...) alone."""
    bits = np.random.PCG64(np.random.SeedSequence(list(entropy))).random_raw(height * width)
    return np.asarray(bits >> np.uint64(33)).astype(np.int32).reshape(height, width)


def simulate(
    keys: Keys,
    key_ticks: Sequence[int],
    n_ticks: int,
    sensor: Sensor,
    charge: Int32,
    *,
    means: bool = False,
    threads: int | None = None,
) -> Iterator[UInt8]:
    """Yield the spikes of ticks 0 .. n_ticks - 1 as packed rows [n, bytes_per_tick] in the file layout (bottom-up).

    `keys[k]` is the radiance [H, W] at the start of tick `key_ticks[k]`; key 0 is at tick 0, the last at or after
    `n_ticks`. With `means`, key k is the mean radiance of tick k instead: one key for each tick, no interpolation.
    `charge` [H, W] is the charge before the first tick (`random_charge`); it is not changed. With dead ticks it is the
    share that is over of a pixel's interval.
    Only one batch of keys (16 MiB, at least four keys) is held at a time. The bytes do not depend on `threads`
    (default: all cores of the process). Raises UserError for keys, ticks or maps that do not fit together, and for
    radiance that is not finite.
    """
    ticks = np.asarray(key_ticks, dtype=np.int64)
    height, width = charge.shape
    if means:  # the end of the last tick
        ticks = np.append(ticks, ticks[-1:] + 1)
    _check(keys, ticks, n_ticks, sensor, charge, means)
    threads = threads or available_cores()
    blocks = -(-height * width // BLOCK)
    state = np.zeros(blocks * BLOCK, dtype=np.int32)
    head, unit, noise = _noise_units(sensor)
    level, left = _start(keys, sensor, charge)
    # without noise `unit` is 2^31 and this changes nothing
    _store((level * (unit / THRESHOLD) + head * unit).astype(np.int32), state)
    gain, dark = _stored_map(sensor.gain, 1.0, blocks), _stored_map(sensor.dark, 0.0, blocks)
    per_batch = max(1, _BATCH_BYTES // (4 * len(state)))
    n_intervals = int(np.searchsorted(ticks, n_ticks))
    window = np.zeros((per_batch + 3, len(state)), dtype=np.float32)
    tangents, bounds = _tangent_weights(ticks), _shares(blocks, threads)
    loops: dict[bool, Callable[..., Any]] = {False: integrate, True: integrate_uneven}
    loop = loops[sensor.is_uneven]
    more: tuple[Any, ...] = ()
    if sensor.is_uneven:
        state = state.astype(np.int64)
        top, rest = np.int64(head * unit + unit if sensor.dead_ticks else THRESHOLD), np.zeros(len(state))
        _store(left, rest)
        more = _steps(sensor.read_noise, unit), top, float(sensor.dead_ticks), sensor.clock_ripple * unit, rest
    with ThreadPoolExecutor(threads) as pool:
        for first in range(0, n_intervals, per_batch):
            last = min(first + per_batch, n_intervals)
            _fill(window, keys, first, last, len(keys), charge.shape)
            end = min(int(ticks[last]), n_ticks)
            words = np.empty((end - ticks[first], blocks), dtype=np.uint64)
            batch = window, ticks[first : last + 1], tangents[first:last]
            camera = sensor.radiance_gain, gain, dark, state, unit, noise, np.uint32(sensor.noise_key), means
            work = partial(loop, *batch, *camera, *more, words)
            jobs = [pool.submit(work, a, b) for a, b in itertools.pairwise(bounds)]
            for job in jobs:
                job.result()
            yield words.view(np.uint8)[:, : bytes_per_tick(width, height)]


def _start(keys: Keys, sensor: Sensor, charge: Int32) -> tuple[NDArray[Any], Float64]:
    """Return the charge [H, W] before the first tick, in units of 2^-31, and how many dead ticks are left."""
    if not sensor.dead_ticks:
        return charge, np.zeros(charge.shape)
    light = sensor.radiance_gain * _key(keys, 0, charge.shape).astype(np.float64)
    light = light if sensor.gain is None else light * sensor.gain
    gathered = charge_of_tick(light, 0.0 if sensor.dark is None else sensor.dark, MOST_CHARGE + sensor.most_over)
    level, left = steady_start(charge / THRESHOLD, gathered, sensor.dead_ticks)
    return level * THRESHOLD, left


def _noise_units(sensor: Sensor) -> tuple[float, float, np.int32]:
    """Return the room below zero in thresholds, and the charge units of a threshold and of one step of `deviate`."""
    head = sensor.most_over
    most = MOST_CHARGE if sensor.dead_ticks else 1
    unit = float(np.floor(THRESHOLD / (most + head)))
    return head, unit, _steps(sensor.spent_sd, unit)


def _steps(sd: float, unit: float) -> np.int32:
    """Return the charge units of a step of `deviate` for noise of `sd` thresholds."""
    return np.int32(sd * unit / DEVIATE_SD)  # rounded down: a spike never takes more than there is


def _check(keys: Keys, ticks: NDArray[np.int64], n_ticks: int, sensor: Sensor, charge: Int32, means: bool) -> None:
    if sensor.photons is not None and sensor.photons < 100:
        raise problem("photons per spike", "at least 100", str(sensor.photons), "give 50000, or None for no noise")
    if means and (np.diff(ticks) != 1).any():
        raise problem("key frames", "the mean of every tick", "ticks with more than one between", "give one key a tick")
    if (
        len(keys) + means != len(ticks)
        or len(ticks) < 2
        or ticks[0] != 0
        or (np.diff(ticks) < 1).any()
        or ticks[-1] < n_ticks
    ):
        found = f"{len(keys)} keys, {len(ticks)} ascending ticks from {ticks[:1]} to {ticks[-1:]}, a clip of {n_ticks}"
        raise problem(
            "key frames", "one key per tick, from 0 to the clip's end or later", found, "correct the key ticks"
        )
    for name, image in (("gain map", sensor.gain), ("dark map", sensor.dark), ("first key frame", keys[0])):
        if image is not None and image.shape != charge.shape:
            raise problem(name, f"[H, W] = {charge.shape}", str(image.shape), "use one resolution for all")


def _store(image: NDArray[Any], out: NDArray[Any]) -> None:
    """Copy an upright image [H, W] into file order: rows bottom-up, flat."""
    out[: image.size].reshape(image.shape)[:] = image[::-1]


def _stored_map(image: Float32 | None, off: float, blocks: int) -> Float32:
    """Return a map in file order; where it is off, one block of constants, which never leaves the first-level cache."""
    if image is None:
        return np.full(BLOCK, off, dtype=np.float32)
    stored = np.zeros(blocks * BLOCK, dtype=np.float32)
    _store(image, stored)
    return stored


def _fill(window: Float32, keys: Keys, first: int, last: int, n_keys: int, shape: tuple[int, ...]) -> None:
    """Put keys first - 1 .. last + 1 (repeated at the clip's ends) into rows 0 .. of `window`."""
    kept = 0
    if first > 0:  # the last three rows of the batch before are the first three of this one
        kept = 3
        window[:3] = window[-3:]
    for row in range(kept, last - first + 3):
        k = min(max(first - 1 + row, 0), n_keys - 1)
        _store(_key(keys, k, shape), window[row])


def _key(keys: Keys, k: int, shape: tuple[int, ...]) -> Float32:
    image = np.asarray(keys[k], dtype=np.float32)
    if image.shape != shape:
        raise problem(f"key frame {k}", f"[H, W] = {shape}", str(image.shape), "use one resolution for all")
    if not np.isfinite(image).all():  # as an integer charge it would be any number
        raise problem(f"key frame {k}", "finite radiance", "NaN or infinity", "render it again")
    return image


def _tangent_weights(ticks: NDArray[np.int64]) -> Float32:
    """Return weights [K - 1, 2] that turn p2 - p0 and p3 - p1 into the tangents of an interval, times its length.

    At the clip's ends the missing key repeats its neighbour and the weight is 1: the slope of the interval itself.
    """
    padded = np.concatenate([ticks[:1], ticks, ticks[-1:]])
    length = np.diff(ticks)
    spans = padded[2:] - padded[:-2]  # around each key
    return np.stack([length / spans[:-1], length / spans[1:]], axis=1).astype(np.float32)


def _shares(blocks: int, threads: int) -> list[int]:
    """Return bounds of the threads' ranges of blocks, at whole strips so that no cache line has two writers."""
    strips = -(-blocks // STRIP)
    return [min(blocks, strips * t // threads * STRIP) for t in range(threads + 1)]
