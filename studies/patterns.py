"""`patterns`: estimate the cameras' fixed patterns from a scene's clip alone, and measure them against its calibration.

The calibration, from recordings under uniform light and in the dark, is what the fit does without; only this report
reads it. Errors of the gain have two parts. What all cameras have in common at a pixel of their chips is nearly a
texture of the scene, as the array is small; what they differ by, several views of each point tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from tyro.conf import Positional

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.files import atomic_path, check_writable, write_json
from spike4dgs.benchmark.method import FitRequest, make_budget, training_for
from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.benchmark.reports.figure import new_figure, save_figure
from spike4dgs.benchmark.runs.display import RunDisplay
from spike4dgs.benchmark.scene.calibration import Calibration
from spike4dgs.benchmark.scene.scene import TrainingScene, open_scene
from spike4dgs.method.models.fitted_model import FittedModel
from spike4dgs.method.recipes import METHODS, SELF_CALIBRATED
from spike4dgs.studies.kit.timing import show_table

Row = dict[str, float | str]
COLUMNS = {  # key of the row -> heading
    "gain_spread": "gain spread, %",
    "gain_error": "gain error, % RMS",
    "gain_error_apart": "of what cameras differ by",
    "dark_error": "dark error, spikes per 1000 ticks RMS",
}


def pattern_errors(gain: Float64, dark: Float64, calibrations: Sequence[Calibration]) -> list[Row]:
    """Return each camera's errors of maps [C, H, W]; gains are compared at mean 1, in percent, dark in 1/1000 ticks.

    `gain_error_apart` leaves out what the errors of all cameras have in common at a pixel.
    """
    true = np.stack([c.gain for c in calibrations]).astype(np.float64)
    true /= true.mean(axis=(1, 2), keepdims=True)
    error = gain / gain.mean(axis=(1, 2), keepdims=True) - true
    dark_error = dark - np.stack([c.dark for c in calibrations])
    return [
        {
            "gain_spread": 100 * float(own.std()),
            "gain_error": 100 * _rms(off),
            "gain_error_apart": 100 * _rms(apart),
            "dark_error": 1000 * _rms(d),
        }
        for own, off, apart, d in zip(true, error, error - error.mean(axis=0), dark_error, strict=True)
    ]


def _rms(a: Float64) -> float:
    return float(np.sqrt(np.mean(np.square(a))))


def patterns(
    scene: Positional[Path],
    *,
    budget: str = "quick",
    seed: int = 0,
    device: str = "cpu",
    out: Path = Path("runs/patterns"),
    allow_gaps: bool = False,
) -> int:
    """Fit `spike4dgs-x+self-calibrated` and write the gain and dark maps that it found: OUT/SCENE/CAM.npz, gain.png.

    Where the scene has recordings of uniform light and of darkness, the table and errors.json beside them list the
    errors.

    Args:
        scene: Scene folder.
        budget: Steps of the fit: quick, standard, or a multiple of quick.
        seed: Seed of everything random.
        device: auto, cpu or cuda.
        out: Folder for a folder of each scene: the maps, their image and the errors.
        allow_gaps: Accept a recording with gaps.
    """
    device = choose_device(device)
    training = open_scene(scene, allow_gaps).training
    true, out = training.calibrations, out / training.id
    check_writable(out)  # before the fit
    with RunDisplay(make_console(), 1) as display, display.cell(f"patterns of {training.id}") as shown:
        request = FitRequest(make_budget(budget), device, seed, shown.progress)
        method = METHODS[SELF_CALIBRATED.name]
        model = method.fit(training_for(method, training), request)
    assert isinstance(model, FittedModel)
    gain, dark = (model.estimates[name].cpu().numpy().astype(np.float64) for name in ("gain", "dark"))
    (out / "errors.json").unlink(missing_ok=True)  # of another fit
    for camera, g, d in zip(training.cameras, gain, dark, strict=True):
        with atomic_path(out / f"{camera.id}.npz") as part:
            np.savez(part, allow_pickle=False, gain=g.astype(np.float32), dark=d.astype(np.float32))
    _plot(training, gain, out / "gain.png")
    if true:
        rows = pattern_errors(gain, dark, true)
        ids = [camera.id for camera in training.cameras]
        texts = [[id, *(f"{row[key]:.2f}" for key in COLUMNS)] for id, row in zip(ids, rows, strict=True)]
        show_table("", ["camera", *COLUMNS.values()], texts, None)
        write_json(out / "errors.json", dict(zip(ids, rows, strict=True)))
    print(f"maps and images: {out}")
    return 0


def _plot(scene: TrainingScene, gain: Float64, path: Path) -> None:
    """Write an image of all gain maps, those of the calibration below where there is one."""
    rows = {"from the clip": list(gain)}
    if scene.calibrations:
        rows["from flat fields"] = [c.gain.astype(np.float64) for c in scene.calibrations]
    figure = new_figure((2.2 * len(gain), 0.4 + 1.6 * len(rows)))
    grid = figure.subplots(len(rows), len(gain), squeeze=False)
    for row, (title, maps) in zip(grid, rows.items(), strict=True):
        for axes, camera, image in zip(row, scene.cameras, maps, strict=True):
            axes.imshow(image, vmin=0.85, vmax=1.15, cmap="viridis")
            axes.set(title=f"{camera.id} {title}", xticks=[], yticks=[])
            axes.title.set_fontsize(8)
    save_figure(figure, path)
