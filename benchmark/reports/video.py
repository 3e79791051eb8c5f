"""Video files. OpenCV's own ffmpeg has no encoder for H.264; its VP9 plays in browsers and players."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path

# By suffix: codecs in order of preference. MPEG-4 part 2 is for builds of OpenCV without libvpx: players show it,
# browsers do not. Motion JPEG opens everywhere and is several times larger.
CODECS = {".mp4": ("vp09", "mp4v"), ".avi": ("MJPG",)}
# OpenCV rounds a colour's chroma down; with this much more red and blue (RGB) a gray of a colour frame stays gray.
NEUTRAL = np.array([1, 0, 2], np.uint8)
Write = Callable[[UInt8], None]


def check_video(path: Path) -> None:
    """Raise UserError for a suffix that is not in `CODECS`."""
    if path.suffix not in CODECS:
        raise problem(path, f"a video's name, {' or '.join(CODECS)}", repr(path.suffix), "choose one of them")


@contextmanager
def video_writer(path: Path, size: tuple[int, int], fps: float, *, gray: bool) -> Iterator[Write]:
    """Yield a function that writes a frame; the file appears when all are written.

    Frames are [H, W] in a `gray` video, which keeps their values, and else RGB [H, W, 3]. `size` is (width, height),
    both even. Raises UserError for another suffix, where no codec works, and for frames of another size.
    """
    import cv2

    check_video(path)
    with atomic_path(path) as part:
        part.touch()  # OpenCV does not say why it cannot write
        for codec in CODECS[path.suffix]:
            fourcc = cv2.VideoWriter.fourcc(*codec)
            writer = cv2.VideoWriter(str(part), cv2.CAP_FFMPEG, fourcc, fps, size, isColor=not gray)
            if writer.isOpened():
                break
        else:
            fix = "install opencv-contrib-python-headless, or pass --frames"
            raise problem(path, "an encoder for video in OpenCV", "none", fix)

        count = 0

        def write(frame: UInt8) -> None:
            nonlocal count
            count += 1
            if frame.shape[:2] != size[::-1]:
                found = f"{frame.shape[1]}x{frame.shape[0]}"
                raise problem(path, f"frames of {size[0]}x{size[1]}", found, "render all at one size")
            writer.write(frame if gray else np.ascontiguousarray(_neutral(frame)[:, :, ::-1]))

        try:
            yield write
        finally:
            writer.release()
        _check_whole(part, path, count)


def _neutral(frame: UInt8) -> UInt8:
    return np.minimum(frame, 255 - NEUTRAL) + NEUTRAL


def _check_whole(part: Path, path: Path, frames: int) -> None:
    """Raise UserError unless the last frame of a video can be read: OpenCV does not say that a disk is full."""
    import cv2

    video = cv2.VideoCapture(str(part), cv2.CAP_FFMPEG)
    try:
        video.set(cv2.CAP_PROP_POS_FRAMES, max(frames - 1, 0))
        if frames and not video.read()[0]:
            found = f"a broken one after {frames} frames"
            raise problem(path, "a video with its last frame", found, "free some disk space, or choose another folder")
    finally:
        video.release()
