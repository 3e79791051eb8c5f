"""A made scene without files, on which a recipe compiles its kernels before the clock of a fit starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.scene.calibration import Recordings
from spike4dgs.benchmark.scene.cameras import Camera, look_at
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.settings import Settings, SettingsByPart, scaled

_WIDTH, _HEIGHT, _TICKS = 64, 40, 81  # as small as the smallest profile
_RATE_HZ, _GAIN = 20_000.0, 0.6
_DISTANCE_M = 4.0  # from the cameras to the wall


def warm_up_scene() -> tuple[TrainingScene, NDArray[np.float32], NDArray[np.float32]]:
    """Return four views of a textured wall and a bar that moves; and points [N, 3] on the wall with values [N]."""
    aim = np.array([0.0, 0.0, _DISTANCE_M])
    cameras = tuple(
        look_at(
            f"cam_{k}", np.array([x, y, 0.0]), aim, np.array([0.0, -1.0, 0.0]), focal=70, width=_WIDTH, height=_HEIGHT
        )
        for k, (x, y) in enumerate(((-0.2, -0.2), (0.2, -0.2), (-0.2, 0.2), (0.2, 0.2)))
    )
    steady = np.full((_TICKS, _HEIGHT, _WIDTH), 1.0)
    recordings = Recordings(_stream(steady), _stream(0.02 * steady), 1.0)
    streams = tuple(_stream(radiance_of(camera)) for camera in cameras)
    scene = TrainingScene(
        "warm-up", "warm-up", cameras, streams, _RATE_HZ, _TICKS, _GAIN, recordings=(recordings,) * len(cameras)
    )
    y, x = np.mgrid[-1:1:12j, -1.6:1.6:20j].reshape(2, -1)
    points = np.stack([x, y, np.full_like(x, _DISTANCE_M)], axis=1).astype(np.float32)
    return scene, points, _texture(x, y).astype(np.float32)


def short(settings: SettingsByPart) -> dict[str, Settings]:
    """Return settings with three images of each view of the made scene, and a step or a few in each stage."""
    parts: Mapping[str, Any] = settings
    own = {"in_pace": False} if hasattr(parts["motion"], "in_pace") else {}  # few images are far apart
    few = {"images": replace(parts["images"], time_spacing_ticks=30), "motion": replace(parts["motion"], **own)}
    return scaled({**parts, **few}, 0.005)


def _texture(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(0.5 + 0.2 * np.sin(9 * x) + 0.2 * np.cos(7 * y + 3 * x))


def radiance_of(camera: Camera) -> NDArray[np.float64]:
    """Return the radiance [T, H, W] of the wall and the bar."""
    v, u = np.mgrid[:_HEIGHT, :_WIDTH].reshape(2, -1) + 0.5
    world = camera.unproject(np.stack([u, v], axis=1), np.full(len(u), _DISTANCE_M))
    x, y = world[:, 0], world[:, 1]
    middle = np.linspace(-0.4, 0.4, _TICKS)[:, None]
    image = np.where(np.abs(x - middle) < 0.25, 1.0, _texture(x, y))
    return image.reshape(_TICKS, _HEIGHT, _WIDTH)


def _stream(radiance: NDArray[np.float64]) -> SpikeStream:
    """Return the spikes of neurons without noise, as read-only as a mapped file."""
    fired = np.diff(np.floor(np.cumsum(_GAIN * radiance, axis=0)), axis=0, prepend=0)
    packed = pack(fired.astype(np.uint8))
    packed.flags.writeable = False
    return SpikeStream(packed, _WIDTH, _HEIGHT, _RATE_HZ)
