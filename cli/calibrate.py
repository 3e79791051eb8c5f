"""`calibrate`: gain and dark maps of a scene's cameras from its recordings of uniform light and of darkness."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from tyro.conf import Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import locked, remove_parts, visible
from spike4dgs.benchmark.reports.figure import new_figure, save_figure
from spike4dgs.benchmark.scene.calibration import Calibration, estimate
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.benchmark.untrusted import Expected, read_npz
from spike4dgs.generators.sensor.calibration import write_maps
from spike4dgs.studies.kit.timing import show_table


def calibrate(scene: Positional[Path], *, out: Path = Path("runs/calibration")) -> int:
    """Estimate gain and dark maps of a scene's cameras from its flat-field and dark recordings: OUT/CAM.npz and .png.

    If the scene contains the true maps (truth/), the table lists the errors of the estimates.

    Args:
        scene: Scene folder with calibration/flat and calibration/dark.
        out: Folder for the maps and their images.
    """
    opened = open_scene(scene, allow_gaps=True)  # the clip itself, which may have gaps, is not used
    with locked(out / ".lock", out, "a folder that no other calibration writes to", temporary=True):
        remove_parts(out)
        given = [opened.cameras[c] for c in opened.meta["streams"]]  # a training part keeps the others back
        if others := [p.name for p in visible(out, "*.npz") if p.stem not in opened.meta["streams"]]:
            fix = "choose another --out, or remove it"
            raise problem(out, "a folder for this scene's maps", f"{others[0]} of another scene", fix)
        rows = [_calibrated(opened, camera, scene, out) for camera in given]
    columns = "camera", "spikes/tick, flat", "dark, median", "gain spread, %", "gain error, % RMS", "dark error, % RMS"
    show_table("", columns, rows, None)
    print(f"maps and images: {out}")
    return 0


def _calibrated(opened: Scene, camera: Camera, scene: Path, out: Path) -> list[str]:
    """Write the maps of a camera and their image; return its line of the table."""
    recordings = opened.recordings(camera.id)
    if recordings is None:
        fix = "make a scene with calibration/flat and calibration/dark"
        raise problem(scene / "scene.json", "calibration recordings", f"none of {camera.id}", fix)
    found = estimate(recordings)
    write_maps(out / f"{camera.id}.npz", {"gain": found.gain, "dark": found.dark})
    _plot(found, out / f"{camera.id}.png", camera.id)
    level, median = found.radiance_gain * recordings.flat_radiance, float(np.median(found.dark))
    row = [camera.id, f"{level:.4f}", f"{median:.5f}", f"{100 * float(found.gain.std()):.2f}"]
    return row + [f"{e:.3f}" if e is not None else "-" for e in _truth_errors(opened, camera, found)]


def _truth_errors(scene: Scene, camera: Camera, found: Calibration) -> tuple[float | None, float | None]:
    """Return the RMS errors in percent of gain and dark map, relative to the truth; None where the truth is unknown."""
    path = f"truth/{camera.id}.npz"
    if path not in scene.manifest.files:
        return None, None
    shapes = dict.fromkeys(("gain", "dark"), Expected("fiu", (camera.height, camera.width)))
    truth = read_npz(scene.manifest.path(path), "the true maps", shapes, "make the scene again", optional=True)
    pairs = [(getattr(found, name), truth.get(name)) for name in shapes]
    errors = [None if t is None else 100 * float(np.sqrt(np.mean((a / t - 1) ** 2))) for a, t in pairs]
    return errors[0], errors[1]


def _plot(found: Calibration, path: Path, title: str) -> None:
    figure = new_figure((11, 3.6), dpi=80)
    left, right = figure.subplots(1, 2)
    for axes, image, name, limits in (
        (left, found.gain, "gain", (0.8, 1.2)),
        (right, 1000 * found.dark, "dark rate, spikes per 1000 ticks", (0, 20)),
    ):
        figure.colorbar(axes.imshow(image, vmin=limits[0], vmax=limits[1], cmap="viridis"), ax=axes)
        axes.set(title=f"{title}: {name}", xticks=[], yticks=[])
    save_figure(figure, path)
