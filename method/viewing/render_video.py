"""A video of a fitted model in slow motion, along a path of cameras."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import check_new
from spike4dgs.benchmark.reports.video import Write, check_video, video_writer
from spike4dgs.benchmark.scene.images import encode_srgb, write_png
from spike4dgs.benchmark.untrusted import MAX_SIDE
from spike4dgs.method.models.saved_model import SavedModel
from spike4dgs.method.viewing import camera_paths
from spike4dgs.method.viewing.camera_paths import resized

_MOST_FRAMES = 1_000_000


@dataclass(frozen=True)
class Playback:
    """How a clip is played.

    Args:
        slow_motion: How many times slower than the world; 1000 turns 20 ms into 20 s.
        fps: Frames per second of the video.
        scale: Width and height, as a multiple of the training views'.
    """

    slow_motion: float = 1000.0
    fps: float = 30.0
    scale: float = 2.0

    def check(self) -> None:
        """Raise UserError for numbers that are not positive."""
        for name, value in (("--slow-motion", self.slow_motion), ("--fps", self.fps), ("--scale", self.scale)):
            if not 0 < value < math.inf:
                raise problem(name, "a positive number", f"{value:g}", "correct it")


PLAYBACK = Playback()


def render_video(
    saved: SavedModel, path: camera_paths.Path, playback: Playback, out: Path | None, frames: Path | None
) -> tuple[int, tuple[int, int]]:
    """Render a model along a path to the video `out` and the new folder `frames`; return the count and the size.

    Raises UserError before anything is rendered for a video that is too long or too large.
    """
    if out is not None:
        check_video(out)
    if frames is not None:
        check_new(frames)
    duration_us, fps, slow_motion = saved.provenance.duration_us, playback.fps, playback.slow_motion
    if not duration_us * 1e-6 * fps * slow_motion <= _MOST_FRAMES:
        found = f"{duration_us * 1e-6:g} s at {fps:g} frames/s, {slow_motion:g} times slower"
        raise problem(
            "--slow-motion and --fps", f"a video of at most {_MOST_FRAMES} frames", found, "lower one of them"
        )
    times, start = frame_times(duration_us, slow_motion, fps), path(0.0)
    side = playback.scale * max(start.width, start.height)
    if not 1 <= side <= MAX_SIDE:
        raise problem("--scale", f"an image of 1 to {MAX_SIDE} pixels each way", f"{side:g}", "correct it")
    first = resized(start, playback.scale)
    size = first.width, first.height
    with ExitStack() as stack:
        writers: list[Write] = []
        if out is not None:
            writers.append(stack.enter_context(video_writer(out, size, fps, gray=True)))
        if frames is not None:
            writers.append(png_writer(frames, len(times)))
        for image in _shown(render_frames(saved, path, times, playback.scale), len(times), saved.title):
            for write in writers:
                write(image)
    return len(times), size


def frame_times(duration_us: float, slow_motion: float, fps: float) -> list[float]:
    """Return the times in the clip, in us, of the frames of a video that plays it `slow_motion` times slower."""
    step_us = 1e6 / (fps * slow_motion)
    count = max(1, math.ceil(duration_us / step_us - 1e-9))
    return [i * step_us for i in range(count)]


def render_frames(saved: SavedModel, path: camera_paths.Path, times: list[float], scale: float) -> Iterator[UInt8]:
    """Yield the frames [H, W]: the model along the path, at each of the times, sRGB-encoded."""
    for i, t_us in enumerate(times):
        camera = resized(path(i / max(len(times) - 1, 1)), scale)
        yield encode_srgb(saved.model.render(camera, t_us))


def png_writer(folder: Path, count: int) -> Write:
    """Return a function that writes `count` frames as FOLDER/00000.png and so on, with names of one length."""
    numbers, digits = iter(range(count)), max(5, len(str(count - 1)))
    return lambda image: write_png(folder / f"{next(numbers):0{digits}d}.png", image)


def _shown(frames: Iterator[UInt8], total: int, title: str) -> Iterator[UInt8]:
    """Yield the same frames, with a progress bar on a terminal."""
    from rich.console import Console
    from rich.progress import track

    console = Console()
    yield from track(frames, title, total, console=console, transient=True, disable=not console.is_terminal)
