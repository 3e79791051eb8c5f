"""`report modality`: fits of what spike cameras, frame cameras and event cameras record of the same scenes.

OUT/modality.md, modality.csv, modality.png   quality against the bits per second of a camera; the rest is as
`run-benchmark` keeps it
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from tyro.conf import Positional

from spike4dgs.benchmark.files import write_text
from spike4dgs.benchmark.method import (
    DEFAULT_BUDGET,
    Method,
    choose_device_for,
    get_method,
    make_budget,
)
from spike4dgs.benchmark.metrics.measure import mean
from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.benchmark.reports.figure import method_color, new_figure, save_figure
from spike4dgs.benchmark.reports.scatter import label_points
from spike4dgs.benchmark.runs.apart.fit import Apart
from spike4dgs.benchmark.runs.record import Record
from spike4dgs.benchmark.runs.run import Settings, run_matrix, split_folder
from spike4dgs.benchmark.scene.scene import Scene, open_scenes
from spike4dgs.studies.kit.timing import markdown, write_csv
from spike4dgs.studies.sensors import BITS_OF_A_PIXEL, BITS_OF_AN_EVENT, bits_per_second, sensors_of

ROWS = (
    "rgb+4dgs",
    "rgb+stg",
    "rgb-deblur+stg",
    "edi+stg",
    "edi+4dgs",
    "tfp+stg",
    "tfp+rig-flat+stg",
    "spk2img+stg",
    "spike4dgs",
    "spike4dgs-x",
)
MEAN = "mean"
COLUMNS = {
    "bits_per_second": "Mbit/s of a camera",
    "psnr": "PSNR, dB",
    "psnr_dynamic": "PSNR where things move, dB",
    "temporal_error": "temporal error",
    "fit_seconds": "fit, s",
}
_DIGITS = {"psnr": 2, "psnr_dynamic": 2, "temporal_error": 4, "fit_seconds": 0}
Values = dict[str, float | None]  # by column


@dataclass(frozen=True)
class Row:
    """A method on the scenes: values by scene and then by column, of several scenes their mean too."""

    method: str
    sensors: tuple[str, ...]
    values: dict[str, Values]
    errors: dict[str, str]  # by scene

    @property
    def summary(self) -> Values:
        """The values of the only scene, or the mean."""
        return list(self.values.values())[-1]


def modality(
    scenes: Positional[tuple[Path, ...]],
    *,
    out: Path = Path("runs/modality"),
    seed: int = 0,
    seeds: int = 1,
    workers: int = 1,
    device: str = "auto",
    budget: str = DEFAULT_BUDGET,
    split: str | None = None,
) -> int:
    """Fit what three kinds of sensors record of the same scenes, and plot the quality against bits per second.

    Frames of 60 fps alone, with their exposure integrated by rendering, frames with events by EDI, and spikes: the same
    poses, first points by the same sweep, and the same fits. OUT gets modality.md, .csv and .png. What OUT holds of a
    run already is kept, so a killed run resumes: give the same command again.

    Args:
        scenes: Scene folders with frames and events, of `make-dataset`, best of 0.1 s: 20 ms hold one frame.
        out: Folder for the results, and for what `run-benchmark` keeps; of another split than the default, OUT/SPLIT.
        seed: Seed that every fit gets.
        seeds: Number of seeds, from that one up; the table shows means over them.
        workers: Processes that fit, each on its share of this machine's cores.
        device: auto, cpu or cuda.
        budget: quick, standard (4 times the steps), or a multiple of quick.
        split: Training views and held-out views, such as corner or views-3; each scene's default if left out.
    """
    opened, console = open_scenes(scenes, split=split), make_console()
    methods = [get_method(name) for name in ROWS]
    chosen = choose_device_for(methods, device)
    out = split_folder(out, split, opened)
    settings = Settings(out, seed, chosen, make_budget(budget), ("psnr",), seeds, workers, apart=Apart())
    rows = compare(opened, methods, settings, console)
    failed = [f"{row.method} on {scene}: {why}" for row in rows for scene, why in row.errors.items()]
    for line in (f"written: {out}/modality.md, .csv, .png", *(f"failed: {line}" for line in failed)):
        console.print(line, highlight=False, markup=False)
    return 1 if failed else 0


def compare(scenes: Sequence[Scene], methods: Sequence[Method], settings: Settings, console: Console) -> list[Row]:
    """Fit all methods or resume them, write table and plot, and return the table's rows."""
    records = run_matrix(scenes, methods, settings, console)
    rows = [make_row(method, scenes, records) for method in methods]
    text = to_markdown(rows, scenes)
    write_text(settings.out / "modality.md", text)
    lines = [
        [row.method, "+".join(row.sensors), scene, *values.values(), row.errors.get(scene, "")]
        for row in rows
        for scene, values in row.values.items()
    ]
    write_csv(settings.out / "modality.csv", ["method", "sensors", "scene", *COLUMNS, "error"], lines)
    plot(settings.out / "modality.png", rows)
    console.print(text, highlight=False, markup=False)
    return rows


