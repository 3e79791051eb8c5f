"""The coat of the worlds' glossy surfaces in closed form: a rough dielectric over a matte base.

The worlds' coats are Mitsuba's `roughplastic`. Its gloss is F D G1(i) G1(o) / (4 cos(i) cos(o)) with Fresnel's F and
Beckmann's D. Its matte lobe is albedo T(i) T(o) / (pi n^2 (1 - F_in)): T is the share of light that gets through the
coat, on the side of the light (i) and of the view (o), and F_in is the mean reflectance from within.

A layer of most other renderers knows the side of the view alone. With the weight T(o) mean(T) / (n^2 (1 - F_in)) of a
plain matte lobe it reflects as much of uniform light; of light from one direction, Mitsuba's reflects T(i) / mean(T)
times as much.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from spike4dgs.benchmark.arrays import Float64

IOR = 1.49 / 1.000277  # of Mitsuba's `roughplastic`: polypropylene in air
_FACETS = 200  # of the sums over facets, each way
_COSINES = 64  # of the tables over angles of incidence


@dataclass(frozen=True, eq=False)
class Coat:
    """What a rough coat lets through, by the cosine of the angle of incidence: 0 to 1 in even steps.

    Attributes:
        through: [N] share of light that gets to the base.
        mean: of `through` in uniform light.
        within: mean reflectance from within.
    """

    through: Float64
    mean: float
    within: float

    @property
    def weights(self) -> Float64:
        """The weights [N] by the side of the view that reflect as much of uniform light as Mitsuba's coat."""
        return self.through * self.mean / (IOR**2 * (1 - self.within))

    def of_one_light(self, cosine: float) -> float:
        """Return how many times as much light from one direction Mitsuba's matte lobe reflects as such a layer."""
        return float(np.interp(cosine, np.linspace(0, 1, len(self.through)), self.through)) / self.mean


def coat(alpha: float) -> Coat:
    """Return the coat of a roughness."""
    cosines = np.linspace(0, 1, _COSINES)
    _, passed = np.transpose([crossing(alpha, c, IOR) for c in cosines])
    back, _ = np.transpose([crossing(alpha, c, 1 / IOR) for c in cosines])
    mean = 2 * np.trapezoid(passed * cosines, cosines)
    within = 2 * np.mean(back * cosines)  # as Mitsuba sums it: 2 % less of the matte lobe than by the integral
    return Coat(passed, float(mean), float(within))


def crossing(alpha: float, cosine: float, ior: float) -> tuple[float, float]:
    """Return the shares of light that a rough interface reflects and transmits; the rest meets a second facet.

    Facets have slopes of Beckmann's distribution of roughness `alpha` and Smith's masking on both sides; each reflects
    by Fresnel's law. `ior` is that of the far side relative to the near one.
    """
    cosine = max(cosine, 1e-4)
    share = (np.arange(_FACETS) + 0.5) / _FACETS
    slope, around = alpha * np.sqrt(-np.log(share))[:, None], np.pi * share[None]  # as often as their projected area
    z = 1 / np.sqrt(1 + slope**2)
    seen = np.sqrt(1 - cosine**2) * slope * z * np.cos(around) + cosine * z  # cosine of light and facet
    weight = np.where(seen > 0, seen / (cosine * z), 0) * _unmasked(np.asarray(cosine), alpha)
    seen = np.clip(seen, 0, 1)
    reflected, refracted = fresnel(seen, ior)
    up = 2 * seen * z - cosine  # cosines of the light that leaves, to either side
    down = refracted * z - (seen * z - cosine) / ior
    return (
        float(np.mean(weight * reflected * _unmasked(up, alpha))),
        float(np.mean(weight * (1 - reflected) * _unmasked(down, alpha))),
    )


def fresnel(cosine: Float64, ior: float) -> tuple[Float64, Float64]:
    """Return the reflectance of a smooth dielectric for unpolarised light, and the cosine of the refracted ray."""
    square = 1 - (1 - cosine**2) / ior**2
    inside = np.sqrt(np.maximum(square, 1e-12))
    across, along = (cosine - ior * inside) / (cosine + ior * inside), (ior * cosine - inside) / (ior * cosine + inside)
    return np.where(square > 0, (across**2 + along**2) / 2, 1.0), inside


def _unmasked(cosine: Float64, alpha: float) -> Float64:
    """Return the share of facets that a direction sees, by Smith for Beckmann's distribution; 0 from below."""
    c = np.clip(cosine, 1e-6, 1 - 1e-9)
    a = np.minimum(c / (alpha * np.sqrt(1 - c**2)), 20)
    return np.where(cosine > 0, 2 / (1 + erf(a) + np.exp(-a * a) / (a * np.sqrt(np.pi))), 0.0)
