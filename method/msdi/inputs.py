"""Inputs of MSDI's networks: corrected spikes, rates estimated from each pixel's own spikes, streams of larger pixels.

Streams of larger pixels are for a network that was trained at low resolution. Attention costs the square of the number
of patches, and a network works best at the size of its training. A stream cannot be resized like an image, but the
spikes of several pixels can charge one larger pixel, which fires whenever the sum makes a whole spike for each of them.
This is again a stream of 0 and 1, of the mean rate to within one spike.

A network of few layers can learn to count spikes, but hardly to measure the time between them, which is the better
estimate of a bright pixel. BCONV therefore gets these rates (1.3 dB after three minutes of training). A window of h
ticks on either side of the middle, with n spikes, the first at t_1 and the last at t_n, gives (n - 1) / (t_n - t_1), or
n / 2h below two spikes, and the count n / 2h itself. The last rate is one over the interval between the last spike
before the middle and the next one, or the mean of the window where there is no such interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional


def shrink(spikes: Tensor, factor: int) -> Tensor:
    """Return a stream [..., T, H, W] of 0 and 1 in blocks of `factor` x `factor` pixels, sides rounded up, float32.

    A block at the border has only the pixels inside. All blocks begin half charged.
    """
    if factor == 1:
        return spikes.float()
    ticks, height, width = spikes.shape[-3:]
    margin = (0, -width % factor, 0, -height % factor)
    inside = functional.pad(torch.ones(1, 1, height, width, device=spikes.device), margin)
    pixels = _block_sums(inside, factor).double()
    counts = _block_sums(functional.pad(spikes.float().reshape(-1, ticks, height, width), margin), factor)
    # Double: sums of 10^5 ticks are exact, and half a block is representable.
    whole = torch.floor((counts.double().cumsum(dim=1) + pixels / 2) / pixels)
    fired = torch.diff(whole, dim=1, prepend=torch.zeros_like(whole[:, :1])).float()
    return fired.reshape(*spikes.shape[:-2], *fired.shape[-2:])


def _block_sums(x: Tensor, factor: int) -> Tensor:
    """Return the sums over blocks of [N, C, H, W], exact for whole numbers."""
    return functional.avg_pool2d(x, factor, divisor_override=1)


@dataclass(frozen=True, eq=False)
class Sensors:
    """Known response of the cameras to light: float tensors [..., H, W]."""

    sensitivity: Tensor  # n(x, y), mean 1
    dark: Tensor  # spikes per tick in the dark

    def flat(self) -> Sensors:
        """Return the same maps with one leading axis."""
        size = self.dark.shape[-2:]
        return Sensors(self.sensitivity.reshape(-1, *size), self.dark.reshape(-1, *size))


def corrected(rates: Tensor, sensors: Sensors) -> Tensor:
    """Return the rates of an ideal sensor, (rates - dark) / sensitivity, for `rates` [..., K, H, W].

    A pixel without sensitivity has rate 0.
    """
    inverse = torch.where(sensors.sensitivity > 0, 1 / sensors.sensitivity, 0.0)
    return (rates - sensors.dark.unsqueeze(-3)) * inverse.unsqueeze(-3)


def own_rates(spikes: Tensor, half_windows: Sequence[int]) -> Tensor:
    """Return rates [N, 2 K + 1, H, W], spikes per tick, for K rising windows, of spikes [N, T, H, W] of 0 and 1, T odd.

    Each window has two rates, then comes the interval's; see the module. No gradient flows.
    """
    spikes = spikes.detach()
    middle, ticks = spikes.shape[1] // 2, spikes.shape[1]
    times = torch.arange(ticks, dtype=spikes.dtype, device=spikes.device).view(1, -1, 1, 1)
    fired = spikes > 0
    first, last = times.where(fired, torch.inf), times.where(fired, -torch.inf)
    gap = first[:, middle:].amin(dim=1) - last[:, :middle].amax(dim=1)  # infinite where a side has no spike
    rates, seen = [], 0
    count = torch.zeros_like(gap)
    begin, end = torch.full_like(gap, torch.inf), torch.full_like(gap, -torch.inf)
    for half in half_windows:
        for ring in (slice(middle - half, middle - seen), slice(middle + seen, middle + half)):
            count = count + fired[:, ring].sum(dim=1)
            begin, end = begin.minimum(first[:, ring].amin(dim=1)), end.maximum(last[:, ring].amax(dim=1))
        counted = count / (2 * half)
        rates += [torch.where(count > 1, (count - 1) / (end - begin).clamp(min=1), counted), counted]
        seen = half
    rates.append(torch.where(gap.isfinite(), 1 / gap, fired.sum(dim=1) / ticks))
    return torch.stack(rates, dim=1)


def network_inputs(spikes: Tensor, sensors: Sensors | None, half_windows: Sequence[int]) -> Tensor:
    """Return spikes [N, T, H, W], with `own_rates` if there are windows, corrected for the sensors if known."""
    seen = torch.cat([spikes, own_rates(spikes, half_windows)], dim=1) if half_windows else spikes
    return corrected(seen, sensors) if sensors else seen
