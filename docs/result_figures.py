"""Write figures of the results pages that no command writes: `python docs/result_figures.py SCENE STRIP OUT`.

STRIP is strip_SCENE.png of `speed images`. The files are OUT/images.webp, sensor.webp and uncalibrated.webp.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from PIL import Image

from spike4dgs.benchmark import open_scene
from spike4dgs.benchmark.reports.figure import new_figure, save_figure

TABLES = Path(__file__).parent / "results" / "tables"
COLUMNS = 8  # of the strip: truth and seven image makers
TFP_TICKS = 40


def images(strip: Path, out: Path) -> None:
    """Fold the strip of `speed images` into two rows."""
    whole = Image.open(strip).convert("RGB")
    half = whole.width * 4 // COLUMNS
    folded = Image.new("RGB", (half, 2 * whole.height), "white")
    for row in range(2):
        folded.paste(whole.crop((row * half, 0, (row + 1) * half, whole.height)), (0, row * whole.height))
    folded.save(out, quality=80, method=6)


def sensor(folder: Path, out: Path) -> None:
    """Show what one simulated camera gives: a tick, the mean of 40 ticks, and its calibrated gain and dark maps."""
    scene = open_scene(folder).training
    stream, tick = scene.streams[0], scene.n_ticks // 2
    maps = (scene.calibrations or (None,))[0]
    assert maps is not None, "a scene with calibration recordings"
    counts = stream.counts(tick - TFP_TICKS // 2, tick + TFP_TICKS // 2) / TFP_TICKS
    panels = (
        ("spikes of one tick", stream.window(tick, tick + 1)[0], 0, 1, "gray"),
        (f"mean of {TFP_TICKS} ticks, spikes per tick", counts, 0, 0.6, "gray"),
        ("gain map", maps.gain, 0.85, 1.15, "coolwarm"),
        ("dark map, spikes per tick", maps.dark, 0, 0.015, "magma"),
    )
    figure = new_figure((9, 5.6), "constrained")
    for axes, (title, values, low, high, colors) in zip(figure.subplots(2, 2).flat, panels, strict=True):
        shown = axes.imshow(values, cmap=colors, vmin=low, vmax=high, interpolation="nearest")
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
        figure.colorbar(shown, ax=axes, shrink=0.8)
    _save(figure, out)


def uncalibrated(out: Path) -> None:
    """Show each row's PSNR where things move with given and with estimated poses, from the committed tables."""
    given, estimated = (_moving(TABLES / name / "table.json") for name in ("table1", "table1_uncalibrated"))
    # The last rows of table 1 are of later commits than the rows with estimated poses: they are not compared.
    rows = [(name.replace("+colmap", ""), value) for name, value in estimated.items() if "spike4dgs" not in name]
    rows = [(name, value) for name, value in rows if given.get(name) is not None and value is not None]
    figure = new_figure((8, 4), "constrained")
    axes = figure.subplots()
    for y, (name, value) in enumerate(reversed(rows)):
        axes.plot([given[name], value], [y, y], color="0.6", zorder=1)
        axes.scatter([given[name]], [y], color="tab:blue", label="given poses" if y == 0 else None)
        axes.scatter([value], [y], color="tab:orange", label="poses by COLMAP" if y == 0 else None)
    axes.set_yticks(range(len(rows)), [name for name, _ in reversed(rows)])
    axes.set_xlabel("PSNR where things move, dB: mean of five scenes")
    axes.grid(axis="x", alpha=0.3)
    axes.legend()
    _save(figure, out)


def _moving(path: Path) -> dict[str, float | None]:
    rows = json.loads(path.read_text(encoding="utf-8"))["rows"]
    return {row["method"]: row["mean"]["psnr_dynamic"]["value"] for row in rows}


def _save(figure: object, out: Path) -> None:
    png = out.with_suffix(".png")
    save_figure(figure, png)  # type: ignore[arg-type]
    Image.open(png).convert("RGB").save(out, quality=85, method=6)
    png.unlink()


def main(scene: str, strip: str, out: str) -> None:
    """Write the three figures."""
    images(Path(strip), Path(out) / "images.webp")
    sensor(Path(scene), Path(out) / "sensor.webp")
    uncalibrated(Path(out) / "uncalibrated.webp")


if __name__ == "__main__":
    main(*sys.argv[1:])
