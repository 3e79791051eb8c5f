"""How costs grow: rendering and the spike simulator with pixels, Gaussians, views, threads and the clip; metrics."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch

from spike4dgs.benchmark.environment import available_cores
from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.metrics.iqa.metaiqa import metaiqa_network, predict
from spike4dgs.benchmark.metrics.lpips import TRUNKS, empty_trunk, make_network
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.spikes.sensor_model import SENSOR
from spike4dgs.generators.sensor.calibration import dark_map, gain_map
from spike4dgs.generators.sensor.model import Sensor, random_charge, simulate
from spike4dgs.method.splat import Splats, Views, render
from spike4dgs.method.splat.kernels.threads import get_threads, set_threads
from spike4dgs.method.splat.ssim import ssim
from spike4dgs.method.torch_state import one_torch_thread
from spike4dgs.studies.kit.measurement import TIMES, Column, Request, Series, Size, measurement, timed
from spike4dgs.studies.speed_error.gaussians import random_scene
from spike4dgs.studies.speed_error.networks import differentiate
from spike4dgs.studies.speed_error.scores import make_image_pair
from spike4dgs.studies.speed_error.sensor import SPACING, pattern

SIZES = ((200, 125), (283, 177), (400, 250), (566, 354), (800, 500), (1000, 1000))  # width, height
Call = Callable[[], Any]


def _grows(id: str, title: str, column: Column, least: Size = "tiny") -> Any:
    return measurement(id, "How costs grow", title, (column, *TIMES), ("ms",), least=least)


def _image(splats: Splats, views: Views) -> Any:
    with torch.no_grad():
        return render(splats, views, backend="cpu").image


def _step(splats: Splats, views: Views) -> Any:
    leaves = [t.requires_grad_() for t in splats.tensors]
    image = render(Splats(*leaves), views, backend="cpu").image
    return torch.autograd.grad(image.sum(), leaves)


RENDERS = {"render": _image, "render and differentiate": _step}


def _timed(calls: dict[float, Call], name: str, column: str, request: Request) -> Series:
    with one_torch_thread():
        return timed(calls, name, column, request.pick(1, 5, 9))


@_grows("scale-pixels", "Pixels", Column("pixels", "pixels"))
def pixels(request: Request) -> Iterator[Series]:
    """125x200 to 1000x1000; the Gaussians grow with the image."""
    n, sizes = request.pick((100, ((24, 16), (48, 32))), (20_000, SIZES), (20_000, SIZES))
    scenes = {float(w * h): random_scene(n, request.seed, w, h) for w, h in sizes}
    for name, call in RENDERS.items():
        title = f"{name} {n} Gaussians"
        yield _timed({k: partial(call, *s) for k, s in scenes.items()}, title, "pixels", request)
    images = {float(w * h): torch.rand(2, 1, h, w) for w, h in sizes}
    calls: dict[float, Call] = {k: partial(differentiate, ssim, *pair) for k, pair in images.items()}
    yield _timed(calls, "SSIM and its gradient", "pixels", request)


@_grows("scale-gaussians", "Gaussians", Column("count", "Gaussians"))
def gaussians(request: Request) -> Iterator[Series]:
    """More Gaussians are smaller, so that they cover the same image."""
    counts = request.pick(
        (10, 100), (1000, 10_000, 100_000, 1_000_000), (1000, 3000, 10_000, 30_000, 100_000, 1_000_000)
    )
    size = request.pick((24, 16), (200, 125), (400, 250))
    scenes = {}
    for n in counts:
        splats, seen = random_scene(n, request.seed, *size)
        shrink = (max(counts[0], 5000) / max(n, 5000)) ** 0.5
        scenes[float(n)] = replace(splats, scales=shrink * splats.scales), seen
    for name, call in RENDERS.items():
        title = f"{name}, {size[0]}x{size[1]}"
        yield _timed({n: partial(call, *s) for n, s in scenes.items()}, title, "count", request)


@_grows("scale-views", "Views", Column("views", "views", log=False))
def views(request: Request) -> Iterator[Series]:
    """All views are rendered in one call, whose threads share them out."""
    counts = request.pick((1, 2), (3, 8, 15, 25), (3, 5, 8, 15, 25))
    n, size = request.pick(50, 20_000, 20_000), request.pick((24, 16), (200, 125), (400, 250))
    splats, one = random_scene(n, request.seed, *size)
    many = {float(k): Views(one.w2c.expand(k, 4, 4), one.K.expand(k, 3, 3), one.width, one.height) for k in counts}
    for name, call in RENDERS.items():
        yield _timed({k: partial(call, splats, v) for k, v in many.items()}, name, "views", request)


def thread_counts() -> list[int]:
    """Return the numbers of threads to compare: powers of two up to 16, as many as this machine has cores."""
    return [n for n in (1, 2, 4, 8, 16) if n <= available_cores()]


@_grows("scale-threads", "Threads", Column("threads", "threads"))
def threads(request: Request) -> Iterator[Series]:
    """1 to 16, as many as the machine has cores."""
    n, size = request.pick(50, 50_000, 50_000), request.pick((24, 16), (400, 250), (800, 500))
    scene, before = random_scene(n, request.seed, *size), get_threads()

    def with_threads(count: int, call: Callable[..., Any]) -> Any:
        set_threads(count)
        return call(*scene)

    try:
        for name, call in RENDERS.items():
            yield _timed({float(n): partial(with_threads, n, call) for n in thread_counts()}, name, "threads", request)
    finally:
        set_threads(before)


def _sensor(width: int, height: int, ticks: int, threads: int) -> Call:
    """Return a call that simulates one camera with maps and shot noise; all keys are made in advance."""
    at = list(range(0, ticks + SPACING, SPACING))
    few = pattern(height, width, min(len(at), 16), 1.0)
    keys = [few[k % len(few)] for k in range(len(at))]  # a long clip repeats them: its memory does not grow
    maps = gain_map(height, width, 0, "cam_00"), dark_map(height, width, 0, "cam_00")
    sensor = Sensor(gain=maps[0], dark=maps[1], photons=SENSOR.photons_per_spike)
    charge = random_charge(height, width, [0])
    return lambda: sum(len(part) for part in simulate(keys, at, ticks, sensor, charge, threads=threads))


@_grows("scale-sensor-threads", "Sensor: threads", Column("threads", "threads"))
def sensor_threads(request: Request) -> Iterator[Series]:
    """1 to 16, as many as the machine has cores."""
    width, height, ticks = request.pick((24, 16, 40), (400, 250, 400), (400, 250, 2000))
    calls = {float(n): _sensor(width, height, ticks, int(n)) for n in thread_counts()}
    yield timed(calls, f"{ticks} ticks of {width}x{height}", "threads", request.pick(1, 3, 5))


@_grows("scale-metrics", "Metrics", Column("pixels", "pixels"), least="quick")
def metrics(request: Request) -> Iterator[Series]:
    """Every metric of images, for one image of the profiles small and paper. Networks have random weights: that changes
    the value, not the work.
    """
    sizes = request.pick(((96, 192),), ((125, 200), (250, 400)), ((125, 200), (250, 400)))
    calls = {float(h * w): _metrics(make_image_pair(h, w)) for h, w in sizes}
    for name in calls[float(np.prod(sizes[0]))]:
        yield _timed({n: of[name] for n, of in calls.items()}, name, "pixels", request)


def _metrics(pair: ImagePair) -> dict[str, Call]:
    """Return a call for each metric of images; a copy of the pair has nothing cached."""
    own = [m for m in METRICS.values() if not m.aligned and m.weights is None and m.takes != "spikes"]
    calls: dict[str, Call] = {m.id: partial(lambda m: m.measure(replace(pair)), m) for m in own}
    for net in TRUNKS:
        network = make_network(net, empty_trunk(net).eval())
        calls[f"lpips_{net}"] = partial(network.distance, pair.truth8, pair.prediction8)
    return {**calls, "metaiqa": partial(predict, metaiqa_network().eval(), pair.prediction8)}
