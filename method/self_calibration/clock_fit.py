"""Clocks of an array's cameras by Gauss-Newton: all cameras see the same radiance at a point and a time.

For patches of all views at some times of the array, the difference between what the cameras see is made least over each
camera's clock (offset at the middle of the clip, drift), gain and image shift, and over each patch's radiance and
inverse depth, which are eliminated (`normal_equations`). Gain and shift are in it because a camera that is a little
brighter, or whose pose is a tenth of a pixel off, would otherwise look early or late: static patches tell them.

Weights are Cauchy's: a camera before which something else stands does not count. Standard errors come from how much
the times of the clip disagree (a sandwich with one cluster a time), so that noise that neighbouring pixels share, and
pixels that several patches share, do not count as more knowledge than they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.scene.camera_state import Clock
from spike4dgs.method.self_calibration.normal_equations import Prior, Reduced, reduce, residuals
from spike4dgs.method.self_calibration.patches import BASIS, Moment, Patches, Viewer, moment, observe, strongest, sweep

OFFSET, DRIFT, GAIN, X, Y = range(5)  # a camera's numbers: ticks, ticks at the clip's end, log, px, px
NUMBERS = 5
MOST_SLANT = 0.5  # standard deviation of a slant known before: planes (a px of parallax) a px


@dataclass(frozen=True)
class ClockSettings:
    """Numbers of the estimate of clocks."""

    times: int = 12  # of the clip
    half_ticks: int = 20  # of a window: 2 ms at 20 kHz; all cameras' images are blurred alike
    blurs_px: tuple[float, ...] = (2.5, 0.7)  # the first reaches further, the last is precise
    moving_patches: int = 40  # of a view at a time, at most
    static_patches: int = 15
    cell_px: int = 6  # one patch each
    noise: float = 0.41  # standard deviation of a count of even spikes whose phase is random, spikes
    noise_factor: float = 3.0  # a pixel changes where its derivative by time exceeds so much noise
    steps: int = 12  # of Gauss-Newton for each blur, at most
    converged_ticks: float = 0.01
    longest_step_ticks: float = 40.0
    prior_ticks: float = 200.0  # standard deviations of what is known before
    prior_drift_ppm: float = 1000.0
    prior_gain: float = 0.1
    prior_shift_px: float = 0.3


@dataclass(frozen=True, eq=False)
class ClockFit:
    """The numbers of C cameras [C, 5], whose means are 0, with their covariance [C * 5, C * 5]."""

    numbers: Float64
    covariance: Float64
    residual: float  # robust standard deviation of what remains, radiance
    moving: int  # patches in which something moves
    px_per_tick: float  # at which the moving patches move, across their edges


def reach_ticks(s: ClockSettings) -> int:
    """Return how far from a time the ticks lie that its image and derivatives are made of, at most."""
    return s.half_ticks + max(1, s.half_ticks // 2) + 1


def to_clock(numbers: Float64, n_ticks: int) -> Clock:
    """Return the clock of a camera's numbers."""
    middle = 0.5 * n_ticks
    drift = float(numbers[DRIFT]) / middle
    return Clock(float(numbers[OFFSET]) - drift * middle, drift * 1e6)


def from_clock(clock: Clock, n_ticks: int) -> tuple[float, float]:
    """Return the offset at the middle and the drift in ticks at the end, those of `to_clock`."""
    middle = 0.5 * n_ticks
    return clock.local(middle) - middle, clock.drift_ppm * 1e-6 * middle


def fit_clocks(seen: Sequence[Viewer], offsets: Float64, planes: Float64, s: ClockSettings) -> ClockFit:
    """Return the clocks from first offsets [C]. `planes` [D] are the inverse depths at which patches are looked for."""
    numbers = np.zeros((len(seen), NUMBERS))
    numbers[:, OFFSET] = offsets
    for blur in s.blurs_px:
        numbers, fit = _fit_at(seen, numbers, planes, blur, s)
    return fit


@dataclass(frozen=True, eq=False)
class _Scene:
    """What stays while Gauss-Newton runs."""

    seen: Sequence[Viewer]
    times: Float64  # [T] of the array
    blur: float
    settings: ClockSettings

    @property
    def n_ticks(self) -> int:
        return self.seen[0].stream.n_ticks

    def phase(self, time: float) -> float:
        """Return -1 at the clip's start, 1 at its end."""
        return 2 * time / self.n_ticks - 1

    def moments(self, numbers: Float64, time: float) -> list[Moment | None]:
        """Return each camera's moment at a time of the array."""
        at = time + numbers[:, OFFSET] + numbers[:, DRIFT] * self.phase(time)
        half = self.settings.half_ticks
        return [moment(v, float(a), half, self.blur) for v, a in zip(self.seen, at, strict=True)]


