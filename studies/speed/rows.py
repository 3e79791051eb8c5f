"""A row of `speed images`: the time that one image maker takes, and the quality of its images.

Quality is measured at the scenes' held-out cameras: a maker sees the held-out stream itself, and its images of the
scored ticks are compared with the ground truth, as the benchmark compares a method's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.metrics.image_pair import ImagePair, check_images
from spike4dgs.benchmark.metrics.measure import mean
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.scene.calibration import estimate
from spike4dgs.benchmark.scene.scene import Scene, Target
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.studies.speed.streams import fired_stream
from spike4dgs.studies.speed.timing import time_ms

MakeImage = Callable[[], Float32]  # makes one image, [H, W] linear radiance
Prepare = Callable[[SpikeStream, int, float], MakeImage]  # stream, tick, gain: all that comes before the clock starts
Quality = Mapping[str, Mapping[str, float | None]]  # scene id -> metric id -> mean
QUALITY = ("psnr", "ssim", "psnr_dynamic")
OURS = "spike4dgs"
WIDTH, HEIGHT, TICKS = 400, 250, 400  # of the stream that all are timed on


@dataclass(frozen=True)
class Row:
    """The measurements of one image maker. A value that does not exist is None, and `note` says why."""

    name: str  # the entry of IMAGES, or ours that it corresponds to
    by: str
    ms: float | None = None  # an image of 400x250, median
    scene_ms: float | None = None  # an image of the first scene's size, median
    quality: Quality = field(default_factory=dict)
    corrected: Quality = field(default_factory=dict)  # of images corrected by the camera's calibration
    note: str = ""

    @property
    def title(self) -> str:
        """The name, and by whom if not by us."""
        return self.name if self.by == OURS else f"{self.name}, {self.by}"

    def mean(self, metric: str) -> float | None:
        """Return the mean over the scenes of a metric; None where there is none."""
        return mean([values[metric] for values in self.quality.values()])

    def corrected_mean(self, metric: str) -> float | None:
        """Return the same of corrected images."""
        return mean([values[metric] for values in self.corrected.values()])


def timed_stream() -> SpikeStream:
    """Return the stream that all are timed on."""
    return fired_stream(TICKS, WIDTH, HEIGHT)


def timed_size() -> str:
    """Return the size of its images, for a table's head."""
    return f"{WIDTH}x{HEIGHT}"


def measured(row: Row, prepare: Prepare, scenes: Sequence[Scene], repeats: int, scored: bool = True) -> Row:
    """Return the row with time and quality, or with the reason where the maker cannot run."""
    stream = timed_stream()
    try:
        ms = time_ms(prepare(stream, stream.n_ticks // 2, 1.0), repeats)[1]
    except UserError as e:  # no weights, for example
        return replace(row, note=str(e))
    scene_ms = time_ms(prepare(*held_out(scenes[0], middle_target(scenes[0]))), repeats)[1] if scenes else None

    def make(scene: Scene, target: Target) -> Float32:
        return prepare(*held_out(scene, target))()

    quality = {scene.id: _score(make, scene) for scene in scenes} if scored else {}
    return replace(row, ms=ms, scene_ms=scene_ms, quality=quality)


def corrected_quality(maker: ImageMaker, scenes: Sequence[Scene]) -> Quality:
    """Return the scores of images that know their camera, on scenes with recordings to calibrate it by."""
    known = [s for s in scenes if all(s.recordings(c) for c in s.test)]
    cameras = {(s.id, c): estimate(r) for s in known for c in s.test if (r := s.recordings(c))}

    def make(scene: Scene, target: Target) -> Float32:
        stream, tick, gain = held_out(scene, target)
        image = maker(stream, [tick], gain, cameras[scene.id, target.camera])[0]
        return np.nan_to_num(image)  # a dead pixel counts as black: something has to be compared

    return {scene.id: _score(make, scene) for scene in known}


def held_out(scene: Scene, target: Target) -> tuple[SpikeStream, int, float]:
    """Return the stream, the tick and the gain that a maker gets for a scored image."""
    return scene.stream(target.camera), target.tick, scene.radiance_gain


def middle_target(scene: Scene) -> Target:
    """Return the scored image in the middle of the list. Raises UserError for a scene without any."""
    if not scene.targets:
        raise problem(scene.root, "a scene with targets", "none in targets.json", "use a scene that has ground truth")
    return scene.targets[len(scene.targets) // 2]


def _score(make: Callable[[Scene, Target], Float32], scene: Scene) -> dict[str, float | None]:
    """Return the means over a scene's targets."""
    found: dict[str, list[float | None]] = {metric: [] for metric in QUALITY}
    for target in scene.targets:
        image, truth, moving = make(scene, target), scene.ground_truth(target), scene.moving(target)
        where = f"{scene.id}, {target.name}"
        check_images(truth, image, moving, where)
        pair = ImagePair(truth, image, moving, where)
        for metric in QUALITY:
            found[metric].append(METRICS[metric].measure(pair))
    return {metric: mean([v for v in values if v is not None]) for metric, values in found.items()}
