"""`render`: a video of a fitted model in slow motion, along a path of cameras."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import check_new
from spike4dgs.benchmark.reports.video import Write, check_video, video_writer
from spike4dgs.benchmark.scene.images import UInt8, encode_srgb, write_png
from spike4dgs.benchmark.untrusted import MAX_SIDE
from spike4dgs.method.models.saved_model import SavedModel, load_model
from spike4dgs.method.viewing import camera_paths
from spike4dgs.method.viewing.camera_paths import PathName, make_path, resized

_MOST_FRAMES = 1_000_000


def render(
    model: Positional[Path],
    *,
    path: PathName = "orbit",
    camera: str | None = None,
    slow_motion: float = 1000.0,
    fps: float = 30.0,
    scale: float = 2.0,
    out: Path | None = None,
    frames: Path | None = None,
    device: str = "cpu",
) -> int:
    """Render a fitted model along a path of cameras, in slow motion, to a video or a folder of images.

    Args:
        model: A model that run-benchmark has saved, OUT/models/METHOD/SCENE.safetensors, or fit, OUT/model.safetensors.
        path: orbit: an ellipse as large as the camera array, around its middle; rig: from training camera to training
            camera; still: one of them.
        camera: The training camera of `still`; the middle one if left out.
        slow_motion: Times slower than the world; 1000 makes 20 s of 20 ms.
        fps: Frames per second of the video.
        scale: Size, as a multiple of the training views' each way.
        out: Video, .mp4 (VP9) or .avi (Motion JPEG); SCENE-PATH.mp4 if left out, or none where --frames is given.
        frames: New folder for the frames as PNG.
        device: cpu or cuda.
    """
    for name, value in (("--slow-motion", slow_motion), ("--fps", fps), ("--scale", scale)):
        if not 0 < value < math.inf:
            raise problem(name, "a positive number", f"{value:g}", "correct it")
    saved = load_model(model, device)
    if out is None and frames is None:
        out = Path(f"{saved.provenance.scene}-{path}.mp4")
    if out is not None:
        check_video(out)
    if frames is not None:
        check_new(frames)
    if not saved.provenance.duration_us * 1e-6 * fps * slow_motion <= _MOST_FRAMES:
        found = f"{saved.provenance.duration_us * 1e-6:g} s at {fps:g} frames/s, {slow_motion:g} times slower"
        raise problem(
            "--slow-motion and --fps", f"a video of at most {_MOST_FRAMES} frames", found, "lower one of them"
        )
    times = frame_times(saved.provenance.duration_us, slow_motion, fps)
    views = make_path(path, saved.provenance.cameras, camera)
    size = scale * max(views(0.0).width, views(0.0).height)
    if not 1 <= size <= MAX_SIDE:
        raise problem("--scale", f"an image of 1 to {MAX_SIDE} pixels each way", f"{size:g}", "correct it")
    first = resized(views(0.0), scale)
    with ExitStack() as stack:
        writers: list[Write] = []
        if out is not None:
            writers.append(stack.enter_context(video_writer(out, (first.width, first.height), fps)))
        if frames is not None:
            writers.append(png_writer(frames))
        for image in _shown(render_frames(saved, views, times, scale), len(times), saved.title):
            for write in writers:
                write(image)
    seconds = len(times) / fps
    for target in filter(None, (out, frames)):
        print(f"{target}: {len(times)} frames of {first.width}x{first.height}, {seconds:.1f} s at {fps:g} frames/s")
    return 0


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


def png_writer(folder: Path) -> Write:
    """Return a function that writes frames as FOLDER/00000.png and so on."""
    count = iter(range(10**9))
    return lambda image: write_png(folder / f"{next(count):05d}.png", image)


def _shown(frames: Iterator[UInt8], total: int, title: str) -> Iterator[UInt8]:
    """Yield the same frames, with a progress bar on a terminal."""
    from rich.console import Console
    from rich.progress import track

    console = Console()
    yield from track(frames, title, total, console=console, transient=True, disable=not console.is_terminal)
