"""Training batches of MSDI: windows of spikes with their images, points and cameras, drawn from bursts.

Spikes are made on the fly from a burst's images, by the model of `benchmark.spikes.sensor_model`; a pixel's charge
before the window is uniform. Charge is float64 here, and radiance is linear between the images, which lie at tick
boundaries, so that no tick spans two pieces. The scenes' simulator (`generators.sensor`: integer charge, cubic curve
between key frames) is the exact twin.

Everything that can vary without another rendering is random at every use: the views and their order (the first one's
frame is that of the points), the sensors' noise, phases and maps, the brightness, the direction of time, and whether
the world is mirrored. All of it is exact: an integrator's spikes played backwards are those of one that saw the light
backwards, and a mirrored rig is a rig.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.training_bursts import REACH, Burst, BurstFile
from spike4dgs.benchmark.spikes.bits import kernel
from spike4dgs.benchmark.spikes.sensor_model import SENSOR, charge_after_spike, charge_of_tick

_DEVIATES = 1 << 16  # normal numbers drawn for a window; each pixel starts somewhere else among them
_charge_of_tick = kernel(charge_of_tick)
_charge_after_spike = kernel(charge_after_spike)


@dataclass(frozen=True, eq=False)
class Pixels:
    """Pixels of some cameras and the light on them: arrays over pixels, in any shape after the first axis of `rates`.

    Attributes:
        rates: [k, ...] spikes per tick that the light asks for, at k instants evenly from -REACH to REACH ticks, or
            `spacing` ticks apart from the start of the first tick on.
        gain: [...] relative sensitivity.
        dark: [...] spikes per tick in the dark.
        photons: number of photons per spike, for shot noise; infinity means none.
    """

    rates: Float32
    gain: Float32
    dark: Float32
    photons: float
    spacing: int | None = None


def make_spikes(pixels: Pixels, ticks: int, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return spikes [ticks, ...] of 0 and 1; the instant is the start of the middle tick, number ticks // 2.

    `ticks` is odd.
    """
    return fire(pixels, ticks, rng.random(pixels.gain.shape, np.float32), rng)