def make_row(method: Method, scenes: Sequence[Scene], records: Sequence[Record]) -> Row:
    """Return the row of a method, each value the mean over the seeds in `records`."""
    sensors, mine = sensors_of(method), [r for r in records if r["method"]["name"] == method.name]
    found: dict[str, Values] = {}
    errors = {}
    for scene in scenes:
        cells = [r["scenes"][scene.id] for r in mine]
        values = [{**(c["metrics"] or {}), "fit_seconds": c["fit_seconds"]} for c in cells]
        found[scene.id] = {column: mean([v.get(column) for v in values]) for column in COLUMNS}
        if why := "; ".join(str(c["error"]) for c in cells if c["error"]):
            errors[scene.id] = why
        else:
            found[scene.id]["bits_per_second"] = bits_per_second(scene, sensors)
    if len(scenes) > 1:
        found[MEAN] = {column: mean([v[column] for v in found.values()]) for column in COLUMNS}
    return Row(method.name, sensors, found, errors)


def to_markdown(rows: Sequence[Row], scenes: Sequence[Scene]) -> str:
    """Return the table in Markdown, what its bits are, and what failed."""
    where = scenes[0].id if len(scenes) == 1 else f"mean of {', '.join(scene.id for scene in scenes)}"
    cells = [[row.method, " and ".join(row.sensors), *(value_text(row.summary, c) for c in COLUMNS)] for row in rows]
    bits = (
        f"Bits per second of a camera: pixels x {BITS_OF_A_PIXEL} x frames per second; {BITS_OF_AN_EVENT} for each "
        "event that it fired; pixels x ticks per second of spikes. None is compressed. A row of two sensors has their "
        "sum."
    )
    errors = [f"- {row.method}, {scene}: {why}" for row in rows for scene, why in row.errors.items()]
    table = markdown(["method", "sensors", *COLUMNS.values()], cells)
    return "\n".join(["# Spikes, frames and events", "", f"{where}.", "", *table, "", bits, "", *errors]) + "\n"


def value_text(values: Values, column: str) -> str:
    """Return a value with the digits of its column; "-" where there is none."""
    value = values[column]
    if value is None:
        return "-"
    return f"{value / 1e6:.3g}" if column == "bits_per_second" else f"{value:.{_DIGITS[column]}f}"


def plot(path: Path, rows: Sequence[Row]) -> None:
    """Write a PNG: PSNR where things move against bits per second of a camera."""
    figure = new_figure((8, 5))
    axes = figure.subplots()
    shown: list[tuple[float, float, str]] = []
    kinds = list(dict.fromkeys(row.sensors for row in rows))
    for row in rows:
        x, y = (row.summary[column] for column in ("bits_per_second", "psnr_dynamic"))
        if x and y is not None:
            style: dict[str, Any] = {"color": method_color(2 * kinds.index(row.sensors)), "ms": 8, "mec": "white"}
            axes.plot(x, y, "o", **style)
            shown.append((x, y, row.method))
    axes.set_xscale("log")
    axes.set_xlabel("bits per second of a camera")
    axes.set_ylabel(COLUMNS["psnr_dynamic"])
    if shown:
        least, most = (end(x for x, _, _ in shown) for end in (min, max))
        axes.set_xlim(least / 2, most * 8)  # names are at the right
        axes.margins(y=0.1)
        figure.canvas.draw()
        label_points(axes, shown, ())
    axes.grid(alpha=0.3)
    save_figure(figure, path)
