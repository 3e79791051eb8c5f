"""Training images of a fit: at which ticks they are made, and by what."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch

from spike4dgs.benchmark.arrays import Float32, Half
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.camera_state import Clock, local_ticks
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.spikes.trains import spike_trains
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.images.light import Light, PixelLight
from spike4dgs.method.images.local_light import shared
from spike4dgs.method.images.recorded import Recorded
from spike4dgs.method.settings import Settings
from spike4dgs.method.splat import Views
from spike4dgs.method.training_views.training_images import Spans, TrainingImages, bad_pixels, fill_dead, missing_images


@dataclass(frozen=True)
class ImageSettings(Settings):
    """Times at which images are made from the spikes, and their correction (prefix `images`)."""

    time_spacing_ticks: int = 10  # 0.5 ms at 20 kHz: half a ground-truth interval
    edge_ticks: int = 10  # windows nearer to the clip's ends are cut, and their images belong to a later time
    max_times: int = 256  # bounds memory: 256 times x 8 views of 250x400 are 0.8 GB
    flat_field: bool = False  # correct the images by each camera's calibrated gain n(x, y) and dark rate, if known

    def __post_init__(self) -> None:
        if self.time_spacing_ticks < 1 or self.max_times < 1 or self.edge_ticks < 0:
            expected = "time_spacing_ticks and max_times of 1 or more, edge_ticks of 0 or more"
            found = f"{self.time_spacing_ticks}, {self.max_times} and {self.edge_ticks}"
            raise problem("settings of images", expected, found, "correct them")

    def denser(self, pace: float) -> Self:
        """Return settings with so many times as many images."""
        return replace(self, time_spacing_ticks=max(1, round(self.time_spacing_ticks / pace)))


def wanted_images(n_ticks: int, settings: ImageSettings) -> float:
    """Return how many images of a view a clip has room for, edges included."""
    return min(settings.max_times, n_ticks / settings.time_spacing_ticks)


def choose_ticks(n_ticks: int, settings: ImageSettings) -> tuple[int, ...]:
    """Return the ticks of the training images: evenly spaced, an edge away from the clip's ends."""
    edge = min(settings.edge_ticks, (n_ticks - 1) // 2)
    span = n_ticks - 2 * edge
    count = min(settings.max_times, max(1, round(span / settings.time_spacing_ticks) + 1))
    if count == 1:
        return (n_ticks // 2,)
    return tuple(sorted({int(t) for t in np.rint(np.linspace(edge, n_ticks - 1 - edge, count))}))


def make_training_images(
    scene: TrainingScene,
    cameras: Sequence[Camera],
    make: ImageMaker,
    settings: ImageSettings,
    device: str,
    light: Light | None = None,
) -> TrainingImages:
    """Return images of all training views at the chosen times, at the streams' pixels; `cameras` have the fit's poses.

    `light` is what changes in the scene's light, if anything: makers that know of it show mean light. Where it is a
    lamp's they show the light that there is, and the images say so. A dead pixel, which has no value, counts as bad.
    """
    ticks, made, spans = make_images(scene, make, settings, device, light)
    dead, bad, missing = fill_dead(made), bad_pixels(scene), missing_images(scene, ticks)
    images = torch.from_numpy(made).to(device)
    known_bad = [np.asarray(found) for found in (dead, bad) if found is not None]
    masks = torch.from_numpy(np.logical_or.reduce(known_bad)).to(device) if known_bad else None
    lacking = None if missing is None else torch.from_numpy(missing).to(device)
    views, lamp = Views.from_cameras(cameras, device=device), light.factors if light and light.local else None
    return TrainingImages(views, ticks, images, scene.n_ticks, masks, lacking, spans, light=lamp)


def recorded_training_images(
    scene: TrainingScene, cameras: Sequence[Camera], recorded: Recorded, device: str
) -> TrainingImages:
    """Return images of other sensors, at the poses of `cameras`."""
    images = torch.from_numpy(recorded.images).to(device)
    views = Views.from_cameras(cameras, device=device)
    return TrainingImages(views, recorded.ticks, images, scene.n_ticks, exposure_ticks=recorded.exposure_ticks)


def make_images(
    scene: TrainingScene, make: ImageMaker, settings: ImageSettings, device: str, light: Light | None = None
) -> tuple[tuple[int, ...], Float32, Spans | None]:
    """Return the chosen ticks, the images [T, C, H, W] at the streams' pixels, and the spans that they are means over.

    Ticks are the array's. A camera's image is made at its own tick then, or at the end of its clip nearest to it. No
    spans: the images show instants.
    """
    make = make.on(device)
    ticks = choose_ticks(scene.n_ticks, settings)
    height, width = scene.streams[0].height, scene.streams[0].width
    images = np.empty((len(ticks), len(scene.cameras), height, width), np.float32)
    spans: list[Half] = []
    doubts: list[Half | None] = []
    for c, (camera, stream) in enumerate(zip(scene.cameras, scene.streams, strict=True)):
        state = scene.state(camera.id)
        own, _ = local_ticks(state.clock, ticks, scene.n_ticks)
        calibration = scene.calibrations[c] if settings.flat_field and scene.calibrations else None
        gain = scene.radiance_gain * (1.0 if calibration else state.gain)
        lit = make.in_light(_own_light(light, stream, state.clock)) if light else make
        images[:, c], over, doubtful = lit.with_spans(stream, own, gain, calibration)
        if over is not None:
            with np.errstate(over="ignore"):  # beyond 65,504 ticks infinite: no correction follows spans that long
                spans.append(over.astype(np.float16))
            doubts.append(None if doubtful is None else doubtful.astype(np.float16))
        spike_trains.cache_clear()  # else two streams' trains would be in memory
        stream.release()
    return ticks, images, _spans(scene, spans, doubts, device) if spans else None


def _own_light(light: Light, stream: SpikeStream, clock: Clock) -> PixelLight:
    """Return the light of one camera's clip."""
    gathered = light.gathered(clock, stream.n_ticks)
    return shared(stream, gathered) if light.local else PixelLight(gathered)


def _spans(scene: TrainingScene, measured: list[Half], doubts: list[Half | None], device: str) -> Spans:
    """Return the spans of time that the training images [T, C] are means over."""
    ends = np.stack(measured, axis=1)
    lengths = (ends[:, :, 1] - ends[:, :, 0]).astype(np.float32)
    known = lengths[lengths > 0] if lengths.any() else np.ones_like(lengths)  # light is the same all the time
    half = float(np.median(known)) / 2
    doubtful = None
    if any(own is not None for own in doubts):
        none = np.zeros((len(ends), 4, *ends.shape[3:]), np.float16)
        doubtful = torch.from_numpy(np.stack([none if own is None else own for own in doubts], 1)).to(device)
    return Spans(torch.from_numpy(ends).to(device), half, scene.n_ticks, doubtful)


def as_measured(scene: TrainingScene, ticks: Sequence[int], images: Float32) -> Float32:
    """Return images of `make_images` with NaN where nothing was measured: bad pixels, long gaps, beyond a clip."""
    bad, missing, out = bad_pixels(scene), missing_images(scene, ticks), images.copy()
    if bad is not None:
        out[:, np.stack(bad)] = math.nan
    if missing is not None:
        out[missing] = math.nan
    return out
