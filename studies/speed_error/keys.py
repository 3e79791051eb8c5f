"""Key-frame spacing: the error of interpolated radiance and of spikes against render time.

One view of a world is rendered at every tick: the truth. Then only every 2nd, 4th, 8th ... of these frames is kept, and
the ticks between are interpolated, linearly and by the simulator's clamped Catmull-Rom curve. Errors are taken in
windows of 32 ticks, at pixels whose radiance varies by more than 1 % in the window.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.generators.profiles import HELD_OUT_VIEW, PROFILES, RATE_HZ
from spike4dgs.generators.rendering.image_motion import max_image_speed
from spike4dgs.generators.rendering.render import MultiViewRenderer
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.sensor.model import Sensor, random_charge
from spike4dgs.generators.sensor.reference import fire, tick_means
from spike4dgs.generators.worlds import WORLDS
from spike4dgs.studies.kit.measurement import Column, Point, Request, Series, measurement

GROUP = "Sensor and rendering"
OF_SIZE = {"quick": ("car",), "whole": ("car", "turntable", "bricks")}  # the worlds of a report
WINDOW = 32  # ticks
SPACINGS = tuple(2**k for k in range(1, 7))
_FLOOR = 0.02  # relative errors are in units of the true radiance, or of this where it is darker
_VARIES = 0.01
_COLUMNS = (
    Column("render", "render time, s per ms of clip and view"),
    Column("px", "motion between keys, px"),
    Column("tick", "mean error at moving pixels, %"),
    Column("worst", "99.9th percentile of it, %"),
    Column("integral", "error of the light over 32 ticks, %"),
    Column("counts", "32-tick counts that are off, %"),
)


@measurement("keys", GROUP, "Key frames: spacing and interpolation", _COLUMNS, ("tick", "counts"), least="quick")
def keys(request: Request) -> Iterator[Series]:
    """Radiance is rendered at keys; the simulator follows a clamped Catmull-Rom curve between them.

    A key at every tick.

    The widest spacing at which the fastest point moves half a pixel at most: `make-dataset` chooses it for each pixel
    (a quarter in the profile `paper`). Wider keys lose edges; closer ones render what hardly changes.

    tests/studies/speed_error/test_keys.py
    """
    width, height, spp, ticks = request.pick(None, (64, 40, 16, 64), (200, 125, 64, 256))
    for world in OF_SIZE[request.size]:
        built = WORLDS[world].build(request.seed, 0, ticks / RATE_HZ)
        frames, speed, seconds = render_every_tick(built, (width, height), ticks, spp, request.seed)
        for series in compare(frames, speed, seconds, SPACINGS, request.seed):
            yield Series(f"{world}, {series.name}", series.points)


def compare(
    frames: Float32, speed_px_s: float, seconds_per_key: float, spacings: Sequence[int], seed: int = 0
) -> list[Series]:
    """Return the series of both curves, a point for each spacing, from frames [n + 1, H, W] at every tick's start."""
    n = len(frames) - 1
    truth = np.stack(list(tick_means(frames, range(n + 1), n)))
    moving = _moving(frames)
    charge = random_charge(frames.shape[1], frames.shape[2], [seed, 0])
    counts = _counts(truth, charge)
    per_tick = RATE_HZ / 1000 * seconds_per_key
    none = dict.fromkeys(("tick", "worst", "integral", "counts"), 0.0)
    every = Point("every tick", {"render": per_tick, "px": speed_px_s / RATE_HZ, **none}, "exact")
    limit = max((s for s in spacings if speed_px_s * s / RATE_HZ <= PROFILES["small"].max_key_px), default=0)
    found = {"Catmull-Rom": [every], "linear": [every]}
    for step, (name, curve) in itertools.product(spacings, zip(found, (tick_means, linear_means), strict=True)):
        means = np.stack(list(curve(frames[::step], range(0, n + 1, step), n)))
        values = {"render": per_tick / step, "px": speed_px_s * step / RATE_HZ, **_errors(means, truth, moving)}
        values["counts"] = 100 * float((_counts(means, charge) != counts)[moving].mean())
        chosen = name == "Catmull-Rom" and step == limit
        found[name].append(Point(f"{step} ticks", values, "chosen" if chosen else ""))
    return [Series(name, tuple(points)) for name, points in found.items()]


def linear_means(keys: Float32, key_ticks: Sequence[int], n_ticks: int) -> Iterator[Float64]:
    """Yield the mean radiance [H, W] of each tick on straight lines between the keys."""
    for k, (start, end) in enumerate(itertools.pairwise(key_ticks)):
        for tick in range(start, min(end, n_ticks)):
            u = (tick + 0.5 - start) / (end - start)
            yield np.asarray((1 - u) * keys[k].astype(np.float64) + u * keys[k + 1])


def _windows(values: NDArray[Any]) -> NDArray[Any]:
    """Split values [n, H, W] into windows [n / 32, 32, H, W]."""
    return values.reshape(-1, WINDOW, *values.shape[1:])


def _moving(frames: Float32) -> NDArray[np.bool_]:
    """Return [n / 32, H, W]: pixels whose radiance varies in the window."""
    parts = _windows(frames[:-1])
    low, high = parts.min(1), parts.max(1)
    return np.asarray(high - low > _VARIES * np.maximum(high, _FLOOR))


def _errors(means: Float64, truth: Float64, moving: NDArray[np.bool_]) -> dict[str, float]:
    """Return in percent: mean and 99.9th percentile of the tick's radiance, mean error of the window integral."""
    a, b = _windows(means), _windows(truth)
    integral = np.abs(a.sum(1) - b.sum(1)) / np.maximum(b.sum(1), _FLOOR * WINDOW)
    tick = (np.abs(a - b) / np.maximum(b, _FLOOR)).transpose(0, 2, 3, 1)[moving]
    worst = float(np.percentile(tick, 99.9))
    return {"tick": 100 * tick.mean(), "worst": 100 * worst, "integral": 100 * integral[moving].mean()}


def _counts(means: Float64, charge: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the spikes per window [n / 32, H, W]."""
    spikes = np.stack([fired for fired, _ in fire(iter(means), Sensor(), charge)])
    return np.asarray(_windows(spikes).sum(1))


def render_every_tick(world: Any, size: tuple[int, int], n: int, spp: int, seed: int) -> tuple[Float32, float, float]:
    """Return the frames [n + 1, H, W] at every tick, speed of the fastest point in px/s, seconds per frame."""
    views = cameras(world, *size, [HELD_OUT_VIEW])
    renderer = MultiViewRenderer(world, views, seed=seed, spp=spp, background_spp=4 * spp)
    renderer.keys(0.0)  # background and compilation of kernels are not part of a key's time
    start = time.perf_counter()
    frames = np.stack([renderer.keys(t / RATE_HZ)[0] for t in range(n + 1)])
    seconds = (time.perf_counter() - start) / (n + 1)
    return frames, max_image_speed(world, views, n / RATE_HZ), seconds
