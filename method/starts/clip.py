"""What the plane sweep matches: the mean of a clip and of its windows, and the pixels that change between these.

A clip comes from the spikes, or from images that other sensors recorded.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, Float64, Mask
from spike4dgs.benchmark.scene.camera_state import Clock, local_window
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.sensor_model import gathered
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.images.recorded import Recorded
from spike4dgs.method.starts.plane_sweep import UNSEEN
from spike4dgs.method.training_views.changes import COUNTS, RECORDED, ChangeSettings, changing, without_specks
from spike4dgs.method.training_views.pinholes import nearest_pixels, seen_pixels, undistorted

_WHOLE = slice(None)


class Clip(Protocol):
    """Windows of a clip, in order of time. Images are radiance, and -1 where a view sees nothing."""

    def __len__(self) -> int:
        """Return the number of windows."""
        ...

    def mean(self, window: int | None = None) -> Float32:
        """Return the mean [C, H, W] of a window, of the whole clip if None."""
        ...

    def moving(self, windows: slice = _WHOLE) -> list[Mask]:
        """Return the pixels [H, W] of each view that change from one of the windows to another."""
        ...


class SpikeClip:
    """Windows of `length` ticks of the streams, corrected by the cameras' calibrations or not."""

    def __init__(self, scene: TrainingScene, length: int, flat_field: bool) -> None:
        self.scene, self.flat_field = scene, flat_field
        count = max(1, scene.n_ticks // length)
        self.windows = [(i * length, min((i + 1) * length, scene.n_ticks)) for i in range(count)]

    def __len__(self) -> int:
        """Return the number of windows."""
        return len(self.windows)

    def time(self, window: int) -> float:
        """Return the middle of a window as a time in [0, 1] of the clip."""
        return sum(self.windows[window]) / 2 / self.scene.n_ticks

    def mean(self, window: int | None = None) -> Float32:
        """Return a mean; see `Clip`."""
        start, stop = (0, self.scene.n_ticks) if window is None else self.windows[window]
        return _marked(self.scene, window_means(self.scene, start, stop, self.flat_field))

    def moving(self, windows: slice = _WHOLE) -> list[Mask]:
        """Return what changes; see `Clip`."""
        streams = zip(self.scene.streams, _clocks(self.scene), strict=True)
        counts = [_extremes(stream, clock, self.windows[windows]) for stream, clock in streams]
        return _seen(self.scene, [_moving(c, COUNTS) for c in counts])


class ImageClip:
    """Images of other sensors, those within `length` ticks as one window."""

    def __init__(self, scene: TrainingScene, recorded: Recorded, length: int) -> None:
        self.scene = scene
        _, first = np.unique(np.array(recorded.ticks) // length, return_index=True)
        sizes = np.diff([*first, len(recorded.ticks)])
        sums = np.add.reduceat(recorded.images, first, axis=0)
        self.images = np.asarray(sums / sizes[:, None, None, None], np.float32)

    def __len__(self) -> int:
        """Return the number of windows."""
        return len(self.images)

    def mean(self, window: int | None = None) -> Float32:
        """Return a mean; see `Clip`."""
        images = self.images.mean(axis=0) if window is None else self.images[window]
        return _marked(self.scene, undistorted(self.scene, images))

    def moving(self, windows: slice = _WHOLE) -> list[Mask]:
        """Return what changes; see `Clip`."""
        chosen = self.images[windows]
        return _seen(self.scene, [_moving(chosen[:, c], RECORDED) for c in range(chosen.shape[1])])


def window_means(scene: TrainingScene, start: int, stop: int, flat_field: bool) -> Float32:
    """Return the mean radiance [C, H, W] of all views in a window of the streams."""
    clocks = zip(scene.streams, _clocks(scene), strict=True)
    rates = np.stack([_rate(s, *local_window(clock, start, stop, s.n_ticks)) for s, clock in clocks])
    if flat_field and scene.calibrations:
        means = np.stack([c.radiance(r) for c, r in zip(scene.calibrations, rates, strict=True)])
    else:
        means = np.asarray(rates / white_rates(scene).astype(np.float32), np.float32)
    return undistorted(scene, means)


def white_rates(scene: TrainingScene) -> Float64:
    """Return the spikes per tick of white [C, 1, 1] of cameras whose calibration is not used."""
    return np.array([scene.radiance_gain * scene.state(camera.id).gain for camera in scene.cameras])[:, None, None]


def _marked(scene: TrainingScene, images: Float32) -> Float32:
    """Return images [C, H, W] with `UNSEEN` where a view sees nothing: the plane sweep compares no such pixel."""
    if seen := seen_pixels(scene):
        images[~np.stack(seen)] = UNSEEN
    return images


def _clocks(scene: TrainingScene) -> list[Clock]:
    return [scene.state(camera.id).clock for camera in scene.cameras]


def _rate(stream: SpikeStream, start: int, stop: int) -> Float32:
    """Return the mean charge per tick [H, W]; clips of any length are counted in parts."""
    parts = range(start, stop, 65535)
    total = np.sum([stream.counts(a, min(a + 65535, stop)) for a in parts], axis=0, dtype=np.float64)
    stream.release()
    return np.asarray(gathered(total / (stop - start), stream.dead_ticks), np.float32)


def _seen(scene: TrainingScene, moving: Sequence[Mask]) -> list[Mask]:
    """Return masks [h, w] of the views from those of their sensors; a pixel not seen does not move."""
    found, seen = nearest_pixels(scene, list(moving)), seen_pixels(scene)
    return [m & s for m, s in zip(found, seen, strict=True)] if seen else found


def _extremes(stream: SpikeStream, clock: Clock, windows: Sequence[tuple[int, int]]) -> NDArray[np.int64]:
    """Return the fewest and the most spikes [2, H, W] of each pixel in a window: all windows' would fill the memory."""
    found = np.array([np.full((stream.height, stream.width), value) for value in (np.iinfo(np.int64).max, 0)])
    for a, b in windows:
        counts = stream.counts(*local_window(clock, a, b, stream.n_ticks))
        np.minimum(found[0], counts, out=found[0])
        np.maximum(found[1], counts, out=found[1])
    stream.release()
    return found


def _moving(images: NDArray[np.int64] | Float32, settings: ChangeSettings) -> Mask:
    """Return the pixels [H, W] whose values [windows, H, W] differ by more than those of constant radiance can."""
    changed = changing(torch.from_numpy(images)[:, None], settings)[0].numpy()
    return cv2.dilate(without_specks(changed), np.ones((3, 3), np.uint8)).astype(bool)
