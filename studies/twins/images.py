"""Images from spikes: windows against noise and blur, stacks against plain numpy, and the numbers that hold them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.baselines.images.tfi import tfi_stack
from spike4dgs.baselines.images.tfp import HALF_WINDOW, tfp_image, tfp_stack
from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import Scene, Target, open_scene
from spike4dgs.studies.speed.rows import held_out
from spike4dgs.studies.speed.stacks import tfi_plainly, tfp_plainly
from spike4dgs.studies.speed.streams import fired_stream
from spike4dgs.studies.speed.timing import by_turns_ms
from spike4dgs.studies.speed_error.measurement import (
    MEDIAN_MS,
    MS,
    Column,
    Measurement,
    Point,
    Request,
    Series,
)

GROUP = "Images from spikes"
Maker = Callable[[Scene, Target], Float32]
_HALF_WINDOWS = (2, 5, 10, HALF_WINDOW, 40, 80, 160)
_NETWORKS = ("spk2img", "msdi")
_RMS, _MOVING = Column("rms", "RMS error, radiance"), Column("moving", "RMS error where it moves")


def _window(half_window: int, scene: Scene, target: Target) -> Float32:
    stream, tick, gain = held_out(scene, target)
    return np.asarray(tfp_image(stream, tick, half_window) / gain, np.float32)


def _named(name: str, scene: Scene, target: Target) -> Float32:
    stream, tick, gain = held_out(scene, target)
    return np.nan_to_num(IMAGES[name](stream, [tick], gain)[0])


def _makers(request: Request) -> Iterator[Series]:
    scene = open_scene(request.scene())
    yield _judged(scene, {f"{2 * h} ticks": partial(_window, h) for h in _HALF_WINDOWS}, f"{2 * HALF_WINDOW} ticks",
                  f"TFP by its window, {scene.id}", request)  # fmt: skip
    names = [n for n in IMAGES if request.size != "tiny" or n not in _NETWORKS]
    yield _judged(scene, {n: partial(_named, n) for n in names}, "intervals", f"image makers, {scene.id}", request)


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
    zero = {"rms": 0.0, "moving": 0.0}
    points = [Point("rendered truth", {"ms": None, **zero}, "exact")]
    for (title, maker), (best, median) in zip(usable.items(), times, strict=True):
        squares: dict[str, list[float]] = {"rms": [], "moving": []}
        for target in targets:
            off = (np.clip(maker(scene, target), 0, 1) - np.clip(scene.ground_truth(target), 0, 1)) ** 2
            squares["rms"].append(float(off.mean()))
            if scene.moving(target).any():
                squares["moving"].append(float(off[scene.moving(target)].mean()))
        rms = {k: math.sqrt(float(np.mean(v))) if v else None for k, v in squares.items()}
        ticks = float(title.removesuffix(" ticks")) if title.endswith(" ticks") else None
        role: Any = "chosen" if title == chosen else ""
        points.append(Point(title, {"ms": best, "median_ms": median, "ticks": ticks, **rms}, role))
    return Series(name, tuple(points))


def _stacks(request: Request) -> Iterator[Series]:
    width, height, ticks = request.pick((24, 16, 60), (200, 125, 400), (400, 250, 1000))
    stream = fired_stream(ticks, width, height, request.seed)
    out = np.empty((ticks, height, width), np.float32)
    for name, plainly, ours in (("tfp", tfp_plainly, tfp_stack), ("tfi", tfi_plainly, tfi_stack)):
        exact = plainly(stream)
        calls: list[Callable[[], Float32]] = [
            partial(plainly, stream), partial(ours, stream), partial(ours, stream, out=out),
        ]  # fmt: skip
        times = by_turns_ms(calls, request.pick(1, 3, 5))
        points = []
        for title, call, (best, median) in zip(
            ("numpy, unpacked", "from packed bits", "into given memory"), calls, times, strict=True
        ):
            error = float(np.nanmax(np.abs(call() - exact)))
            role: Any = {"numpy, unpacked": "exact", "into given memory": "chosen"}.get(title, "")
            points.append(Point(title, {"ms": best, "median_ms": median, "max": error}, role))
        yield Series(f"{name} at {ticks} ticks of {width}x{height}", tuple(points))


def _numbers(request: Request) -> Iterator[Series]:
    rng, count = np.random.default_rng(request.seed), request.pick(1 << 10, 1 << 18, 1 << 20)
    lights = {
        "radiance 0.001 to 1": 10 ** rng.uniform(-3, 0, count),
        "glaring, 1 to 1000": 10 ** rng.uniform(0, 3, count),
        "dark, 1e-8 to 0.001": 10 ** rng.uniform(-8, -3, count),
    }
    kept: dict[str, tuple[int, Callable[[Any], Any]]] = {
        "float64": (8, np.copy),
        "float32": (4, lambda x: x.astype(np.float32)),
        "half floats": (2, lambda x: x.astype(np.float16)),
        "8-bit sRGB": (1, lambda x: _decoded(encode_srgb(x))),
    }
    for name, light in lights.items():
        times = by_turns_ms([partial(store, light) for _, store in kept.values()], request.pick(1, 3, 5))
        points = []
        for (title, (size, store)), (best, median) in zip(kept.items(), times, strict=True):
            off = np.abs(np.asarray(store(light), np.float64) - light)
            errors = {"relative": float((off / light).max()), "rms": float(np.sqrt(np.mean((off / light) ** 2)))}
            role: Any = {"float64": "exact", "half floats": "chosen"}.get(title, "")
            points.append(Point(title, {"bytes": size, "ms": best, "median_ms": median, **errors}, role))
        yield Series(name, tuple(points))


def _decoded(codes: Any) -> Any:
    """Return the linear radiance of 8-bit sRGB codes (IEC 61966-2-1)."""
    x = codes / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


MAKERS = Measurement(
    id="images",
    group=GROUP,
    title="Images: makers and windows",
    approximation="An image is made from the spikes around an instant; a longer window has less noise and more blur.",
    exact="The radiance that the renderer traced at that instant, at the held-out camera.",
    reason="TFP's 40 ticks are customary. `intervals`, of `spike4dgs-x`, chooses each pixel's window by what the light "
    "does there: long where it is constant, short where it changes.",
    columns=(MS, MEDIAN_MS, _RMS, _MOVING, Column("ticks", "window, ticks")),
    x="ms",
    y=("rms", "moving"),
    run=_makers,
    seconds={"tiny": 20, "quick": 60, "whole": 400},
    held_by="tests/baselines/spike_to_image",
)
STACKS = Measurement(
    id="stacks",
    group=GROUP,
    title="Images at every tick",
    approximation="TFP and TFI of a whole clip from packed bits, in float32, by running sums.",
    exact="The same images by plain numpy from the unpacked clip.",
    reason="Counts are integers and divisions are rounded once: nothing is lost, and the time is that of the result's "
    "memory, so that memory which is given again is fastest.",
    columns=(MS, MEDIAN_MS, Column("max", "largest difference, spikes per tick")),
    x="ms",
    y=("max",),
    run=_stacks,
    seconds={"tiny": 2, "quick": 10, "whole": 60},
    held_by="tests/baselines/spike_to_image",
)
NUMBERS = Measurement(
    id="half-floats",
    group=GROUP,
    title="Images: half floats",
    approximation="Ground truth and training images are kept as half floats: two bytes a pixel.",
    exact="Float64.",
    reason="A half float rounds by 0.05 % at most between 6e-5 and 65,504, far below the noise of a count. 8 bits of "
    "sRGB lose up to 14 % in shadows and everything above white. Below 6e-5 half floats lose digits, and below 3e-8 "
    "all; light of 6e-5 fires a pixel about once a second.",
    columns=(
        Column("bytes", "memory, bytes a pixel"),
        MS,
        MEDIAN_MS,
        Column("rms", "RMS relative error"),
        Column("relative", "largest relative error"),
    ),
    x="bytes",
    y=("rms", "relative"),
    run=_numbers,
    seconds={"tiny": 1, "quick": 2, "whole": 6},
    held_by="tests/studies/twins/test_images.py",
)