def fire(pixels: Pixels, ticks: int, charge: Float32, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return the spikes for given charges [...] in [0, 1) before the window; only the shot noise is drawn.

    Beyond the images light stays as it is in the first and the last: a window may be longer where nothing moves.
    """
    sd, cutoff = pixels.photons**-0.5, SENSOR.noise_cutoff
    deviates = np.clip(rng.standard_normal(_DEVIATES, np.float32), -cutoff, cutoff) * np.float32(sd)
    starts = rng.integers(0, _DEVIATES, charge.size, np.uint16)
    spikes = np.empty((ticks, charge.size), np.uint8)
    rates = np.ascontiguousarray(pixels.rates.reshape(len(pixels.rates), -1))
    gain, dark, charge_before = (np.ascontiguousarray(a).ravel() for a in (pixels.gain, pixels.dark, charge))
    spacing = pixels.spacing or 2 * REACH // (len(rates) - 1)
    first = 0 if pixels.spacing else REACH - ticks // 2
    _integrate(rates, gain, dark, charge_before, deviates, starts, 1 + cutoff * sd, (first, spacing), spikes)
    return spikes.reshape(ticks, *charge.shape)


@kernel
def _integrate(
    rates: Any, gain: Any, dark: Any, charge: Any, deviates: Any, starts: Any, most: float, at: Any, spikes: Any
) -> None:
    """Fill spikes [T, N] of ticks first, first + 1, ... after the first of the images rates [k, N], `spacing` apart."""
    count, n = rates.shape
    first, spacing = at
    for p in range(n):
        level, number = np.float64(charge[p]), int(starts[p])
        for t in range(len(spikes)):
            piece = min(max((first + t) // spacing, 0), count - 2)
            u = min(max((first + t + 0.5 - piece * spacing) / spacing, 0.0), 1.0)
            rate = (1 - u) * rates[piece, p] + u * rates[piece + 1, p]
            level += _charge_of_tick(gain[p] * rate, dark[p], most)
            fired = level >= 1.0
            if fired:
                level = _charge_after_spike(level, 1.0 + deviates[number])
                number = (number + 1) % _DEVIATES
            spikes[t, p] = fired


_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])
_DIMMEST, _BRIGHTEST = 0.6, 1.4  # factors of a sample's radiance


@dataclass(frozen=True, eq=False)
class Batch:
    """B samples of V views, T ticks, H x W pixels."""

    spikes: NDArray[np.uint8]  # [B, V, T, H, W] of 0 and 1
    rate: Float32  # [B, V, H, W] truth: spikes per tick at the start of the middle tick, at most 1
    points: Float32  # [B, V, H, W, 3] what the pixel's centre sees, in view 0's frame, metres; NaN if nothing
    moving: NDArray[np.bool_]  # [B, V, H, W] pixels of moving objects, of their shadows, and near them
    sensitivity: Float32  # [B, V, H, W] of the pixels, mean 1: n(x, y)
    dark: Float32  # [B, V, H, W] spikes per tick in the dark
    intrinsics: Float32  # [B, V, 3, 3]
    w2c: Float64  # [B, V, 4, 4] from view 0's frame to the view's
    gain: float  # spikes per tick of white


class Bursts:
    """The bursts of several files, which share one sensor, numbered within groups of one image size.

    Raises UserError for no files, and for files of several radiance gains.
    """

    def __init__(self, files: Sequence[BurstFile]) -> None:
        if len({f.facts.radiance_gain for f in files}) != 1:
            found = f"{len(files)} files" if not files else "several radiance gains"
            raise problem("training bursts", "files of one radiance gain", found, "name other data")
        self.files = list(files)
        self.gain = files[0].facts.radiance_gain
        self.views = min(f.facts.views for f in files)
        self._groups: dict[tuple[int, int], list[tuple[BurstFile, int]]] = {}
        for f in files:
            group = self._groups.setdefault((f.facts.height, f.facts.width), [])
            group += [(f, number) for number in range(len(f))]

    def __len__(self) -> int:
        """Return the number of bursts."""
        return sum(map(len, self._groups.values()))

    def draw(self, samples: int, views: int, ticks: int, rng: np.random.Generator) -> Batch:
        """Return a batch of randomly chosen and varied bursts, all of one image size."""
        groups = list(self._groups.values())
        shares = np.array([len(g) for g in groups]) / len(self)
        group = groups[int(rng.choice(len(groups), p=shares))]
        drawn = []
        for _ in range(samples):
            file, number = group[int(rng.integers(len(group)))]
            burst = varied(chosen(file.read(number), rng.permutation(file.facts.views)[:views]), rng)
            drawn.append(self._sample(burst, file, ticks, rng))
        return _stacked(drawn)

    def fixed(self, most: int, views: int, ticks: int) -> list[Batch]:
        """Return at most `most` bursts, evenly chosen over the files, one a batch, with the first `views` of each.

        The same files give the same batches; the sensors' noise and phases are seeded by each burst's number.
        """
        every = [pair for group in self._groups.values() for pair in group]
        picked = np.unique(np.linspace(0, len(every) - 1, min(most, len(every))).round().astype(int))
        found = []
        for number in picked.tolist():
            file, n = every[number]
            burst = chosen(file.read(n), np.arange(min(views, file.facts.views)))
            found.append(_stacked([self._sample(burst, file, ticks, np.random.default_rng(number))]))
        return found

    def _sample(self, burst: Burst, file: BurstFile, ticks: int, rng: np.random.Generator) -> Batch:
        """Return a batch of one sample without the first axis."""
        rates = burst.keys * np.float32(self.gain)
        pixels = Pixels(rates, burst.gain, burst.dark, file.facts.photons_per_spike)
        relative = burst.w2c @ np.linalg.inv(burst.w2c[0])
        return Batch(
            spikes=make_spikes(pixels, ticks, rng).swapaxes(0, 1),
            rate=np.clip(rates[len(rates) // 2], 0, 1),
            points=points_of(burst.depth, burst.K, relative),
            moving=burst.moving,
            sensitivity=np.ascontiguousarray(burst.gain),
            dark=np.ascontiguousarray(burst.dark),
            intrinsics=burst.K.astype(np.float32),
            w2c=relative,
            gain=self.gain,
        )


def check_ticks(ticks: int) -> None:
    """Raise UserError for a window that bursts do not hold."""
    if ticks % 2 == 0 or not 1 <= ticks < 2 * REACH:
        raise problem("MSDI's window", f"an odd number of ticks below {2 * REACH}", str(ticks), "train another one")


def chosen(burst: Burst, views: NDArray[np.int64]) -> Burst:
    """Return some views of a burst, in this order."""
    b = burst
    images = b.keys[:, views], b.depth[views], b.moving[views]
    return Burst(*images, w2c=b.w2c[views], K=b.K[views], gain=b.gain[views], dark=b.dark[views])


def varied(burst: Burst, rng: np.random.Generator) -> Burst:
    """Return a burst with random sensors and brightness, at random backwards in time, at random mirrored."""
    brightness = np.float32(np.exp(rng.uniform(np.log(_DIMMEST), np.log(_BRIGHTEST))))
    backwards, mirror = rng.random(2) < 0.5
    keys = burst.keys[::-1] if backwards else burst.keys
    order, flips = rng.permutation(len(burst.gain)), [slice(None, None, s) for s in rng.choice([-1, 1], 2)]
    gain, dark = (maps[order][:, *flips] for maps in (burst.gain, burst.dark))
    found = replace(burst, keys=keys * brightness, gain=gain, dark=dark)
    return mirrored(found) if mirror else found


def mirrored(burst: Burst) -> Burst:
    """Return the burst of the mirrored rig in the mirrored world."""
    width = burst.depth.shape[-1]
    K = burst.K.copy()
    K[:, 0, 2] = width - K[:, 0, 2]
    images = {name: getattr(burst, name)[..., ::-1] for name in ("keys", "depth", "moving", "gain", "dark")}
    return replace(burst, K=K, w2c=_MIRROR @ burst.w2c @ _MIRROR, **images)


def points_of(depth: Float32, K: Float64, w2c: Float64) -> Float32:
    """Return the world points [V, H, W, 3] that pixel centres see, from depths [V, H, W]; inf gives NaN."""
    _, height, width = depth.shape
    v, u = np.mgrid[:height, :width] + 0.5
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)  # [H, W, 3]
    z = np.where(np.isfinite(depth), depth, np.nan).astype(np.float64)
    inverse = np.linalg.inv(w2c)
    to_world = inverse[:, :3, :3] @ np.linalg.inv(K)  # [V, 3, 3]
    rays = np.einsum("vij,hwj->vhwi", to_world, pixels)
    return np.asarray(rays * z[..., None] + inverse[:, None, None, :3, 3], np.float32)


def _stacked(samples: Sequence[Batch]) -> Batch:
    names = ("spikes", "rate", "points", "moving", "sensitivity", "dark", "intrinsics", "w2c")
    return Batch(**{name: np.stack([getattr(s, name) for s in samples]) for name in names}, gain=samples[0].gain)
