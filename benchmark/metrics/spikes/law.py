"""The law of recorded intervals: how probable is it that a pixel took so many ticks for so many spikes?

A pixel under steady light takes 1 / rate ticks for a spike, and a spike is read out in the tick in which it falls. The
n intervals after a spike therefore last m ticks with the probability tri(m - n / rate), where tri(x) = max(0, 1 - |x|):
one of two neighbouring numbers. Shot noise makes the charge of n spikes vary by sqrt(n / photons).

That law alone is too sharp to judge a model: in the dark an interval of 100 ticks tells the rate to a thousandth, and
the score would be that of the darkest pixels. A render is not asked to be better than a tolerance: its rate is taken to
be known with this standard deviation, and the law is averaged over it. tri is only two ticks wide, so m - n / rate is
linear in the rate where it counts, at the recorded rate n / m (to one part in m; spans are 20 ticks and longer):

    P(m | n, rate) = E tri(d + s Z),   d = (rate m / n - 1) m,   s^2 = (tolerance m^2 / n)^2 + (m / n)^2 n / photons

with a standard normal Z. E max(0, x + s Z) = s H(x / s), H(u) = u Phi(u) + phi(u), gives it in closed form.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfcx, ndtr

Float64 = NDArray[np.float64]


def log_probability(intervals: Float64, ticks: Float64, rate: Float64, tolerance: float, photons: float) -> Float64:
    """Return log P(ticks | intervals, rate), elementwise: `rate` and `tolerance` in spikes per tick."""
    spread = np.sqrt((tolerance * ticks**2 / intervals) ** 2 + ticks**2 / (intervals * photons))
    return _log_mean_triangle((rate * ticks / intervals - 1) * ticks, spread)


def _log_mean_triangle(d: Float64, s: Float64) -> Float64:
    """Return log E tri(d + s Z). All three terms are taken on the side where they are small: nothing cancels there."""
    side = -np.abs(d)
    a, b, c = (_log_h((side + x) / s) for x in (1, 0, -1))
    return np.asarray(np.log(s) + a + np.log1p(np.exp(c - a) - 2 * np.exp(b - a)))


def _log_h(u: Float64) -> Float64:
    """Return log(u Phi(u) + phi(u)) for any u: with Mills' ratio where u is negative."""
    below = np.minimum(u, 0)
    mills = np.sqrt(np.pi / 2) * erfcx(-below / np.sqrt(2))
    density = -(u**2) / 2 - np.log(2 * np.pi) / 2
    above = np.maximum(u, 0)
    positive = above * ndtr(above) + np.exp(-(above**2) / 2) / np.sqrt(2 * np.pi)
    return np.asarray(np.where(u < 0, density + np.log1p(below * mills), np.log(positive)))