def _fit_at(
    seen: Sequence[Viewer], numbers: Float64, planes: Float64, blur: float, s: ClockSettings
) -> tuple[Float64, ClockFit]:
    scene = _Scene(seen, choose_times(seen, numbers, blur, s), blur, s)
    patches, moving = _all_patches(scene, numbers, planes)
    prior, means = _prior(scene, len(seen)), np.tile(np.eye(NUMBERS) / len(seen), (len(seen), len(seen)))
    for _ in range(s.steps):
        parts = [_linearised(scene, numbers, p, t) for p, t in zip(patches, scene.times, strict=True)]
        sigma = _spread(parts)
        reduced = [_reduced(part, p, sigma, planes) for part, p in zip(parts, patches, strict=True)]
        H = np.sum([r.H for r in reduced], axis=0) + np.diag(prior)
        H += float(np.trace(H)) * means  # else a step runs away in what no difference of cameras tells
        g = np.sum([r.g for r in reduced], axis=0) + prior * numbers.ravel()
        step = -np.linalg.solve(H, g)
        longest = float(np.abs(step.reshape(numbers.shape)[:, OFFSET]).max())
        step *= min(1.0, s.longest_step_ticks / max(longest, 1e-12))
        numbers = centred(numbers + step.reshape(numbers.shape))
        patches = [_moved(p, r.surface_steps(step), planes) for p, r in zip(patches, reduced, strict=True)]
        if longest < s.converged_ticks:
            break
    covariance = _covariance(H, prior, [r.g for r in reduced])
    return numbers, ClockFit(numbers, covariance, sigma, moving, _speed(parts))


def centred(numbers: Float64) -> Float64:
    """Return numbers [C, 5] whose means are 0: that defines the array's clock; gains would else all fall to nothing."""
    return numbers - numbers.mean(axis=0)


def choose_times(seen: Sequence[Viewer], numbers: Float64, blur: float, s: ClockSettings) -> Float64:
    """Return times of the array: one of each of `times` equal parts of the clip, of three that at which most moves."""
    margin = reach_ticks(s)
    n_ticks = seen[0].stream.n_ticks
    edges = np.linspace(margin, n_ticks - margin, s.times + 1)
    scene = _Scene(seen, edges, blur, s)
    chosen = []
    for start, stop in zip(edges[:-1], edges[1:], strict=True):
        candidates = start + (stop - start) * np.array([0.5, 1 / 6, 5 / 6])
        changes = []
        for time in candidates:
            found = [m for m in scene.moments(numbers, float(time)) if m is not None]
            changes.append(sum(float((np.abs(m.by_time) > least_change(seen[0], blur, s)).mean()) for m in found))
        chosen.append(candidates[int(np.argmax(changes))])
    return np.asarray(chosen)


