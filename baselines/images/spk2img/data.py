"""Training data of Spk2ImgNet: spikes and the ground truth of ordinary scene folders.

Every image of a scene counts, those of the held-out camera (every 20 ticks) and the sparse ones of the others. The
public benchmark, variant 0 of every world, and hidden seasons are refused: no training may see a scored scene.

Augmentation is exact: the eight symmetries of the square, and time reversal. An integrator's spikes played backwards
are those of an integrator that saw the light backwards; the image of the start of tick t is then that of the end of
tick t, so the reversed window is taken one tick earlier.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.scene import Scene, Target, open_scene
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.variants import PUBLIC_VARIANT, is_reserved
from spike4dgs.method.images.windows import HALF_WINDOW, WINDOW, window


@dataclass(frozen=True, eq=False)
class Example:
    """A stream, a tick, and the truth at the start of that tick."""

    stream: SpikeStream
    tick: int
    rate: Float32  # [H, W] spikes per tick: radiance times gain, and at most 1, where the sensor saturates
    moving: NDArray[np.int64]  # [M] flat indices of the pixels of the moving region
    gain: float  # spikes per tick of white


@dataclass(frozen=True, eq=False)
class Batch:
    """Patches of a training step."""

    spikes: Float32  # [B, 41, P, P] of 0 and 1
    rate: Float32  # [B, P, P]
    gain: Float32  # [B]


def open_for_training(folder: Path, allow_gaps: bool = False) -> Scene:
    """Open a scene folder.

    Raises UserError for one of the public benchmark or of a hidden season, and for a recording with gaps unless
    `allow_gaps`.
    """
    scene = open_scene(folder, allow_gaps)
    variant = scene.meta.get("source", {}).get("variant")
    fix = "make one with `spike4dgs make-dataset WORLD --variant 1`"
    if variant == PUBLIC_VARIANT:
        raise problem(folder, "a training variant (1 or higher)", "the public benchmark's variant 0", fix)
    if is_reserved(variant):
        raise problem(folder, "a training variant", f"variant {variant}, which is kept for hidden seasons", fix)
    return scene


def read_examples(scene: Scene) -> list[Example]:
    """Return the examples of a scene whose spikes are complete, in the order of camera and tick.

    Raises UserError where the scene has none.
    """
    streams = {camera: scene.stream(camera) for camera in scene.meta["streams"]}
    paths = (PurePosixPath(name) for name in sorted(scene.manifest.files) if name.startswith("images/"))
    examples = []
    for path in paths:
        target = Target(path.parent.name, int(path.stem))
        if not _is_whole(streams[target.camera], target.tick):
            continue
        rate = np.clip(scene.ground_truth(target) * np.float32(scene.radiance_gain), 0, 1)
        moving = np.flatnonzero(scene.moving(target))
        examples.append(Example(streams[target.camera], target.tick, rate, moving, scene.radiance_gain))
    if not examples:
        found = "no image that has all its spikes"
        raise problem(scene.root, "a scene with ground truth", found, "train on another scene")
    return examples


def _is_whole(stream: SpikeStream, tick: int) -> bool:
    """Return whether no tick is missing from the windows around `tick`: the image's own, and the reversed one."""
    first, stop = tick - 1 - HALF_WINDOW, tick + HALF_WINDOW + 1  # the reversed window begins a tick earlier
    return all(gap.stop_tick <= first or stop <= gap.first_tick for gap in stream.gaps)


def draw(examples: Sequence[Example], count: int, patch: int, moving_share: float, rng: np.random.Generator) -> Batch:
    """Return `count` random patches, a `moving_share` of them around a moving pixel where there is one.

    `patch` is in pixels, at most the images' shorter side.
    """
    spikes = np.empty((count, WINDOW, patch, patch), np.float32)
    rate = np.empty((count, patch, patch), np.float32)
    gain = np.empty(count, np.float32)
    for k in range(count):
        example = examples[int(rng.integers(len(examples)))]
        spikes[k], rate[k] = _patch(example, patch, rng.random() < moving_share, rng)
        gain[k] = example.gain
    return Batch(spikes, rate, gain)


def _patch(example: Example, size: int, on_motion: bool, rng: np.random.Generator) -> tuple[Float32, Float32]:
    """Return one patch and its truth, turned, flipped and reversed at random."""
    height, width = example.rate.shape
    if on_motion and len(example.moving):
        y, x = divmod(int(rng.choice(example.moving)), width)
        top = int(np.clip(y - rng.integers(size), 0, height - size))
        left = int(np.clip(x - rng.integers(size), 0, width - size))
    else:
        top, left = int(rng.integers(height - size + 1)), int(rng.integers(width - size + 1))
    backwards = bool(rng.random() < 0.5)
    spikes = window(example.stream, example.tick - backwards)[:, top : top + size, left : left + size]
    rate = example.rate[top : top + size, left : left + size]
    if backwards:
        spikes = spikes[::-1]
    turns, flip = int(rng.integers(4)), rng.random() < 0.5
    spikes, rate = np.rot90(spikes, turns, axes=(1, 2)), np.rot90(rate, turns)
    if flip:
        spikes, rate = spikes[:, :, ::-1], rate[:, ::-1]
    return spikes.astype(np.float32), rate
