"""A scene of footage: simulated spike cameras in the places of the cameras that filmed it.

A frame is shown to the sensor for some ticks, then the next one: light changes in steps, and within an instant nothing
moves. The truth of the held-out camera is its frame, shrunk like those that the sensors see. So a scene has real
lenses, textures, light and calibration; its spikes, its rate and its steps of time are simulated.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_dilation, binary_opening

from spike4dgs.benchmark.arrays import Float32, Mask, UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import filling
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import decode_srgb, gray, write_exr, write_mask
from spike4dgs.benchmark.scene.scene import Target
from spike4dgs.benchmark.scene.writer import SceneDescription, finish_scene, stream_name
from spike4dgs.benchmark.spikes.sensor_model import SENSOR
from spike4dgs.benchmark.spikes.stream import SpikeWriter
from spike4dgs.benchmark.untrusted import check_ids
from spike4dgs.generators.held_frames.footage import Footage, read_frames
from spike4dgs.generators.profiles import RATE_HZ
from spike4dgs.generators.sensor.calibration import (
    calibration_facts,
    noisy_facts,
    noisy_sensor,
    write_calibration,
    write_maps,
)
from spike4dgs.generators.sensor.model import random_charge, simulate

_FEWEST_TICKS, _MOST_TICKS = 2, 20_000  # of an instant
_CHANGE, _LEAST, _GROW_PX = 0.15, 0.03, 2  # of the moving region: share of the median, radiance, pixels


@dataclass(frozen=True)
class Holding:
    """How frames are shown to the simulated cameras.

    Args:
        held_out: Camera that is scored and that no method sees.
        width: Pixels per row of the simulated cameras. Frames are averaged down to this width in linear light; as
            filmed if left out.
        hold_ticks: Ticks for which each instant is held still; 100 are 5 ms.
        every: Take every N-th frame.
        instants: Number of instants; all if left out.
        linear: The frames' values are proportional to light, not sRGB.
        licence: Licence of the footage.
        seed: Seed of the sensors' fixed pattern and noise.
    """

    held_out: str
    width: int | None = None
    hold_ticks: int = 100
    every: int = 1
    instants: int | None = None
    linear: bool = False
    licence: str = "unknown"
    seed: int = 0

    def check(self, footage: Mapping[str, Footage]) -> None:
        """Raise UserError for a camera that is not there and for numbers that the footage does not allow."""
        first = next(iter(footage.values()))
        frames = len(range(0, first.frames, max(1, self.every)))
        if self.held_out not in footage or len(footage) < 3:
            expected = "one of at least three cameras"
            raise problem("--held-out", expected, f"{self.held_out}, of {', '.join(footage)}", "name one of them")
        for name, value, least, most in (
            ("--width", first.width if self.width is None else self.width, 8, first.width),
            ("--hold-ticks", self.hold_ticks, _FEWEST_TICKS, _MOST_TICKS),
            ("--every", self.every, 1, first.frames),
            ("--instants", 1 if self.instants is None else self.instants, 1, frames),
        ):
            if not least <= value <= most:
                raise problem(name, f"{least} to {most}", str(value), "correct it")

    def chosen(self, frames: int) -> list[int]:
        """Return the numbers of the frames that are shown."""
        return list(range(0, frames, self.every))[: self.instants]


def write_held_frames(
    out: Path, footage: Mapping[str, Footage], cameras: Sequence[Camera], holding: Holding
) -> dict[str, Any]:
    """Write a scene of footage to a new folder; return scene.json's `source`.

    `cameras` are those of the frames as filmed, one for each footage. Raises UserError before anything is written where
    they or the settings do not fit.
    """
    holding.check(footage)
    check_ids([out.resolve().name], "scene", "--out", "choose another name")
    first = footage[holding.held_out]
    chosen, hold = holding.chosen(first.frames), holding.hold_ticks
    small = tuple(_shrunk(c, holding.width or c.width) for c in cameras)
    ids = tuple(c.id for c in small)
    source = {"kind": "frames", **asdict(holding), "instants": len(chosen), "frame_size": [first.width, first.height]}
    with filling(out):
        for camera in small:
            _write_camera(out, camera, footage[camera.id], chosen, holding)
        description = SceneDescription(
            id=out.resolve().name,
            title=f"Footage {out.resolve().name}, each of {len(chosen)} instants held still",
            licence=holding.licence,
            cameras=small,
            train=tuple(c for c in ids if c != holding.held_out),
            test=(holding.held_out,),
            rate_hz=float(RATE_HZ),
            n_ticks=hold * len(chosen),
            radiance_gain=SENSOR.radiance_gain,
            targets=tuple(Target(holding.held_out, _middle(k, hold)) for k in range(len(chosen))),
            sensor=noisy_facts(),
            source=source,
            extras={"calibration": calibration_facts(SENSOR.radiance_gain)},
        )
        finish_scene(out, description)
    return source


def _write_camera(out: Path, camera: Camera, footage: Footage, chosen: Sequence[int], holding: Holding) -> None:
    """Write the spikes of a camera, and the truth of the held-out one. Others' colours are dropped as they are read."""
    shown: Iterable[Float32] = (_light(image, camera, holding.linear) for image in read_frames(footage, chosen))
    if camera.id == holding.held_out:
        shown = list(shown)
        _write_truth(out, camera.id, shown, holding.hold_ticks)
    _write_streams(out, camera, [image if image.ndim == 2 else gray(image) for image in shown], holding)


