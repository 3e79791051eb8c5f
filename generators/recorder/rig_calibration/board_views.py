"""Images of a board in recorded clips, and the positions of its corners.

An image is the count of a window of ticks that all cameras share (TFP). A board that moves during the window is
blurred along its path, in every camera around the same instant, and its corners are found in the middle of the blur.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.spikes.folder import NAME as STREAM_FOLDER
from spike4dgs.benchmark.spikes.folder import open_stream_folder
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.generators.recorder.rig_calibration.board import Board, find_corners
from spike4dgs.generators.recorder.rig_calibration.bundle_adjustment import Detections


@dataclass(frozen=True, eq=False)
class BoardRecording:
    """A clip of the board: the streams by camera, and the cameras as far as the clip has them."""

    name: str
    streams: Mapping[str, SpikeStream]
    cameras: Mapping[str, Camera]


@dataclass(frozen=True)
class View:
    """A window that all cameras share: ticks [start, stop) of a recording."""

    recording: int
    start: int
    stop: int


@dataclass(frozen=True, eq=False)
class BoardViews:
    """The views with the board in some camera, and the positions of its corners; detections count these views."""

    views: tuple[View, ...]
    detections: Detections


def open_recording(path: Path, allow_gaps: bool) -> BoardRecording:
    """Return a recorded clip, with or without poses. Raises UserError as `open_scene` does."""
    if (path / STREAM_FOLDER).is_file():
        return BoardRecording(path.name, open_stream_folder(path, allow_gaps), {})
    scene = open_scene(path, allow_gaps)
    return BoardRecording(scene.id, {c: scene.stream(c) for c in scene.cameras}, scene.cameras)


def choose_views(recordings: Sequence[BoardRecording], n: int, window_ticks: int) -> list[View]:
    """Return about `n` views, even over the recordings and within each. Raises UserError for too short a clip."""
    views = []
    for i, recording in enumerate(recordings):
        ticks = min(s.n_ticks for s in recording.streams.values())
        if not 1 <= window_ticks <= ticks:
            found = f"--window-ticks {window_ticks}"
            raise problem(recording.name, f"a window of 1 to {ticks} ticks", found, "choose a shorter window")
        starts = np.linspace(0, ticks - window_ticks, max(round(n / len(recordings)), 1)).round().astype(int)
        views += [View(i, int(start), int(start) + window_ticks) for start in np.unique(starts)]
    return views


def make_image(recording: BoardRecording, camera: str, view: View) -> Float32 | None:
    """Return spikes per tick [H, W] of a camera in a view; None where the recording lacks some of its ticks."""
    stream = recording.streams[camera]
    if any(gap.first_tick < view.stop and view.start < gap.stop_tick for gap in stream.gaps):
        return None
    return stream.counts(view.start, view.stop).astype(np.float32) / np.float32(view.stop - view.start)


def common_cameras(recordings: Sequence[BoardRecording]) -> tuple[tuple[str, ...], tuple[int, int]]:
    """Return the recordings' cameras and their width and height. Raises UserError where these are not all the same."""
    kinds = {tuple(sorted((c, s.width, s.height) for c, s in r.streams.items())) for r in recordings}
    sizes = {(width, height) for kind in kinds for _, width, height in kind}
    if len(kinds) != 1 or len(sizes) != 1:
        found = f"{len(kinds)} different arrays" if len(kinds) > 1 else f"sizes {sizes}"
        raise problem("clips", "the same cameras of one size in every clip", found, "calibrate each array by itself")
    return tuple(c for c, _, _ in next(iter(kinds))), sizes.pop()


def find_all(
    recordings: Sequence[BoardRecording], names: Sequence[str], views: Sequence[View], board: Board
) -> BoardViews:
    """Return the board in every image that shows all of it. Raises UserError where there is none."""

    def find(c: int, v: int) -> Float64 | None:
        image = make_image(recordings[views[v].recording], names[c], views[v])
        return None if image is None else find_corners(image, board)

    pairs = [(c, v) for v in range(len(views)) for c in range(len(names))]
    with ThreadPoolExecutor() as pool:
        found = list(pool.map(lambda pair: find(*pair), pairs))
    seen = [(c, v, uv) for (c, v), uv in zip(pairs, found, strict=True) if uv is not None]
    if not seen:
        fix = "check --columns and --rows (inner corners), the light, and that images show the whole board"
        raise problem("board", f"{board.columns} x {board.rows} corners in some image", "none", fix)
    kept, view = np.unique([s[1] for s in seen], return_inverse=True)
    camera, uv = np.array([s[0] for s in seen]), np.stack([s[2] for s in seen])
    return BoardViews(tuple(views[v] for v in kept), Detections(camera, view, uv, np.ones(uv.shape[:2], bool)))
