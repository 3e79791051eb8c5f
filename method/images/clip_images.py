"""The images of a whole clip, on disk: PNG to look at, EXR to compute with, and a slow-motion video.

    OUT/CAMERA.mp4
    OUT/CAMERA/000120.png, 000120.exr    # named by the tick
    OUT/CAMERA/images.json               # what they were made of, and whether all are there

A killed run leaves whole files and goes on with them. Images of anything else are never overwritten.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import read_json, write_json
from spike4dgs.benchmark.reports.video import video_writer
from spike4dgs.benchmark.scene.images import encode_srgb, read_png, write_exr, write_png
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.repair import fill_gaps
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.method.images.base import ImageMaker

_SCHEMA = "spike4dgs-images/1"
_NAME = "images.json"
_LINE_S = 10.0  # between two lines of progress, where there is no terminal
_BLOCK = 4096  # ticks hashed at a time


@dataclass(frozen=True, eq=False)
class ClipImages:
    """The images of one camera to make: every `every` ticks, each a frame of the video.

    gain: spikes per tick of white, by which values are divided. fps: of the video, per second.
    """

    camera: str
    stream: SpikeStream
    maker: ImageMaker
    every: int
    gain: float
    fps: float

    @property
    def ticks(self) -> list[int]:
        """Ticks of the images; those that a recording lacks are left out."""
        seen = present(self.stream.gaps, self.stream.n_ticks)
        return [tick for tick in range(0, self.stream.n_ticks, self.every) if seen[tick]]

    @property
    def slow_motion(self) -> float:
        """How many times slower than the world the video is."""
        return self.stream.rate_hz / (self.every * self.fps)

    def facts(self) -> dict[str, Any]:
        """Return all that decides the images, for `images.json`."""
        s, learned = self.stream, self.maker.learned()
        digest = hashlib.sha256()
        for start in range(0, s.n_ticks, _BLOCK):
            digest.update(np.ascontiguousarray(s.packed[start : start + _BLOCK]).data)
        s.release()
        return {
            "schema": _SCHEMA,
            "camera": self.camera,
            "maker": self.maker.name,
            "settings": repr(self.maker.settings),
            "weights_sha256": learned.sha256 if learned else None,
            "every": self.every,
            "gain": self.gain,
            "fps": self.fps,
            "stream_sha256": digest.hexdigest(),
            "width": s.width,
            "height": s.height,
            "rate_hz": s.rate_hz,
            "rows_bottom_up": s.rows_bottom_up,
            **({"filled": [[gap.first_tick, gap.ticks] for gap in s.gaps]} if s.gaps else {}),
            **({"dead_ticks": s.dead_ticks} if s.dead_ticks else {}),
        }


def clip_video(out: Path, camera: str) -> Path:
    """Return where a camera's video lies."""
    return out / f"{camera}.mp4"


def write_clip_images(out: Path, wanted: ClipImages) -> bool:
    """Write a camera's images and video; return False where all of them are there already.

    Raises UserError before anything is written where the folder holds images of something else, or foreign files.
    """
    folder, video, facts = out / wanted.camera, clip_video(out, wanted.camera), wanted.facts()
    if _begun(folder, video, facts):
        return False
    if not (ticks := wanted.ticks):
        raise problem(
            wanted.stream.source, "a tick with data among those of the images", "none", "choose another --every"
        )
    s = fill_gaps(wanted.stream)  # as a fit has it: lost ticks are no dark
    wanted = replace(wanted, stream=s)
    wanted.maker(s, ticks[:1], wanted.gain)  # a maker that lacks something says so before anything is written
    write_json(folder / _NAME, {**facts, "complete": False})
    with video_writer(video, (s.width + s.width % 2, s.height + s.height % 2), wanted.fps, gray=True) as write:
        title = f"{wanted.camera}: {wanted.maker.name}"
        for tick in _shown(ticks, title):
            image = _image(folder, wanted, tick)
            write(np.pad(image, ((0, s.height % 2), (0, s.width % 2)), mode="edge"))
    write_json(folder / _NAME, {**facts, "complete": True})
    return True


def _begun(folder: Path, video: Path, facts: dict[str, Any]) -> bool:
    """Return whether all is done. Raises UserError unless the folder is new or a run with the same `facts` began it."""
    if not folder.exists() and not video.exists():
        return False
    other = "choose another --out, or remove it"
    if not (folder / _NAME).is_file():
        if folder.is_dir() and not any(folder.iterdir()) and not video.exists():
            return False
        raise problem(folder if folder.exists() else video, "nothing, or images of this command", "other files", other)
    found = read_json(folder / _NAME, "a description of images")
    complete = found.pop("complete", False)
    if differing := [key for key in {**facts, **found} if found.get(key) != facts.get(key)]:
        key = differing[0]
        raise problem(folder, f"images with {key} {facts.get(key)}", f"{found.get(key)}", other)
    return bool(complete) and video.is_file()


def _image(folder: Path, wanted: ClipImages, tick: int) -> UInt8:
    """Return one image as shown [H, W], made and written unless it is there."""
    png, exr, stream = folder / f"{tick:06d}.png", folder / f"{tick:06d}.exr", wanted.stream
    if png.is_file() and exr.is_file():
        try:
            return read_png(png, (stream.height, stream.width))
        except UserError:  # damaged: made again
            pass
    radiance = wanted.maker(stream, [tick], wanted.gain)[0]
    shown = encode_srgb(radiance)
    write_exr(exr, radiance, tick * 1e6 / stream.rate_hz)
    write_png(png, shown)
    return shown


def _shown(ticks: Sequence[int], title: str) -> Iterator[int]:
    """Yield the ticks, with a bar and the time left on a terminal, and lines with it elsewhere."""
    from rich.console import Console
    from rich.progress import track

    console = Console()
    if console.is_terminal:
        yield from track(ticks, title, console=console, transient=True)
        return
    start = last = time.monotonic()
    for done, tick in enumerate(ticks):
        now = time.monotonic()
        if done and now - last >= _LINE_S:
            last, left = now, (now - start) / done * (len(ticks) - done)
            print(f"{title}, {done} of {len(ticks)} images, about {left:.0f} s left", flush=True)
        yield tick
