"""The sensors that a method takes, and what a camera of each sends."""

from __future__ import annotations

from spike4dgs.benchmark.method import DEFAULT_GIVEN, Method
from spike4dgs.benchmark.scene.scene import Scene

SPIKES = "spikes"
BITS_OF_A_PIXEL = 8  # of a frame; scenes hold 8-bit PNG
BITS_OF_AN_EVENT = 64  # 4 bytes of address, 4 of time (libcaer, AEDAT); compressed codes take less


def sensors_of(method: Method) -> tuple[str, ...]:
    """Return the sensors that a method takes: of frames and events those that it is given, or spikes."""
    given = getattr(method, "given", DEFAULT_GIVEN)
    return tuple(kind for kind in ("frames", "events") if kind in given) or (SPIKES,)


def bits_per_second(scene: Scene, sensors: tuple[str, ...]) -> float:
    """Return what a camera of some kinds sends: all of its pixels, or its events, measured on the training cameras."""
    return sum(_bits_of(scene, sensor) for sensor in sensors)


def _bits_of(scene: Scene, sensor: str) -> float:
    pixels = int(scene.meta["width"]) * int(scene.meta["height"])
    if sensor == SPIKES:
        return pixels * scene.rate_hz
    training = scene.training
    if sensor == "frames":
        return pixels * BITS_OF_A_PIXEL * training.frames(training.cameras[0].id).fps
    count = sum(len(training.events(camera.id)) for camera in training.cameras) / len(training.cameras)
    return BITS_OF_AN_EVENT * count / (1e-6 * training.duration_us)
