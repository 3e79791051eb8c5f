"""Light that is not the whole scene's: a lamp's course, and the share of it that each pixel sees.

A camera sees R(x, t) = M(x) (1 + s(x) (f(t) - 1)): the mean M, the course f of a lamp with mean 1, and its share s of
the light of what is there. Where nothing moves both are known in closed form. A pixel gathers exactly j thresholds up
to its spike j, in tick t_j, so with F the integral of f

    j = a + M (t_j + 1/2) + M s (F(t_j + 1/2) - (t_j + 1/2)),

up to a part of a threshold: three unknowns, by least squares over all its spikes. Rates over windows would have the
rounding of each. In turn the spikes of all still pixels in a tick give f there: sums of s (spikes - M), up to a scale
and a constant. It begins as the course that blocks show (`light`), of which only the form matters.

The lamp may be never off. As nothing tells, f is taken as 0 where it is darkest.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from spike4dgs.benchmark.arrays import Float32, Float64, Int64, UInt32, UInt64
from spike4dgs.benchmark.scene.camera_state import Clock, local_window
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.bits import in_threads, kernel
from spike4dgs.benchmark.spikes.lost_spikes import doubtful_between
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.spikes.trains import count_before, first_from, spike_trains
from spike4dgs.method.images.light import Light, PixelLight, estimate_light

_ROUNDS = 2  # of shares and course: the second mends what blocks and their longer windows blur
_FEWEST = 5  # spikes of a pixel that can tell three unknowns
_STILL = 0.2  # thresholds RMS, at most, that a still pixel's spikes are off: most are by less than 0.1


def light_of(scene: TrainingScene, by_parts: bool) -> Light | None:
    """Return what changes in the light of a scene, and say so on stderr; None: it is steady.

    Not `by_parts`: one course is taken for all light, whatever the clip shows.
    """
    clocks = [scene.state(camera.id).clock for camera in scene.cameras]
    light = estimate_light(scene.streams, clocks)
    if light is None:
        return None
    if by_parts and light.local and (light := lamp(scene.streams, clocks, light)).local:
        print("the light of a part of the scene changes: fitted with a share for each Gaussian", file=sys.stderr)
        return light
    spread = 100 * float(np.std(light.factors))
    print(f"the light changes by {spread:.1f} % RMS: fitted in its mean", file=sys.stderr)
    return Light(light.factors)


def lamp(streams: Sequence[SpikeStream], clocks: Sequence[Clock], light: Light) -> Light:
    """Return the course of a lamp from streams, each with its camera's clock, and a course that is like it.

    Where no pixel's spikes are even enough to tell it, as with much shot noise, that course is all that is known of the
    light, and is returned as the whole scene's.
    """
    known, n_ticks = light.factors, len(light.factors)
    for _ in range(_ROUNDS):
        course = np.zeros(n_ticks)
        for stream, clock in zip(streams, clocks, strict=True):
            mean, change, rest = layers(stream, light.gathered(clock, stream.n_ticks))
            believed = np.divide(change, mean, out=np.zeros_like(mean), where=(rest < _STILL) & (mean > 0))
            shape = stream.height, stream.width
            mean, believed = (x.reshape(shape)[:: -1 if stream.rows_bottom_up else 1] for x in (mean, believed))
            for k in range(n_ticks):
                spikes = stream.counts(*local_window(clock, k, k + 1, stream.n_ticks))
                course[k] += np.vdot(believed, spikes - mean)
            spike_trains.cache_clear()
            stream.release()
        course -= course.mean()
        if not course.min() < 0:
            return Light(known)
        light = Light(1 - course / course.min(), local=True)
    return light


def shared(stream: SpikeStream, gathered: Float64) -> PixelLight:
    """Return the light that a lamp gathered in a camera's clip, with the shares of it that the camera's pixels see."""
    mean, change, _ = layers(stream, gathered)
    return PixelLight(gathered, np.divide(change, mean, out=np.zeros_like(mean), where=mean > 0).clip(0, 1))


def layers(stream: SpikeStream, gathered: Float64) -> tuple[Float32, Float32, Float32]:
    """Return mean rate M, its lamp's part M s, and how far spikes are off, in thresholds RMS, each [H * W] as stored.

    `gathered` [n_ticks] is the lamp's light. A pixel of few spikes has no part.
    """
    trains, pixels = spike_trains(stream), stream.height * stream.width
    found = np.zeros((3, pixels), np.float32)
    in_threads(_fit, pixels, *trains.arrays, gathered, found, small=pixels < 1 << 12)
    return found[0], found[1], found[2]


@kernel
def _fit(
    words: UInt64,
    before: UInt32,
    lost: Int64,
    doubt_words: UInt64,
    doubt_before: UInt32,
    gathered: Float64,
    found: Float32,
    start: int,
    stop: int,
) -> None:
    """Set mean, the lamp's part and the rest of the pixels [start, stop): sums around the clip's middle in float64."""
    n = len(gathered)
    for p in range(start, stop):
        total = count_before(words, before, p, n)
        found[0, p] = np.float32(total / n)
        if total < _FEWEST:
            continue
        s_x, s_z, s_y = 0.0, 0.0, 0.0
        xx, xz, zz, xy, zy, yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        tick, y = -1, -0.5 * total
        for _ in range(total):
            following = first_from(words, p, tick + 1)
            if tick >= 0 and lost[following] > lost[tick]:
                y += doubtful_between(lost, doubt_words, doubt_before, p, tick, following)[1]
            tick, y = following, y + 1
            x = tick + 0.5 - 0.5 * n
            z = gathered[tick] - 0.5 * n - x
            s_x, s_z, s_y = s_x + x, s_z + z, s_y + y
            xx, xz, zz = xx + x * x, xz + x * z, zz + z * z
            xy, zy, yy = xy + x * y, zy + z * y, yy + y * y
        xx, xz, zz = xx - s_x * s_x / total, xz - s_x * s_z / total, zz - s_z * s_z / total
        xy, zy, yy = xy - s_x * s_y / total, zy - s_z * s_y / total, yy - s_y * s_y / total
        area = xx * zz - xz * xz
        mean, change = xy / xx, 0.0
        if area > 1e-6 * xx * zz:
            mean, change = (xy * zz - zy * xz) / area, (zy * xx - xy * xz) / area
        found[0, p], found[1, p] = np.float32(mean), np.float32(change)
        found[2, p] = np.float32(np.sqrt(max(yy - mean * xy - change * zy, 0.0) / total))
