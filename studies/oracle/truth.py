"""The truth of a scene that oracles are given, as files: a generator writes them, an oracle reads them.

    FOLDER/images/000120.npz   the training cameras' images at a tick: images [C, H, W], linear radiance
    FOLDER/surfaces.npz        what they see, at the middle of the clip: points [N, 3] m, values [N] gray radiance,
                               velocities [N, 3] m/s
    FOLDER/sensors.npz         each camera's maps: gain [C, H, W], mean 1, and dark [C, H, W], spikes per tick

FOLDER belongs to one scene, revision and number of samples. Nothing of a held-out camera is in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.untrusted import Expected, read_npz

_AGAIN = "delete it and run the same command again"


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Points [N, 3] m on surfaces at the middle of the clip, with their gray radiance [N] and velocity [N, 3] m/s."""

    points: Float32
    values: Float32
    velocities: Float32


@dataclass(frozen=True)
class Truth:
    """The truth in a folder. Reading raises UserError where a file is missing or damaged."""

    folder: Path

    @staticmethod
    def of(root: Path, scene: str, revision: str, samples: int) -> Truth:
        """Return the truth of a scene, its images of so many samples a pixel, below the folder of a run's truths."""
        return Truth(root / f"{scene}@{revision[:12]}-{samples}")

    def image_file(self, tick: int) -> Path:
        """Return the file of the images at a tick."""
        return self.folder / "images" / f"{tick:06d}.npz"

    @property
    def surfaces_file(self) -> Path:
        """The file of the points."""
        return self.folder / "surfaces.npz"

    @property
    def sensors_file(self) -> Path:
        """The file of the cameras' maps."""
        return self.folder / "sensors.npz"

    def images(self, ticks: Sequence[int]) -> Float32:
        """Return the training cameras' images [T, C, H, W] at ticks, linear radiance."""
        shape = {"images": Expected("f", (None, None, None))}
        return np.stack([read_npz(self.image_file(t), "true images", shape, _AGAIN)["images"] for t in ticks])

    def surfaces(self) -> Surfaces:
        """Return the points on surfaces."""
        shapes = {"points": Expected("f", (None, 3)), "values": Expected("f", (None,))}
        shapes["velocities"] = Expected("f", (None, 3))
        return Surfaces(**read_npz(self.surfaces_file, "true points", shapes, _AGAIN))

    def calibrations(self, radiance_gain: float) -> tuple[Calibration, ...]:
        """Return the response of each training camera to light; `radiance_gain`: spikes per tick of white."""
        shapes = dict.fromkeys(("gain", "dark"), Expected("f", (None, None, None)))
        maps = read_npz(self.sensors_file, "true gain and dark maps", shapes, _AGAIN)
        return tuple(Calibration(gain, dark, radiance_gain) for gain, dark in zip(*maps.values(), strict=True))
