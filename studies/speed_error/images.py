"""Images from spikes: windows against noise and blur, and the numbers that hold them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.baselines.images.tfp import HALF_WINDOW, tfp_image
from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import Scene, Target, open_scene
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.studies.kit.measurement import TIMES, Column, Point, Request, Series, compared, measurement
from spike4dgs.studies.kit.timing import by_turns_ms

GROUP = "Images from spikes"
Maker = Callable[[Scene, Target], Float32]
_HALF_WINDOWS = (2, 5, 10, HALF_WINDOW, 40, 80, 160)
_NETWORKS = ("spk2img", "msdi")
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
    """Return the stream, the tick and the gain that a maker gets for a scored image."""
    return scene.stream(target.camera), target.tick, scene.radiance_gain


def _window(half_window: int, scene: Scene, target: Target) -> Float32:
    stream, tick, gain = held_out(scene, target)
    return np.asarray(tfp_image(stream, tick, half_window) / gain, np.float32)


def _named(name: str, scene: Scene, target: Target) -> Float32:
    stream, tick, gain = held_out(scene, target)
    return np.nan_to_num(IMAGES[name](stream, [tick], gain)[0])


@measurement(
    "images",
    GROUP,
    "Images: makers and windows",
    (*TIMES, *MOVING, Column("ticks", "window, ticks")),
    ("rms", "moving"),
    (20, 60, 400),
)
def makers(request: Request) -> Iterator[Series]:
    """An image is made from the spikes around an instant; a longer window has less noise and more blur.

    The radiance that the renderer traced at that instant, at the held-out camera.

    TFP's 40 ticks are customary. `intervals`, of `spike4dgs-x`, chooses each pixel's window by what the light does
    there: long where it is constant, short where it changes.

    tests/baselines/images
    """
    scene = open_scene(request.scene())
    windows: dict[str, Maker] = {f"{2 * h} ticks": partial(_window, h) for h in _HALF_WINDOWS}
    yield _judged(scene, windows, f"{2 * HALF_WINDOW} ticks", f"TFP by its window, {scene.id}", request)
    named: dict[str, Maker] = {n: partial(_named, n) for n in IMAGES if request.size != "tiny" or n not in _NETWORKS}
    yield _judged(scene, named, "intervals", f"image makers, {scene.id}", request)


def _judged(scene: Scene, makers: dict[str, Maker], chosen: str, name: str, request: Request) -> Series:
    """Return each maker's time and its error against the ground truth of the held-out camera."""
    targets = scene.targets[:: max(1, len(scene.targets) // request.pick(2, 4, 19))]
    middle = targets[len(targets) // 2]
    usable = {}
    for title, maker in makers.items():
        try:
            maker(scene, middle)
        except UserError:  # no weights
            continue
        usable[title] = maker
    times = by_turns_ms([partial(m, scene, middle) for m in usable.values()], request.pick(1, 3, 7))
    points = [Point("rendered truth", {"ms": None, "rms": 0.0, "moving": 0.0}, "exact")]
    for (title, maker), (best, median) in zip(usable.items(), times, strict=True):
        errors = rms_errors(scene, targets, maker)
        ticks = float(title.removesuffix(" ticks")) if title.endswith(" ticks") else None
        values = {"ms": best, "median_ms": median, "ticks": ticks, **errors}
        points.append(Point(title, values, "chosen" if title == chosen else ""))
    return Series(name, tuple(points))


def rms_errors(scene: Scene, targets: Any, make: Maker) -> dict[str, float | None]:
    """Return the RMS errors of images clipped to 0..1 against the truth: everywhere, and where something moves."""
    squares: dict[str, list[float]] = {"rms": [], "moving": []}
    for target in targets:
        image, moving = np.clip(make(scene, target), 0, 1), scene.moving(target)
        off = (image - np.clip(scene.ground_truth(target), 0, 1)).astype(np.float64) ** 2
        squares["rms"].append(float(off.mean()))
        squares["moving"] += [float(off[moving].mean())] if moving.any() else []
    return {k: math.sqrt(float(np.mean(v))) if v else None for k, v in squares.items()}


@measurement(
    "half-floats",
    GROUP,
    "Images: half floats",
    (
        Column("bytes", "memory, bytes a pixel"),
        *TIMES,
        Column("rms", "RMS relative error"),
        Column("relative", "largest relative error"),
    ),
    ("rms", "relative"),
    (1, 2, 6),
)
def half_floats(request: Request) -> Iterator[Series]:
    """Ground truth and training images are kept as half floats: two bytes a pixel.

    Float64.

    A half float rounds by 0.05 % at most between 6e-5 and 65,504, far below the noise of a count. 8 bits of sRGB lose
    up to 14 % in shadows and everything above white. Below 6e-5 half floats lose digits, and below 3e-8 all; light of
    6e-5 fires a pixel about once a second.

    tests/studies/speed_error/test_images.py
    """
    rng, count = np.random.default_rng(request.seed), request.pick(1 << 10, 1 << 18, 1 << 20)
    lights = {
        "radiance 0.001 to 1": 10 ** rng.uniform(-3, 0, count),
        "glaring, 1 to 1000": 10 ** rng.uniform(0, 3, count),
        "dark, 1e-8 to 0.001": 10 ** rng.uniform(-8, -3, count),
    }

    def errors(found: Any, exact: Any) -> dict[str, float]:
        off = np.abs(np.asarray(found, np.float64) - exact) / exact
        size = 1 if found.dtype == np.float64 and found is not exact else found.itemsize  # decoded from codes
        return {"bytes": size, "relative": float(off.max()), "rms": float(np.sqrt(np.mean(off**2)))}

    for name, light in lights.items():
        calls: dict[str, Callable[[], Any]] = {
            "float64": partial(np.copy, light),
            "float32": partial(light.astype, np.float32),
            "half floats": partial(light.astype, np.float16),
            "8-bit sRGB": partial(_stored_in_8_bits, light),
        }
        yield compared(name, calls, errors, request.pick(1, 3, 5), "half floats")


def _stored_in_8_bits(light: Any) -> Any:
    """Return the linear radiance of light's 8-bit sRGB codes (IEC 61966-2-1)."""
    x = encode_srgb(light) / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
