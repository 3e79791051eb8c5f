"""TFSTP, texture from short-term plasticity: intervals that a synapse's memory of earlier intervals smooths.

Each pixel drives a model synapse with the resource R and the utilisation u. A spike, d ticks after the one before it,
moves them to

    R' = 1 - (1 - R (1 - u)) exp(-d / D),    u' = u0 + (u + f (1 - u) - u0) exp(-d / F)

with D = 1 and F = 10 ticks, u0 = f = 0.15. At a constant interval both come to rest, and each resting state names the
interval that it rests at:

    d_R = -D ln[(1 - R') / (1 - R' (1 - u'))],    d_u = -F ln[(u' - u0) / (f - u0 + u' (1 - f))].

The image is (1 / d_R + 1 / d_u) / 2 spikes per tick: exactly the rate where the light is constant and the interval
is a whole number of ticks. Where intervals alternate, d_u lies between the last one and those of the F ticks before,
which removes some of the quantisation; where the light changes it lags. Intervals much longer than F are TFI's.

Differences from the published program, and why:

- it has F in the denominator of d_u where its own update gives f, so that no interval comes back out; here it is f;
- it adds the two rates and stretches the sum to 0 ... 255 with a histogram equalisation; here their mean stays a rate;
- it forms 1 - R in float32, where it is 0 for intervals over 16 ticks: 1 / d_R is lost there. Here the update is put
  into the inverse: d_R = d + D ln(A' / A) with A = 1 - R (1 - u) before the spike and A' after it, and likewise
  d_u = d + F ln(B' / B) with B = u - u0 + f (1 - u). Nothing cancels and nothing underflows;
- it starts all pixels at R = 1, u = u0, and needs several spikes to forget that. Here the oldest interval that is
  looked at counts as one at rest, so that the first interval of a clip already gives its rate.

The state at tick t has seen the interval that contains the start of t, which is TFI's, and at least `memory_ticks`
before it (or all that the clip has). At the clip's ends the interval is the one that TFI takes. Before the first spike
there is no memory, so it is TFI; pixels with one spike have 1 / (length of the clip), pixels with none have 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from spike4dgs.benchmark.arrays import Float32, Float64, UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.spikes.bits import find_spike, in_threads, kernel, rows
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.settings import Settings

Synapse = tuple[float, float, float, float]  # u0, f, D and F


@dataclass(frozen=True)
class TfstpSettings(Settings):
    """Constants of the model synapse, as published, and how much of the history is looked at."""

    u0: float = 0.15  # utilisation at rest
    jump: float = 0.15  # f, the share of the rest of it that a spike adds
    d_ticks: float = 1.0  # D, the time constant of recovery
    f_ticks: float = 10.0  # F, that of facilitation: about as many ticks are averaged over
    memory_ticks: int = 120  # older intervals weigh less than exp(-12): rates move by less than 1e-4

    def __post_init__(self) -> None:
        if not (0 < self.u0 < 1 and 0 < self.jump < 1 and min(self.d_ticks, self.f_ticks, self.memory_ticks) > 0):
            expected = "u0 and jump between 0 and 1, d_ticks, f_ticks and memory_ticks above 0"
            raise problem("tfstp", expected, str(self), "correct the settings")


def tfstp_image(stream: SpikeStream, tick: int, settings: TfstpSettings | None = None) -> Float32:
    """Return spikes per tick [H, W] float32 at the start of `tick`, from the states of the pixels' synapses."""
    s = settings or TfstpSettings()
    image = np.empty(stream.height * stream.width, np.float32)
    decays = _decays(stream.n_ticks, s.f_ticks, s.d_ticks)
    synapse = (float(s.u0), float(s.jump), float(s.d_ticks), float(s.f_ticks))  # one type for numba
    arguments = (rows(stream.packed), decays, synapse, s.memory_ticks, tick, image)
    in_threads(_image, len(image), *arguments, small=len(image) < 1 << 12)
    upright = image.reshape(stream.height, stream.width)
    return upright[::-1] if stream.rows_bottom_up else upright


@lru_cache(maxsize=4)  # all images of a clip need the same, and it is longer to make than an image of a long clip
def _decays(n_ticks: int, f_ticks: float, d_ticks: float) -> Float64:
    """Return what F and D leave after gaps of 0 ... n_ticks [n_ticks + 1, 2]. Nobody writes into it."""
    return np.exp(-np.arange(n_ticks + 1)[:, None] / np.array([f_ticks, d_ticks]))


@kernel
def _image(
    packed: UInt8, decays: Float64, synapse: Synapse, memory: int, tick: int, image: Float32, start: int, stop: int
) -> None:
    for p in range(start, stop):
        image[p] = np.float32(_rate(packed, decays, synapse, memory, p, tick))


@kernel
def _rate(packed: UInt8, decays: Float64, synapse: Synapse, memory: int, pixel: int, tick: int) -> float:
    """Return spikes per tick of one stored pixel."""
    n = len(packed)
    before, after = find_spike(packed, pixel, tick - 1, -1), find_spike(packed, pixel, tick, 1)
    if before < 0 and after < 0:
        return 0.0
    if before < 0:
        following = find_spike(packed, pixel, after + 1, 1)
        return 1 / n if following < 0 else 1 / max(following - after, after + 1)
    oldest = find_spike(packed, pixel, before - memory, -1)
    if oldest < 0:
        oldest = find_spike(packed, pixel, max(0, before - memory), 1)
    if oldest == before:
        return 1 / n if after < 0 else 1 / (after - before)
    return _remembered_rate(packed, decays, synapse, pixel, oldest, before, after)


@kernel
def _remembered_rate(
    packed: UInt8, decays: Float64, synapse: Synapse, pixel: int, oldest: int, before: int, after: int
) -> float:
    """Return spikes per tick after the spikes oldest ... before (two or more) and `after` (-1: the clip ends)."""
    u0, jump, d_ticks, f_ticks = synapse
    v = q = a = b = 0.0  # v = u - u0, q = 1 - R; a, b: A and B before the last spike
    spike, length = oldest, 0
    while spike != after:
        following = find_spike(packed, pixel, spike + 1, 1) if spike < before else after
        if following < 0:
            if len(packed) - before < length:
                break  # the nearest complete interval is longer than what the clip shows of this one
            following = after = len(packed)
        gap = following - spike
        decay_u, decay_r = decays[gap]
        if length == 0:  # at rest: the v and q that this gap leaves as they are
            v = jump * (1 - u0) * decay_u / (1 - (1 - jump) * decay_u)
            q = (u0 + v) * decay_r / (1 - (1 - u0 - v) * decay_r)
        a, b = u0 + v + q * (1 - u0 - v), v + jump * (1 - u0 - v)
        v, q = b * decay_u, a * decay_r
        spike, length = following, gap
    length_r = length + d_ticks * math.log((u0 + v + q * (1 - u0 - v)) / a)
    length_u = length + f_ticks * math.log((v + jump * (1 - u0 - v)) / b)
    return 0.5 / length_r + 0.5 / length_u


TFSTP = ImageMaker(
    name="tfstp",
    definition="mean of the two rates at which the recovery and the facilitation of a short-term plastic synapse, "
    "driven by the pixel's spikes, would rest; stands in for TVS of the paper's Table 6, which is defined nowhere",
    source="Zheng, Zheng, Yu, Huang, Wang: Capture the moment: high-speed imaging with spiking cameras through "
    "short-term plasticity, IEEE TPAMI 45(7), 2023",
    rate=tfstp_image,
    settings=TfstpSettings(),
)