def _middle(instant: int, hold: int) -> int:
    return instant * hold + hold // 2


def _shrunk(camera: Camera, width: int) -> Camera:
    """Return the camera whose pixels average those of `camera`; the other side is rounded to whole pixels."""
    return camera.scaled(width, max(1, round(camera.height * width / camera.width)))


def _light(image: UInt8, camera: Camera, linear: bool) -> Float32:
    """Return the radiance [H, W] or [H, W, 3] of a frame, averaged over the camera's pixels; 255 is 1."""
    import cv2

    light = (image / 255).astype(np.float32) if linear else decode_srgb(image)
    if image.shape[:2] == (camera.height, camera.width):
        return light
    return np.asarray(cv2.resize(light, (camera.width, camera.height), interpolation=cv2.INTER_AREA), np.float32)


class _Held(Sequence[Float32]):
    """The mean radiance of every tick: each image for `hold` ticks."""

    def __init__(self, images: Sequence[Float32], hold: int) -> None:
        self._images, self._hold = images, hold

    def __len__(self) -> int:
        return len(self._images) * self._hold

    def __getitem__(self, tick: Any) -> Any:
        return self._images[tick // self._hold]


def _write_streams(out: Path, camera: Camera, images: Sequence[Float32], holding: Holding) -> None:
    """Write the sensor's true maps, its calibration recordings and its spikes."""
    entropy = [holding.seed, *f"frames {camera.id}".encode()]
    sensor = noisy_sensor(camera, holding.seed, entropy)
    write_maps(out / f"truth/{camera.id}.npz", {"gain": sensor.gain, "dark": sensor.dark})
    write_calibration(out / "calibration", camera, sensor, entropy)
    keys = _Held(images, holding.hold_ticks)
    charge = random_charge(camera.height, camera.width, entropy)
    with SpikeWriter(out / stream_name(camera.id), camera.width, camera.height) as writer:
        for packed in simulate(keys, range(len(keys)), len(keys), sensor, charge, means=True):
            writer.write(packed)


def _write_truth(out: Path, camera: str, frames: Sequence[Float32], hold: int) -> None:
    grays = np.stack([image if image.ndim == 2 else gray(image) for image in frames])
    for k, (image, mask) in enumerate(zip(frames, moving_regions(grays), strict=True)):
        target = Target(camera, _middle(k, hold))
        write_exr(out / f"images/{target.name}.exr", image, target.tick * 1e6 / RATE_HZ)
        write_mask(out / f"masks/{target.name}.png", mask)


def moving_regions(images: Float32) -> Mask:
    """Return what moves in images [N, H, W] of a camera that stands still, [N, H, W].

    A pixel that differs from its median over the instants by more than 15 % of it, and by more than 0.03 of white,
    which is above the noise of 8-bit video; without specks under 2 px, grown by 2 px. Footage tells no better.
    """
    median = np.median(images, axis=0)
    changed = np.abs(images - median) > np.maximum(_CHANGE * median, _LEAST)
    opened = binary_opening(changed, np.ones((1, 2, 2)))
    return np.asarray(binary_dilation(opened, np.ones((1, 3, 3)), iterations=_GROW_PX))
