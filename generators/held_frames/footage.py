"""Footage of an array of ordinary cameras: for each camera a folder of images, or a video."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.scene.images import is_deep
from spike4dgs.benchmark.untrusted import MAX_SIDE, check_ids

IMAGES = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff")
VIDEOS = (".avi", ".mkv", ".mov", ".mp4")
_FORMATS = ("BMP", "JPEG", "PNG", "TIFF")
_MODES = {"1": "L", "L": "L", "P": "RGB", "RGB": "RGB", "RGBA": "RGB"}  # of 8 bits a channel -> as it is read
_MOST_PIXELS = 1 << 26  # of a frame
_MOST_FRAMES = 1_000_000  # of a video, whose header may state any number
_ORIENTATION, _UPRIGHT = 0x0112, (0, 1)  # EXIF's tag; 0 says nothing
_AGAIN = "restore or export it"


@dataclass(frozen=True)
class Footage:
    """The frames of a camera: images in order, or one video."""

    files: tuple[Path, ...]
    frames: int
    width: int
    height: int

    @property
    def is_video(self) -> bool:
        """True where the frames are in one file."""
        return self.files[0].suffix.lower() in VIDEOS


def find_footage(folder: Path) -> dict[str, Footage]:
    """Return the footage of each camera by name: that of a subfolder of images, or of a video without its suffix.

    Numbers in images' names are compared as numbers. Raises UserError where there is none, where cameras differ in size
    or number of frames, and for files that cannot be read.
    """
    if not folder.is_dir():
        raise problem(folder, "a folder with a subfolder of images, or a video, for each camera", "none", "check it")
    found: dict[str, Footage] = {}
    for path in sorted(folder.iterdir()):
        name = path.name if path.is_dir() else path.stem
        footage = _images(path) if path.is_dir() else _video(path) if path.suffix.lower() in VIDEOS else None
        if footage is None:
            continue
        if name in found:
            raise problem(folder, "one folder or video for each camera", f"{name} twice", "remove one")
        found[name] = footage
    if not found:
        raise problem(folder, "a subfolder of images, or a video, for each camera", "neither", "check the path")
    check_ids(found, "camera", folder, "rename the folder or video, after which the camera is called")
    for what, values in (
        ("one size", {(f.width, f.height) for f in found.values()}),
        ("the same number of frames, taken at the same instants", {f.frames for f in found.values()}),
    ):
        if len(values) > 1:
            raise problem(folder, f"{what} for all cameras", " and ".join(map(str, sorted(values))), "cut them alike")
    return found


def read_frames(footage: Footage, chosen: Sequence[int]) -> Iterator[UInt8]:
    """Yield the `chosen` frames, ascending: gray [H, W] or RGB [H, W, 3], 8 bit.

    Raises UserError where one cannot be read or has another size than the first.
    """
    frames = _video_frames(footage, chosen) if footage.is_video else (_read(footage.files[k]) for k in chosen)
    for k, image in zip(chosen, frames, strict=True):
        if image.shape[:2] != (footage.height, footage.width):
            where = footage.files[0 if footage.is_video else k]
            found = f"{image.shape[1]}x{image.shape[0]}"
            raise problem(where, f"frames of {footage.width}x{footage.height} pixels", found, _AGAIN)
        yield image


def _images(folder: Path) -> Footage | None:
    files = sorted((p for p in folder.iterdir() if p.suffix.lower() in IMAGES), key=_natural)
    if not files:
        return None
    height, width = _read(files[0]).shape[:2]
    return Footage(tuple(files), len(files), width, height)


def _natural(path: Path) -> tuple[list[str | int], str]:
    parts: list[str | int] = [int(part) if i % 2 else part for i, part in enumerate(re.split(r"(\d+)", path.name))]
    return parts, path.name  # 01.png before 1.png


def _read(path: Path) -> UInt8:
    from PIL import Image

    try:
        with Image.open(path, formats=_FORMATS) as image:
            if max(image.size) > MAX_SIDE or image.width * image.height > _MOST_PIXELS:
                found = f"{image.width}x{image.height}"
                raise problem(path, f"an image of at most {_MOST_PIXELS} pixels", found, "shrink it")
            deep = is_deep(image)
            if deep or image.mode not in _MODES:
                found = f"mode {image.mode}" + (", of more bits" if deep else "")
                raise problem(path, "an image of 8 bits a channel", found, "export it with 8 bits")
            if (count := getattr(image, "n_frames", 1)) > 1 and image.format != "MPO":  # JPEG with previews behind it
                raise problem(path, "a file for each frame", f"{count} frames in one", "export them one by one")
            if (turned := image.getexif().get(_ORIENTATION, 1)) not in _UPRIGHT:
                fix = "export it upright, as its camera was calibrated"
                raise problem(path, "an image that is stored upright", f"EXIF orientation {turned}", fix)
            return np.asarray(image.convert(_MODES[image.mode]))
    except UserError:
        raise
    except Exception as e:  # image libraries raise anything
        raise problem(path, "an image", f"damaged data ({str(e)[:200]})", _AGAIN) from None


def _video(path: Path) -> Footage:
    import cv2

    video = cv2.VideoCapture(str(path))
    try:
        keys = (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
        n, width, height = (int(video.get(key)) for key in keys) if video.isOpened() else (0, 0, 0)
    finally:
        video.release()
    if not (
        0 < n <= _MOST_FRAMES and 0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= _MOST_PIXELS
    ):
        raise problem(path, "a video", f"{n} frames of {width}x{height}", _AGAIN)
    return Footage((path,), n, width, height)


def _video_frames(footage: Footage, chosen: Sequence[int]) -> Iterator[UInt8]:
    import cv2

    video, wanted = cv2.VideoCapture(str(footage.files[0])), set(chosen)
    try:
        for k in range(max(wanted, default=-1) + 1):
            good, frame = video.read() if k in wanted else (video.grab(), None)
            if not good:
                raise problem(footage.files[0], f"{footage.frames} frames", f"{k}", _AGAIN)
            if frame is not None:
                yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)  # type: ignore[misc]  # 8 bit as the frame
    finally:
        video.release()