def least_change(viewer: Viewer, blur: float, s: ClockSettings) -> float:
    """Return the derivative by time, per tick, above which a pixel changes and is not only noise."""
    rate = viewer.calibration.radiance_gain if viewer.calibration else viewer.radiance_gain
    noise = s.noise / (2 * s.half_ticks * rate) / max(1.0, np.sqrt(4 * np.pi) * blur)
    apart = 1 + 2 * max(1, s.half_ticks // 2)
    return float(s.noise_factor * np.sqrt(2) * noise / apart)


def _all_patches(scene: _Scene, numbers: Float64, planes: Float64) -> tuple[list[Patches], int]:
    """Return the patches of each time, at their best inverse depths, and how many of all move."""
    s, cameras, moving = scene.settings, [v.camera for v in scene.seen], 0
    found = []
    for time in scene.times:
        moments = scene.moments(numbers, float(time))
        parts = []
        for view, m in enumerate(moments):
            if m is None:
                continue
            least = least_change(scene.seen[view], scene.blur, s)
            change = np.abs(m.by_time)
            fast = strongest(change, least, s.cell_px, s.moving_patches)
            slope = np.where(change < least, np.hypot(m.by_x, m.by_y), np.nan)
            still = strongest(slope, 0.0, s.cell_px, s.static_patches)
            moving += len(fast)
            centers = np.concatenate([fast, still])
            parts.append((np.full(len(centers), view), centers))
        view_of = np.concatenate([p[0] for p in parts]) if parts else np.zeros(0, np.int64)
        centers = np.concatenate([p[1] for p in parts]) if parts else np.zeros((0, 2))
        patches = Patches(view_of, centers, np.zeros((len(view_of), 3)))
        inverse, cost = sweep(cameras, moments, patches, planes[:: max(1, round(scene.blur))])
        known = np.isfinite(cost)
        surface = np.column_stack([inverse, np.zeros((len(inverse), 2))])
        found.append(Patches(view_of[known], centers[known], surface[known]))
    return found, moving


@dataclass(frozen=True, eq=False)
class _Part:
    """What is observed at one time of the array, gains applied: each [P, K, C]; 0 where a camera says nothing."""

    known: NDArray[np.bool_]
    value: Float64
    by_surface: Float64  # [P, K, C, 3]
    by_numbers: Float64  # [P, K, C, 5]


def _linearised(scene: _Scene, numbers: Float64, patches: Patches, time: float) -> _Part:
    """Return what is observed at a time, at points that at least three cameras see."""
    cameras, gain = [v.camera for v in scene.seen], np.exp(numbers[:, GAIN])
    o = observe(cameras, scene.moments(numbers, time), patches, numbers[:, X:])
    x, y, t = (_shared(gain * slope) for slope in (o.by_x, o.by_y, o.by_time))
    value, by_inverse = gain * o.value, x * o.x_by_inverse + y * o.y_by_inverse
    known = np.isfinite(value + by_inverse + t)
    known &= known.sum(axis=-1, keepdims=True) >= 3
    by_numbers = np.stack([t, scene.phase(time) * t, value, x, y], axis=-1)
    by_surface = by_inverse[..., None] * BASIS[:, None]
    slopes = (np.where(known[..., None], a, 0.0) for a in (by_surface, by_numbers))
    return _Part(known, np.where(known, value, 0.0), *slopes)


def _shared(slope: Float64) -> Float64:
    """Return the median over cameras in place of each camera's own derivative [P, K, C], whose noise would be in it.

    Noise in derivatives shortens every step of Gauss-Newton, most along what is known badly.
    """
    known = np.isfinite(slope)
    counted = np.where(known.any(axis=-1, keepdims=True), slope, 0.0)
    return np.where(known, np.nanmedian(counted, axis=-1, keepdims=True), np.nan)


def _spread(parts: Sequence[_Part]) -> float:
    """Return the robust standard deviation of what remains, radiance."""
    found = np.concatenate([np.abs(residuals(p.value, p.known.astype(np.float64)))[p.known] for p in parts])
    return max(1.4826 * float(np.median(found)), 1e-4) if len(found) else 1.0


def _speed(parts: Sequence[_Part]) -> float:
    """Return the speed of what moves, px a tick: median over the faster half of the points with texture."""
    found = []
    for p in parts:
        t, x, y = (np.abs(p.by_numbers[..., q][p.known]) for q in (OFFSET, X, Y))
        slope = np.hypot(x, y)
        sharp = slope > (np.median(slope) if len(slope) else 0.0)
        found.append(t[sharp] / np.maximum(slope[sharp], 1e-9))
    speeds = np.concatenate(found) if found else np.zeros(0)
    return float(np.quantile(speeds, 0.75)) if len(speeds) else 0.0


def _reduced(part: _Part, patches: Patches, sigma: float, planes: Float64) -> Reduced:
    weight = part.known / sigma**2
    for _ in range(2):
        weight = part.known / (1 + (residuals(part.value, weight) / (2 * sigma)) ** 2) / sigma**2
    weight = weight * _fits(part, weight, sigma)[:, None, None]
    apart = float(planes[1] - planes[0])
    most = np.array([planes[-1] - planes[0], MOST_SLANT * apart, MOST_SLANT * apart])
    gradient = np.concatenate([np.zeros((len(patches), 1)), patches.surface[:, 1:] / most[1:] ** 2], axis=1)
    return reduce(part.value, part.by_surface, part.by_numbers, weight, Prior(1 / most**2, gradient))


def _fits(part: _Part, weight: Float64, sigma: float) -> Float64:
    """Return how much a patch counts [P]: less where cameras disagree more than in most, as at the edge of a thing."""
    counts = weight * sigma**2
    square = (counts * residuals(part.value, weight) ** 2).sum(axis=(1, 2)) / np.maximum(counts.sum(axis=(1, 2)), 1e-9)
    usual = float(np.median(square)) if len(square) else 1.0
    return np.asarray(1 / (1 + (square / max(usual, 1e-12)) ** 2))


def _moved(patches: Patches, steps: Float64, planes: Float64) -> Patches:
    """Return patches with new surfaces, a few planes away at most and within their range."""
    apart = float(planes[1] - planes[0])
    surface = patches.surface + np.clip(steps, -2 * apart, 2 * apart)
    surface[:, 0] = np.clip(surface[:, 0], planes[0], planes[-1])
    return replace(patches, surface=surface)


def _prior(scene: _Scene, cameras: int) -> Float64:
    """Return the weights [C * 5] of what is known before: every number is near 0."""
    s = scene.settings
    drift = s.prior_drift_ppm * 1e-6 * 0.5 * scene.n_ticks
    sigma = np.array([s.prior_ticks, drift, s.prior_gain, s.prior_shift_px, s.prior_shift_px])
    return np.tile(1 / sigma**2, cameras)


def _covariance(H: Float64, prior: Float64, gradients: Sequence[Float64]) -> Float64:
    """Return the covariance of the numbers; see the module."""
    G = np.stack(gradients)
    G = G - G.mean(axis=0)
    inverse = np.linalg.inv(H)
    middle = G.T @ G * len(G) / max(len(G) - 1, 1) + np.diag(prior)
    return np.asarray(inverse @ middle @ inverse)
