"""Content of the viewer: the model's image, the spike rate, and the difference of the two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float32, UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.reports.error_map import error_image
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.scene.scene import TrainingScene, open_scene
from spike4dgs.benchmark.spikes.sensor_model import gathered
from spike4dgs.method.models.saved_model import SavedModel

Mode = Literal["rendered", "spike rate", "error"]
MODES: tuple[Mode, ...] = get_args(Mode)
WINDOW_TICKS = 40  # of the spike rate: 2 ms at 20 kHz, in which a bright pixel fires 24 times
BORDER = 24  # gray around an image that is not as wide or high as the window


@dataclass(frozen=True, eq=False)
class Content:
    """A model, and the spikes that it was fitted to if the scene is given."""

    saved: SavedModel
    scene: TrainingScene | None = None

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The training cameras, as calibrated."""
        return self.saved.provenance.cameras

    @property
    def modes(self) -> tuple[Mode, ...]:
        """The kinds of image that the viewer offers: without the scene there are no spikes."""
        return MODES if self.scene else MODES[:1]

    def image(self, mode: Mode, camera: Camera, t_us: float) -> UInt8:
        """Return RGB [H, W, 3] at `t_us`. Modes other than `rendered` need a training camera of the scene."""
        if mode == "rendered":
            return _gray(self.saved.model.render(camera, t_us))
        recorded = self.spike_rate(camera.id, t_us)
        if mode == "spike rate":
            return _gray(recorded)
        return error_image(self.saved.model.render(camera, t_us), recorded)

    def spike_rate(self, camera: str, t_us: float) -> Float32:
        """Return the light by the spikes in the window around `t_us`: their rate over the radiance gain, [H, W].

        1.0 = white; ticks in which the sensor gathers no light are counted out.

        Raises UserError if there is no scene, or if it has no such training camera.
        """
        scene = self.scene
        names = [c.id for c in scene.cameras] if scene else []
        if scene is None or camera not in names:
            known = ", ".join(names) or "none: no scene is given"
            raise problem("camera", f"a training camera of the scene ({known})", repr(camera), "choose one of them")
        start, stop = window(scene.tick(t_us), scene.n_ticks)
        stream, ticks = scene.streams[names.index(camera)], stop - start
        charge = gathered(stream.counts(start, stop), stream.dead_ticks / ticks)  # of the window
        return (charge / (ticks * scene.radiance_gain)).astype(np.float32)


def window(tick: int, n_ticks: int) -> tuple[int, int]:
    """Return the ticks [start, stop) of the window around `tick`, shifted into the clip at its ends."""
    length = min(WINDOW_TICKS, n_ticks)
    start = min(max(tick - length // 2, 0), n_ticks - length)
    return start, start + length


def open_content(saved: SavedModel, scene: Path | None, allow_gaps: bool = False) -> Content:
    """Return the content of a model and its scene's training views. Raises UserError for another scene's folder.

    Another revision of the scene is said only: a model may have been fitted to the training part alone.
    """
    if scene is None:
        return Content(saved)
    about = saved.provenance
    opened = open_scene(scene, allow_gaps)
    if opened.id != about.scene:
        raise problem(scene, f"{about.scene}, which the model was fitted to", opened.id, "give that scene's folder")
    opened = open_scene(scene, allow_gaps, about.split)
    missing = {c.id for c in about.cameras} - set(opened.train)
    if missing or opened.n_ticks != about.n_ticks or opened.rate_hz != about.rate_hz:
        found = f"{opened.n_ticks} ticks at {opened.rate_hz:g} Hz, cameras {', '.join(opened.train)}"
        expected = f"{about.n_ticks} ticks at {about.rate_hz:g} Hz, cameras {', '.join(c.id for c in about.cameras)}"
        raise problem(scene, expected, found, "give the scene that the model was fitted to")
    training = opened.training
    if training.revision != about.scene_revision:
        found, fitted = training.revision[:16], about.scene_revision[:16]
        print(f"{scene}: revision {found}; the model was fitted to revision {fitted}, whose spikes may be others")
    return Content(saved, training)


def _gray(image: Float32) -> UInt8:
    return np.repeat(encode_srgb(image)[:, :, None], 3, 2)


def padded(image: UInt8, aspect: float) -> UInt8:
    """Return the image in the middle of a gray one whose width is `aspect` times its height."""
    height, width = image.shape[:2]
    full = (max(height, round(width / aspect)), max(width, round(height * aspect)))
    out = np.full((*full, 3), BORDER, np.uint8)
    top, left = (full[0] - height) // 2, (full[1] - width) // 2
    out[top : top + height, left : left + width] = image
    return out


def free_camera(
    rotation: NDArray[np.float64], position: NDArray[np.float64], fov: float, aspect: float, pixels: float
) -> Camera:
    """Return a camera of about `pixels` pixels in all.

    `rotation` [3, 3] is camera-to-world (OpenCV axes), `position` [3] in metres, `fov` the vertical angle in radians.
    """
    height = max(16, round((pixels / aspect) ** 0.5))
    width = max(16, round(height * aspect))
    focal = 0.5 * height / np.tan(0.5 * fov)
    return Camera("free", width, height, focal, focal, width / 2, height / 2, rotation.T, -rotation.T @ position)


def matching(cameras: Sequence[Camera], name: str, aspect: float) -> tuple[Camera, float]:
    """Return a camera by name, and the vertical angle at which a window of that aspect holds its whole image."""
    camera = next(c for c in cameras if c.id == name)
    height = max(camera.height, camera.width / aspect)
    return camera, float(2 * np.arctan(0.5 * height / camera.fy))
