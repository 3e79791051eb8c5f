"""The course of a training: rows of a CSV file, and plots of them."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path, write_text
from spike4dgs.benchmark.scene.training_bursts import Float64

Row = Mapping[str, float]


class Curve:
    """Rows by step in a CSV file; those that a resumed training will make again are dropped.

    Raises UserError for a file that is no such table.
    """

    def __init__(self, path: Path, until_step: int) -> None:
        self.path = path
        self.rows: list[dict[str, float]] = []
        if path.is_file():
            try:
                with open(path, newline="") as f:
                    rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(f)]
                self.rows = [row for row in rows if row["step"] <= until_step]
            except (ValueError, KeyError, TypeError) as e:
                raise problem(path, "a table of numbers", f"damaged text ({e})", "delete it") from None

    def add(self, step: int, values: Row) -> None:
        """Add a row."""
        self.rows.append({"step": step, **values})

    def write(self) -> None:
        """Write the file."""
        text = io.StringIO()
        writer = csv.DictWriter(text, list(self.rows[0]) if self.rows else ["step"], lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: f"{value:.7g}" for name, value in row.items()} for row in self.rows)
        write_text(self.path, text.getvalue())


def plot_curves(path: Path, losses: Sequence[Row], scores: Sequence[Row]) -> None:
    """Plot the training's losses, and the scores on hidden variants."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 7), layout="constrained")
    panels = (
        (losses, ("image_l1",), "L1 of images (radiance)", True),
        (losses, ("points",), "loss of points", False),
        (scores, ("psnr_db", "tfp_psnr_db", "psnr_dynamic_db", "tfp_psnr_dynamic_db"), "PSNR, hidden (dB)", False),
        (scores, ("point_error", "point_error_median", "point_error_confident"), "error of points, hidden", True),
        (scores, ("rotation_deg", "direction_deg"), "error of poses, hidden, median (degrees)", True),
        (scores, ("confidence_rank", "calibration"), "confidence, hidden", False),
    )
    for axes, (rows, names, title, logarithmic) in zip(figure.subplots(2, 3).flat, panels, strict=True):
        for name in names:
            points = [(row["step"], row[name]) for row in rows if name in row]
            axes.plot(*zip(*points, strict=True) if points else ((), ()), ".-", markersize=3, label=name)
        axes.set(title=title, xlabel="step", yscale="log" if logarithmic else "linear")
        axes.grid(True, color="0.9")
        axes.legend(fontsize=8)
    with atomic_path(path) as part:
        figure.savefig(part)


def plot_calibration(path: Path, groups: Float64) -> None:
    """Plot the true against the expected error of groups [G, 2] of pixels."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 5), layout="constrained")
    axes = figure.subplots()
    ends = [float(groups.min()), float(groups.max())]
    axes.plot(ends, ends, color="0.7", label="as expected")
    axes.plot(groups[:, 0], groups[:, 1], "o-", label="tenths of the pixels, by expected error")
    axes.set(xscale="log", yscale="log", xlabel="expected error, alpha / C", ylabel="true error")
    axes.set_title("points of hidden variants,\nin mean distances of a sample")
    axes.grid(True, color="0.9")
    axes.legend(fontsize=8)
    with atomic_path(path) as part:
        figure.savefig(part)
