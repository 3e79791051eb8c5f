"""A camera's response to light, estimated from recordings that any owner can make: under uniform light, in the dark.

A pixel's rate is (spikes - 1) / (ticks between the first and the last), which does not depend on the charge before the
first spike and after the last: over T ticks it is wrong by about 1 / T, where a count is by 1 / (rate T). Then

    gain = (rate under uniform light - dark rate) / its mean,      dark = rate in the dark

The gain map is the n(x, y) of Spike4DGS (eq. 15): a method that wants it takes the estimate, never a simulator's truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.spikes.bits import kernel, rows
from spike4dgs.benchmark.spikes.stream import SpikeStream

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Recordings:
    """Two recordings of one camera: under uniform light of a known radiance, and in the dark."""

    flat: SpikeStream
    dark: SpikeStream
    flat_radiance: float


@dataclass(frozen=True, eq=False)
class Calibration:
    """A camera's response to light, as estimated from its recordings.

    Attributes:
        gain: [H, W], relative sensitivity, mean 1.
        dark: [H, W], spikes per tick in the dark.
        radiance_gain: spikes per tick of a pixel of gain 1 at radiance 1, without the dark rate.
    """

    gain: Float32
    dark: Float32
    radiance_gain: float

    def radiance(self, rate: Float32) -> Float32:
        """Return the linear radiance of rates [..., H, W] in spikes per tick; pixels without sensitivity give 0."""
        light = np.maximum(rate - self.dark, 0)
        return np.asarray(light / np.where(self.gain > 0, self.gain, np.inf) / self.radiance_gain, np.float32)


def estimate(recordings: Recordings) -> Calibration:
    """Return the gain and dark maps of a camera.

    Raises UserError where the recordings do not fit together, or where no pixel responds to the light.
    """
    flat, dark = recordings.flat, recordings.dark
    if (flat.width, flat.height) != (dark.width, dark.height) or recordings.flat_radiance <= 0:
        found = f"{flat.width}x{flat.height}, {dark.width}x{dark.height} and radiance {recordings.flat_radiance:g}"
        raise problem("calibration", "two recordings of one size and a positive radiance", found, "correct them")
    dark_rate = rates(dark)
    light = np.maximum(rates(flat) - dark_rate, 0)
    if not (mean := float(light.mean())) > 0:
        raise problem("flat-field recording", "light", "no more spikes than in the dark", "record it again")
    return Calibration((light / mean).astype(np.float32), dark_rate.astype(np.float32), mean / recordings.flat_radiance)


def rates(stream: SpikeStream) -> NDArray[np.float64]:
    """Return spikes per tick [H, W] under steady light; a pixel without spikes counts as having half of one."""
    n = stream.width * stream.height
    first, last, count = np.full(n, -1, np.int64), np.full(n, -1, np.int64), np.zeros(n, np.int64)
    first_and_last(rows(stream.packed), first, last, count)
    span = np.maximum(last - first, 1)
    flat = np.where(count > 1, (count - 1) / span, np.maximum(count, 0.5) / stream.n_ticks)
    image = flat.reshape(stream.height, stream.width)
    return np.asarray(image[::-1] if stream.rows_bottom_up else image)


@kernel
def first_and_last(packed: Any, first: Any, last: Any, count: Any) -> None:
    """Fill the ticks of the first and last spike and spike count of every pixel [P], from packed rows [T, bytes]."""
    for tick in range(len(packed)):
        for byte in range(packed.shape[1]):
            bits = packed[tick, byte]
            if bits == 0:
                continue
            for k in range(8):
                pixel = 8 * byte + k
                if pixel < len(count) and (bits >> k) & 1:
                    if count[pixel] == 0:
                        first[pixel] = tick
                    last[pixel] = tick
                    count[pixel] += 1
