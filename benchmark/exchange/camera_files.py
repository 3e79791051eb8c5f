"""Cameras of other programs' files, for streams: COLMAP, OpenCV or Kalibr, told apart by what is there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.exchange.colmap import read_colmap_model
from spike4dgs.benchmark.exchange.found_camera import FoundCamera
from spike4dgs.benchmark.exchange.kalibr import is_camchain, read_camchain
from spike4dgs.benchmark.exchange.opencv import SUFFIXES, read_opencv_files
from spike4dgs.benchmark.scene.cameras import Camera, check_lens
from spike4dgs.benchmark.scene.lens import NAMES

NEGLIGIBLE_PX = 0.05  # lens distortion below this is left out


def read_camera_files(path: Path, names: Sequence[str], size: tuple[int, int]) -> tuple[Camera, ...]:
    """Return a camera for each stream, by name; others are left out, which is said.

    Raises UserError where the file is missing, foreign or damaged, where a stream has no camera, and where a lens that
    is not OpenCV's k1, k2, p1, p2, k3 distorts by NEGLIGIBLE_PX or more.
    """
    found = _read(path, names, size)
    if missing := [name for name in names if name not in found]:
        known = ", ".join(sorted(found)) or "none"
        fix = "name the streams' files as the cameras are called"
        raise problem(path, "a camera for each stream", f"none for {', '.join(missing)} (it has {known})", fix)
    cameras = tuple(_with_lens(path, found[name]) for name in names)
    if others := sorted(set(found) - set(names)):
        print(f"{path}: no stream of {', '.join(others)}: left out")
    return cameras


def _read(path: Path, names: Sequence[str], size: tuple[int, int]) -> dict[str, FoundCamera]:
    if path.is_dir():
        files = sorted(p for p in path.iterdir() if p.suffix in SUFFIXES)
        return read_opencv_files(files, size) if files else read_colmap_model(path, names, size)
    if not path.is_file():
        raise problem(path, "a COLMAP model, or OpenCV's or Kalibr's cameras", "no such file", "check the path")
    if path.suffix not in SUFFIXES:
        expected = f"a COLMAP model's folder, or a file of OpenCV or Kalibr ({', '.join(SUFFIXES)})"
        raise problem(path, expected, path.suffix or "no suffix", "give such a file")
    if path.suffix != ".xml" and is_camchain(path):
        return read_camchain(path, size)
    return read_opencv_files([path], size)


def _with_lens(path: Path, found: FoundCamera) -> Camera:
    """Return the camera of a scene, with its lens where it distorts noticeably."""
    px, camera = found.distortion_px, found.camera
    if px < NEGLIGIBLE_PX:
        if px:
            print(f"{camera.id}: lens distortion of at most {px:.3f} px is left out")
        return replace(camera, distortion=())
    if found.distort:
        expected = f"OpenCV's lens model ({', '.join(NAMES)}), or distortion below {NEGLIGIBLE_PX:g} px everywhere"
        fix = "calibrate with that model"
        raise problem(path, expected, f"another one, with {px:.2f} px, in {camera.id}", fix)
    check_lens(camera, path)
    print(f"{camera.id}: its lens moves pixels by up to {px:.2f} px")
    return camera
