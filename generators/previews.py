"""Pictures of a scene that was just made: the contact sheet, and a preview of each camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.scene.images import encode_srgb, read_geometry
from spike4dgs.benchmark.scene.other_sensors import read_events
from spike4dgs.benchmark.scene.scene import Scene, Target
from spike4dgs.benchmark.spikes.stream import SpikeStream

_FRAMES, _FRAME_MS, _QUALITY = 45, 60, 35
_WINDOW = 16  # ticks of a count image


def preview(
    keys: Sequence[Float32], key_ticks: Sequence[int], stream: SpikeStream, radiance_gain: float, path: Path
) -> None:
    """Write an endless WebP of about 45 frames. `keys` are radiance [H, W] at `key_ticks`; equal input, equal bytes."""
    from PIL import Image

    last = stream.n_ticks - _WINDOW
    inside = [k for k, tick in enumerate(key_ticks) if tick <= last]
    chosen = inside[:: max(1, round(len(inside) / _FRAMES))]
    frames = []
    for k in chosen:
        counts = stream.counts(int(key_ticks[k]), int(key_ticks[k]) + _WINDOW) / (_WINDOW * radiance_gain)
        both = np.concatenate([np.asarray(keys[k]), counts.astype(np.float32)], axis=1)
        frames.append(Image.fromarray(encode_srgb(both)).convert("RGB"))
    with atomic_path(path) as part:
        frames[0].save(
            part, save_all=True, append_images=frames[1:], duration=_FRAME_MS, loop=0, quality=_QUALITY, method=4
        )


_COUNT_TICKS = 32
_EVENT_US = 2000


def contact_sheet(scene: Scene, path: Path) -> None:
    """Write a PNG of about 1600 px: truth, geometry, spikes, the other sensors, cameras. Equal scenes, equal bytes."""
    from matplotlib.figure import Figure

    held_out = scene.test[0]
    targets = [t for t in scene.targets if t.camera == held_out]
    middle = targets[len(targets) // 2]
    aspect = scene.meta["width"] / scene.meta["height"]
    figure = Figure(figsize=(16, 16 / 5 / aspect * 4 + 1.5), layout="constrained")
    rows: list[list[tuple[str, Any]]] = [
        [
            (f"truth, {t.tick * 1e3 / scene.rate_hz:g} ms", encode_srgb(scene.ground_truth_rgb(t)))
            for t in _five(targets)
        ],
        _geometry(scene, middle),
        _sensors(scene, middle),
        [(c, _counts(scene, c, middle.tick)) for c in list(scene.cameras)[:5]],
    ]
    for row, grid in zip(rows, figure.subplots(len(rows), 5), strict=True):
        for axes in grid:
            axes.axis("off")
        for axes, (title, image) in zip(grid, row, strict=False):
            axes.imshow(image, cmap="gray", interpolation="nearest")
            axes.set_title(title, fontsize=10)
    ms = scene.n_ticks * 1e3 / scene.rate_hz
    size = f"{scene.meta['width']}x{scene.meta['height']}"
    figure.suptitle(
        f"{scene.id}: {scene.meta['title']}. {len(scene.cameras)} cameras, {size}, {ms:g} ms, {scene.rate_hz:g} Hz"
    )
    with atomic_path(path) as part:
        figure.savefig(part, dpi=100, metadata={"Software": None}, pil_kwargs={"optimize": True})


def _five(targets: list[Target]) -> list[Target]:
    return [targets[i] for i in np.linspace(0, len(targets) - 1, min(5, len(targets))).round().astype(int)]


def _geometry(scene: Scene, target: Target) -> list[tuple[str, Any]]:
    geometry = read_geometry(scene.manifest.path(f"geometry/{target.name}.exr"))
    depth = 1 / geometry.depth
    low, high = np.percentile(depth[np.isfinite(depth)], [1, 99])
    return [
        ("inverse depth", np.clip((depth - low) / max(high - low, 1e-9), 0, 1)),
        ("moving things", _colours(geometry.ids)),
        ("moving region", scene.moving(target)),
        (f"flow, up to {np.linalg.norm(geometry.flow, axis=-1).max():.1f} px/ms", _wheel(geometry.flow)),
        ("truth, gray", encode_srgb(scene.ground_truth(target))),
    ]


def _sensors(scene: Scene, target: Target) -> list[tuple[str, Any]]:
    stream = scene.stream(target.camera)
    shown: list[tuple[str, Any]] = [
        ("spikes of one tick", stream.window(target.tick, target.tick + 1)[0]),
        (f"counts of {_COUNT_TICKS} ticks", _counts(scene, target.camera, target.tick)),
    ]
    files = sorted(f for f in scene.manifest.files if f.startswith(f"conventional/{target.camera}/"))
    if files:
        shown.append((f"conventional, {scene.meta['conventional']['fps']} fps", _png(scene.manifest.path(files[0]))))
    name = f"events/{target.camera}.npz"
    if name in scene.manifest.files:
        t_us = scene.t_us(target.tick)
        shown.append((f"events of {_EVENT_US / 1e3:g} ms", _events(scene, name, t_us)))
    return shown


def _counts(scene: Scene, camera: str, tick: int) -> NDArray[np.uint8]:
    start = min(max(tick - _COUNT_TICKS // 2, 0), max(scene.n_ticks - _COUNT_TICKS, 0))
    end = min(start + _COUNT_TICKS, scene.n_ticks)
    counts = scene.stream(camera).counts(start, end)
    return encode_srgb((counts / ((end - start) * scene.radiance_gain)).astype(np.float32))


def _png(path: Path) -> NDArray[np.uint8]:
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image)


def _events(scene: Scene, name: str, t_us: float) -> NDArray[np.float64]:
    """Return events as an image: brighter red, darker blue, on white."""
    found = read_events(scene.manifest.path(name))
    now = (found.t >= t_us) & (found.t < t_us + _EVENT_US)
    image = np.ones((scene.meta["height"], scene.meta["width"], 3))
    for polarity, colour in ((1, (0.8, 0.1, 0.1)), (0, (0.1, 0.2, 0.8))):
        mine = now & (found.p == polarity)
        image[found.y[mine], found.x[mine]] = colour
    return image


def _colours(ids: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Return one colour for each number, black for 0."""
    hue = (ids * 0.381966) % 1
    return _hsv(hue, np.where(ids > 0, 0.75, 0.0), np.where(ids > 0, 0.95, 0.0))


def _wheel(flow: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the flow as an image: direction as hue, length as saturation."""
    length = np.linalg.norm(flow, axis=-1)
    hue = (np.arctan2(flow[..., 1], flow[..., 0]) / (2 * np.pi)) % 1
    return _hsv(hue, length / max(float(length.max()), 1e-9), np.ones_like(length))


def _hsv(*channels: NDArray[Any]) -> NDArray[np.float64]:
    from matplotlib.colors import hsv_to_rgb

    return np.asarray(hsv_to_rgb(np.stack([np.asarray(c, np.float64) for c in channels], axis=-1)))
