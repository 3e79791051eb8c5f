"""Images from spikes: windows against noise and blur."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import Any

import numpy as np

from spike4dgs.baselines.images.tfp import HALF_WINDOW, tfp_image
from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.scene.scene import Scene, Target, open_scene
from spike4dgs.benchmark.spikes.repair import fill_gaps
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.studies.kit.measurement import TIMES, Column, Point, Request, Series, measurement
from spike4dgs.studies.kit.timing import by_turns_ms

GROUP = "Images from spikes"
Maker = Callable[[Scene, Target], Float32]
_HALF_WINDOWS = (2, 5, 10, HALF_WINDOW, 40, 80, 160)
MOVING = (Column("rms", "RMS error, radiance"), Column("moving", "RMS error where it moves"))


def fired_stream(ticks: int, width: int, height: int, seed: int = 0) -> SpikeStream:
    """Return a stream of ideal integrate-and-fire pixels with rates of 0.01 to 0.6 spikes per tick, fixed in time."""
    rng = np.random.default_rng(seed)
    rate, charge = rng.uniform(0.01, 0.6, (height, width)), rng.random((height, width))
    packed = []
    for _ in range(ticks):
        charge += rate
        fired = charge >= 1
        charge -= fired
        packed.append(pack(fired[None]))
    return SpikeStream(np.concatenate(packed), width, height, 20_000.0)


def held_out(scene: Scene, target: Target) -> tuple[SpikeStream, int, float]:
    """Return the stream, the tick and the gain that a maker gets for a scored image; lost ticks are filled."""
    return filled_stream(scene, target.camera), target.tick, scene.radiance_gain


@lru_cache(maxsize=2)
def filled_stream(scene: Scene, camera: str) -> SpikeStream:
    """Return a camera's stream as makers get it: lost ticks are no darkness."""
    return fill_gaps(scene.stream(camera))


def _window(half_window: int, scene: Scene, target: Target) -> Float32:
    stream, tick, gain = held_out(scene, target)
    return np.asarray(tfp_image(stream, tick, half_window) / gain, np.float32)


@measurement("images", GROUP, "Images: windows", (*TIMES, *MOVING, Column("ticks", "window, ticks")), ("rms", "moving"))
def windows(request: Request) -> Iterator[Series]:
    """An image is the mean of the spikes around an instant; a longer window has less noise and more blur.

    The radiance that the renderer traced at that instant, at the held-out camera.

    TFP's 40 ticks are customary. `speed images` compares the makers that choose a window for each pixel.

    tests/studies/speed_error/test_images.py
    """
    scene = open_scene(request.scene())
    targets = scene.targets[:: max(1, len(scene.targets) // request.pick(2, 4, 19))]
    makers = [partial(_window, half) for half in _HALF_WINDOWS]
    middle = targets[len(targets) // 2]
    times = by_turns_ms([partial(make, scene, middle) for make in makers], request.pick(1, 3, 7))
    points = [Point("rendered truth", {"ms": None, "rms": 0.0, "moving": 0.0}, "exact")]
    for half, make, (best, median) in zip(_HALF_WINDOWS, makers, times, strict=True):
        values = {"ms": best, "median_ms": median, "ticks": 2.0 * half, **rms_errors(scene, targets, make)}
        points.append(Point(f"{2 * half} ticks", values, "chosen" if half == HALF_WINDOW else ""))
    yield Series(f"TFP, {scene.id}", tuple(points))


def rms_errors(scene: Scene, targets: Any, make: Maker) -> dict[str, float | None]:
    """Return the RMS errors of images clipped to 0..1 against the truth: everywhere, and where something moves."""
    squares: dict[str, list[float]] = {"rms": [], "moving": []}
    for target in targets:
        image, moving = np.clip(make(scene, target), 0, 1), scene.moving(target)
        off = (image - np.clip(scene.ground_truth(target), 0, 1)).astype(np.float64) ** 2
        squares["rms"].append(float(off.mean()))
        squares["moving"] += [float(off[moving].mean())] if moving.any() else []
    return {k: math.sqrt(float(np.mean(v))) if v else None for k, v in squares.items()}
