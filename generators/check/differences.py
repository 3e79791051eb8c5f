"""How much two scenes of the same cameras and clock differ in what noise changes: spikes and truth.

Noise is independent from pixel to pixel and so falls in the means of blocks; a change of the world does not.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.scene.scene import Scene, Target
from spike4dgs.benchmark.spikes.stream import SpikeStream

BLOCK_PX = 8  # means of 64 pixels have an eighth of the noise
WINDOW_TICKS = 100  # of spike counts: 5 ms at 20 kHz
_TICKS = 256  # compared at a time

Float64 = NDArray[np.float64]


@dataclass(frozen=True)
class Difference:
    """The difference of one camera between two scenes. Radiance and spikes per tick are linear, 1 is white or always.

    Attributes:
        bits: share of the spike bits that differ.
        spikes_block_rms, spikes_block_max: of the means of spikes per tick in blocks of BLOCK_PX and WINDOW_TICKS.
        truth_rms: of the radiance of all images, clipped to [0, 1]; None where the camera has no images.
        truth_block_rms, truth_block_max: of its means in blocks of BLOCK_PX.
    """

    bits: float
    spikes_block_rms: float
    spikes_block_max: float
    truth_rms: float | None = None
    truth_block_rms: float | None = None
    truth_block_max: float | None = None

    @property
    def truth_db(self) -> float | None:
        """The PSNR between the truths; None where there are none or where they are equal."""
        return -20 * float(np.log10(self.truth_rms)) if self.truth_rms else None

    @property
    def record(self) -> dict[str, Any]:
        """The values as JSON."""
        return {**asdict(self), "truth_db": self.truth_db}


def difference(a: Scene, b: Scene, camera: str) -> Difference:
    """Return how much a camera differs between two scenes of one clock, size and list of images."""
    streams = a.stream(camera), b.stream(camera)
    blocks = _counted_blocks(*streams)
    spikes = bits_that_differ(*streams), _rms(blocks), float(np.abs(blocks).max(initial=0))
    errors = [error for target in images_of(a, camera) if (error := truth_error(a, b, target)) is not None]
    if not errors:
        return Difference(*spikes)
    means = np.stack([block_means(error) for error in errors])
    return Difference(*spikes, _rms(np.stack(errors)), _rms(means), float(np.abs(means).max()))


def images_of(scene: Scene, camera: str) -> list[Target]:
    """Return all ground-truth images of a camera, in order of time."""
    names = sorted(n for n in scene.manifest.files if n.startswith(f"images/{camera}/"))
    return [Target(camera, int(name.rpartition("/")[2].removesuffix(".exr"))) for name in names]


def truth_error(a: Scene, b: Scene, target: Target) -> Float64 | None:
    """Return the difference of two truths [H, W], clipped to [0, 1] as for a score; None if `b` lacks the image."""
    if f"images/{target.name}.exr" not in b.manifest.files:
        return None
    first, second = (np.clip(scene.ground_truth(target).astype(np.float64), 0, 1) for scene in (a, b))
    return np.asarray(first - second)


def bits_that_differ(a: SpikeStream, b: SpikeStream) -> float:
    """Return the share of the pixels and ticks of two streams at which one fires alone."""
    found = 0
    for start in range(0, a.n_ticks, _TICKS):
        part = slice(start, start + _TICKS)
        found += int(np.bitwise_count(a.packed[part] ^ b.packed[part]).sum(dtype=np.int64))
    return found / (a.n_ticks * a.width * a.height)


def block_means(image: Float64) -> Float64:
    """Return the means of an image [H, W] in blocks of BLOCK_PX; what is over at the right and below is left out."""
    height, width = (n // BLOCK_PX for n in image.shape)
    blocks = image[: height * BLOCK_PX, : width * BLOCK_PX].reshape(height, BLOCK_PX, width, BLOCK_PX)
    return np.asarray(blocks.mean(axis=(1, 3)))


def _counted_blocks(a: SpikeStream, b: SpikeStream) -> Float64:
    """Return the differences of spikes per tick in blocks of pixels and windows of ticks."""
    length = min(WINDOW_TICKS, a.n_ticks)
    starts = range(0, a.n_ticks - length + 1, length)
    counts = [a.counts(t, t + length).astype(np.float64) - b.counts(t, t + length) for t in starts]
    return np.stack([block_means(c / length) for c in counts])


def _rms(values: Float64) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0
