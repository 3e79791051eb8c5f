"""The report of a fit: one HTML page with its images inside and the video beside it, and nothing from a network."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from spike4dgs.benchmark.metrics.pose_error import angle_deg
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.figure import new_figure
from spike4dgs.benchmark.reports.html_page import Html, bullets, facts, image, paragraph, section, table, write_page
from spike4dgs.benchmark.runs.provenance import Provenance
from spike4dgs.benchmark.scene.cameras import Camera, array_axes
from spike4dgs.method.recordings.comparison import Comparison, mean_residual, residuals
from spike4dgs.method.recordings.held_out import SHOWN, HeldOutScores
from spike4dgs.method.recordings.self_calibrated import Calibrated

ABOVE, BEHIND = (0, 1), (0, 2)  # of right, forward and up, the axes that a plot shows


@dataclass(frozen=True, eq=False)
class Report:
    """Everything that the page shows. `about.cameras` are those of the fit."""

    about: Provenance
    source: Path  # the folder of the recording
    poses: str  # where they come from
    checked: Calibrated  # the recording, and the cameras as it gave them
    found: Comparison  # with the images that residuals are against
    judged: HeldOutScores | None  # the held-out cameras by their own spikes
    slow_motion: float  # how many times slower than the world the video is
    seconds: Mapping[str, float]  # by step
    model_mb: float | None  # None where it cannot be saved
    environment: Mapping[str, Any]
    command: str
    video: str  # file name beside the page


def write_report(path: Path, report: Report, sheet: Path) -> None:
    """Write the page; `sheet` is the PNG that it embeds."""
    about, maker = report.about, report.found.maker
    slow = f"the video is {report.slow_motion:.0f} times slower than the world"
    sheet_image = image(sheet.read_bytes(), "training views")
    parts = [
        paragraph(f"Fitted {about.created}. Files: `model.safetensors`, `sheet.png`, `{report.video}`."),
        facts(_summary(report)),
        section("Notes", [bullets([*report.checked.recording.notes, slow])]),
        section("Video", [Html(f'<video src="{escape(report.video)}" controls loop muted playsinline></video>')]),
        section(
            "Training views",
            [
                paragraph(
                    f"The {maker} image made from the spikes, the model's render, and their absolute difference, at "
                    "three times. Pixels that were left out are white in the difference."
                ),
                Html(f'<a href="{escape(sheet.name)}">{sheet_image}</a>'),
            ],
        ),
        section(
            "Cameras",
            [
                _cameras_table(report),
                paragraph(
                    f"Rates are spikes per tick. The residual is the PSNR of the model's renders against the {maker} "
                    "images of the same camera. It is a residual of the fit and not a score: the model has seen these "
                    "images, and their noise is in it. Dead pixels never fire under uniform light, hot ones fire in "
                    "the dark five times as often as the median pixel, the rate of flickering ones is not steady. "
                    "Without recordings of light and darkness these are the pixels that differ from all of their "
                    "neighbours. The gain is that of the camera beside the array's. A clock is given beside the mean "
                    "of all, at the middle of the clip, with its standard error; a pose's error is the median "
                    "distance of features from their points' projections, with the poses as they were given."
                ),
            ],
        ),
        *([_held_out(report.judged)] if report.judged else []),
        section(
            "Poses",
            [
                paragraph(f"{report.poses[0].upper() + report.poses[1:]}."),
                image(poses_plot(about.cameras, report.checked.given), "the array from above and from behind"),
            ],
        ),
        section("Program", [facts(_program(report))]),
    ]
    write_page(path, f"{about.name} on {about.scene}", parts)


def _summary(report: Report) -> list[tuple[str, str]]:
    about = report.about
    first = about.cameras[0]
    clip = f"{about.n_ticks} ticks at {about.rate_hz:g} Hz: {about.duration_us / 1e3:g} ms"
    mean = _decibel(mean_residual(report.found))
    steps = ", ".join(f"{step} {seconds:.1f} s" for step, seconds in report.seconds.items())
    cameras = f"{len(about.cameras)} of {first.width}x{first.height}"
    if held_out := report.checked.recording.held_out:
        cameras += f"; held out: {', '.join(held_out)}"
    return [
        ("recording", str(report.source)),
        ("cameras", cameras),
        ("clip", clip),
        ("poses", report.poses),
        ("mean residual", f"{mean} dB (not a score)"),
        ("times", steps),
        ("model", "cannot be saved" if report.model_mb is None else f"{report.model_mb:.2f} MB"),
    ]


def _program(report: Report) -> list[tuple[str, str]]:
    about, machine = report.about, report.environment
    commit = about.harness["commit"] or "unknown (an installed package)"
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    return [
        ("command", report.command),
        ("method, budget, seed", f"{about.name}, {about.budget}, {about.method['seed']}"),
        ("version, commit", f"{about.harness['version']}, {commit}{' and changes' if about.harness['dirty'] else ''}"),
        ("recording's revision", about.scene_revision),
        ("device", f"{about.device}: {machine['gpu'] or machine['cpu']}"),
        ("system", f"Python {machine['python']}, {machine['platform']}"),
        ("packages", packages),
    ]


def _cameras_table(report: Report) -> Html:
    heads = ["camera", "focal, px", "missing ticks", "mean rate", "1 %", "99 %"]
    heads += ["dead", "hot", "flickering", "gain", *report.checked.columns, "residual, dB"]
    focal, residual = {camera.id: camera.fx for camera in report.about.cameras}, residuals(report.found)
    rows = []
    for f in report.checked.recording.facts:
        cells = [f.camera, f"{focal[f.camera]:.1f}", f"{f.missing}", *(f"{v:.4f}" for v in (f.mean, f.low, f.high))]
        cells += [*(f"{n}" for n in (f.dead, f.hot, f.flickering)), f"{f.gain:.3f}"]
        cells += [column.get(f.camera, "-") for column in report.checked.columns.values()]
        rows.append([*cells, _decibel(residual[f.camera])])
    return table(heads, rows)


def _held_out(judged: HeldOutScores) -> Html:
    """Return the section of the held-out cameras: a row for each, and their mean."""
    heads = ["camera", "images", *(f"{METRICS[m].title}{', dB' if METRICS[m].unit else ''}" for m in SHOWN)]
    found = [(camera, judged.images[camera], values) for camera, values in judged.cameras.items()]
    found.append(("mean", sum(judged.images.values()), judged.mean))
    rows = [[name, f"{n}", *(METRICS[m].format(values[m]) for m in SHOWN)] for name, n, values in found]
    notes = [f"{METRICS[m].title}: {note}" for m, note in judged.notes.items()]
    explained = (
        "The fit has not seen these cameras. Their renders are compared with the spikes that they recorded "
        "themselves, without any ground truth. The spike PSNR (higher is better) compares counts over 5, 20 and 80 "
        "ticks; the noise of counting is in it, so compare it between models of one recording only. The spike deviance "
        "(lower is better) is what the recorded intervals lose in likelihood against the recorded rates."
    )
    return section("Held-out cameras", [table(heads, rows), paragraph(explained), bullets(notes)])


def _decibel(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "-"


def poses_plot(cameras: Sequence[Camera], given: Sequence[Camera]) -> bytes:
    """Return a PNG of the array from above and from behind; where the fit moved cameras, the given ones too."""
    figure = new_figure((9.0, 3.6))
    moved = [(c, g) for c, g in zip(cameras, given, strict=True) if not np.allclose(c.w2c, g.w2c, atol=1e-9)]
    middle, frame = np.mean([c.center for c in given], axis=0), array_axes(given)
    above, behind = figure.subplots(1, 2)

    def show(ax: Any, shown: Sequence[Camera], plane: tuple[int, int], color: str, label: str) -> None:
        """Plot centres with their viewing directions, in two of the array's axes."""
        centers = (np.stack([c.center for c in shown]) - middle) @ frame.T
        ahead = np.stack([c.R[2] for c in shown]) @ frame.T
        length = 0.25 * float(np.linalg.norm(centers, axis=1).max() or 1.0)
        (x, y), (dx, dy) = centers[:, plane].T, length * ahead[:, plane].T
        ax.scatter(x, y, s=18, color=color, label=label)
        ax.update_datalim(np.stack([x + dx, y + dy], axis=1))
        ax.quiver(x, y, dx, dy, color=color, angles="xy", scale_units="xy", scale=1, width=0.004)
        for camera, a, b in zip(shown, x, y, strict=True) if plane == BEHIND else ():
            ax.annotate(camera.id, (a, b), textcoords="offset points", xytext=(4, 4), fontsize=7, color=color)

    for ax, plane, title in ((above, ABOVE, "from above"), (behind, BEHIND, "from behind")):
        if moved:
            show(ax, given, plane, "0.6", "given")
        show(ax, cameras, plane, "tab:blue", "estimated" if moved else "cameras")
        ax.set(title=title, aspect="equal", xlabel="right", ylabel="forward" if plane == ABOVE else "up")
        ax.margins(0.25)
        ax.grid(alpha=0.3)
    if moved:
        turn = max(float(angle_deg(c.R @ g.R.T)) for c, g in moved)
        shift = max(float(np.linalg.norm(c.center - g.center)) for c, g in moved)
        behind.legend(fontsize=8)
        figure.suptitle(f"moved from the given poses by at most {shift:.4g} and {turn:.3f} degrees", fontsize=9)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
