"""How the cost of the spike simulator grows: pixels, length of the clip, threads."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from spike4dgs.benchmark.spikes.sensor_model import SENSOR
from spike4dgs.generators.profiles import RATE_HZ
from spike4dgs.generators.sensor.calibration import dark_map, gain_map
from spike4dgs.generators.sensor.model import Sensor, random_charge, simulate
from spike4dgs.studies.speed.growth import growth, thread_counts, timed
from spike4dgs.studies.speed.simulate import pattern
from spike4dgs.studies.speed_error.measurement import Column, Request, Series

SPACING = 10  # ticks between keys


def _run(width: int, height: int, ticks: int, moving: float, threads: int | None = None) -> Any:
    """Return a call that simulates one camera with maps and shot noise; all keys are made in advance."""
    at = list(range(0, ticks + SPACING, SPACING))
    few = pattern(height, width, min(len(at), 16), moving)
    keys = [few[k % len(few)] for k in range(len(at))]  # a long clip repeats them: its memory does not grow
    maps = gain_map(height, width, 0, "cam_00"), dark_map(height, width, 0, "cam_00")
    sensor = Sensor(gain=maps[0], dark=maps[1], photons=SENSOR.photons_per_spike)
    charge = random_charge(height, width, [0])

    def run() -> int:
        return sum(len(part) for part in simulate(keys, at, ticks, sensor, charge, threads=threads))

    return run


def _turns(request: Request) -> int:
    return int(request.pick(1, 3, 5))


def _pixels(request: Request) -> Iterator[Series]:
    sizes = request.pick(
        ((24, 16), (48, 32)),
        ((200, 125), (400, 250), (800, 500), (1000, 1000)),
        ((200, 125), (400, 250), (800, 500), (1000, 1000)),
    )
    ticks = request.pick(40, 200, 1000)
    for moving in (1.0, 0.1):
        calls = {float(w * h): _run(w, h, ticks, moving) for w, h in sizes}
        yield timed(calls, f"{ticks} ticks, {moving:.0%} of the pixels move", "pixels", _turns(request))


def _clips(request: Request) -> Iterator[Series]:
    lengths = request.pick((1, 2), (10, 30, 100), (10, 30, 100, 300, 1000))
    width, height = request.pick((24, 16), (200, 125), (400, 250))
    for moving in (1.0, 0.1):
        calls = {float(ms): _run(width, height, ms * RATE_HZ // 1000, moving) for ms in lengths}
        yield timed(calls, f"{width}x{height}, {moving:.0%} of the pixels move", "clip", _turns(request))


def _threads(request: Request) -> Iterator[Series]:
    width, height, ticks = request.pick((24, 16, 40), (400, 250, 400), (400, 250, 2000))
    calls = {float(n): _run(width, height, ticks, 1.0, n) for n in thread_counts()}
    yield timed(calls, f"{ticks} ticks of {width}x{height}", "threads", _turns(request))


SCALE = (
    growth("scale-sensor-pixels", "Sensor: pixels", "One camera, with maps and shot noise; a key every 10 ticks.",
           Column("pixels", "pixels"), _pixels, (1, 15, 60)),
    growth("scale-sensor-clip", "Sensor: length of the clip", "10 to 1000 ms; memory does not grow with the clip.",
           Column("clip", "clip, ms"), _clips, (1, 10, 90)),
    growth("scale-sensor-threads", "Sensor: threads", "1 to 16, as many as the machine has cores.",
           Column("threads", "threads"), _threads, (1, 5, 30)),
)  # fmt: skip
