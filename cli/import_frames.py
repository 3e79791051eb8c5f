"""`import-frames`: footage of an array of ordinary cameras as a scene of simulated spike cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.table import Table
from tyro.conf import OmitArgPrefixes, Positional

from spike4dgs.benchmark.exchange.camera_files import read_camera_files
from spike4dgs.benchmark.exchange.marked_points import read_marked_points
from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.generators.held_frames.footage import find_footage
from spike4dgs.generators.held_frames.scene import Holding, write_held_frames
from spike4dgs.method.self_calibration.reprojection import Reprojection, reprojection


def import_frames(
    path: Positional[Path],
    *,
    cameras: Path,
    holding: OmitArgPrefixes[Holding],
    out: Path,
    points: Path | None = None,
) -> int:
    """Put a simulated spike camera in the place of each real camera, and show it what that camera filmed.

    Each instant is held still for some ticks. Optics, textures, light and calibration are real; the spikes, their rate
    and the steps from instant to instant are not. One camera is held out, and its frames are the ground truth.

    Args:
        path: Folder with a subfolder of images, or a video, for each camera. All must have the same size and number of
            frames, taken at the same instants.
        cameras: COLMAP model folder, OpenCV file or folder, or Kalibr file, as in import-dat, for the frames as filmed.
        out: New folder of the scene.
        points: CSV of points marked in the frames: camera,frame,point,x,y in px, with the first pixel's centre at 0,0.
            Their reprojection errors are printed, and show how well the cameras fit the footage.
    """
    footage = find_footage(path)
    first = next(iter(footage.values()))
    found = read_camera_files(cameras, sorted(footage), (first.width, first.height))
    if points is not None:
        make_console().print(_table(reprojection(found, read_marked_points(points))))
    write_held_frames(out, footage, found, holding)
    scene = open_scene(out)
    size = f"{scene.meta['width']}x{scene.meta['height']}"
    ms = scene.n_ticks * 1e3 / scene.rate_hz
    instants = f"{len(scene.targets)} instants, {scene.n_ticks} ticks, {ms:g} ms"
    print(f"{out}: {len(found)} cameras of {size} pixels, {holding.held_out} held out; {instants}")
    return 0


def _table(found: dict[str, Reprojection]) -> Table:
    table = Table(title="Reprojection errors, px of the frames", box=None)
    for name in ("camera", "marks", "median", "rms", "left out: marks", "median", "rms"):
        table.add_column(name, justify="left" if name == "camera" else "right")
    for camera, errors in found.items():
        table.add_row(camera, *_cells(errors.together), *_cells(errors.left_out))
    return table


def _cells(errors: np.ndarray) -> tuple[str, str, str]:
    if not len(errors):
        return "0", "", ""
    return str(len(errors)), f"{np.median(errors):.2f}", f"{np.sqrt(np.mean(errors**2)):.2f}"
