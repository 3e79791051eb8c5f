"""`report realism`: real recordings against simulated ones of equal rates, before and after the sensor is mended.

Three ways: a classifier on windows (AUC 1/2: it cannot tell), statistics of intervals and counts, and ranks of image
makers by how well they predict the next spikes. `control` is what the procedure itself gives away: a simulated
recording in the place of the real one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from tyro.conf import Positional

from spike4dgs.benchmark.arrays import Float64, Int64, Mask, UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import write_json, write_text
from spike4dgs.benchmark.reports.figure import method_color, new_figure, save_figure
from spike4dgs.benchmark.spikes.sensor_model import SENSOR
from spike4dgs.benchmark.spikes.stream import open_stream
from spike4dgs.generators.sensor.model import Sensor
from spike4dgs.studies.kit.blocks import read_page, with_block
from spike4dgs.studies.kit.timing import markdown, write_csv
from spike4dgs.studies.realism import windows as w
from spike4dgs.studies.realism.classifier import FOLDS, auc_interval, out_of_fold, single_aucs, tiles
from spike4dgs.studies.realism.ranks import agreement, makers_here, prediction_errors

TILE = 40  # px: windows of one square are trained on or tested together
SHOWN = 8  # features in the table and the plot
GRID = tuple(product((0.0075, 0.0085), (0.0065, 0.008, 0.0095)))  # reset noise, clock ripple, in thresholds
STATISTICS = (
    "one interval",
    "intervals two apart",
    *(f"variance of {n} interval{'s' * (n > 1)}" for n in (1, 4, 8)),
    *(f"variance of counts of {n} ticks" for n in w.COUNTS),
)

Counterpart = Callable[[UInt8, Sensor, int], list[UInt8]]


@dataclass(frozen=True)
class Compared:
    """Two kinds of windows: features [N, F] of each, and the tile [N] that a pair of rows is from."""

    names: tuple[str, ...]
    first: Float64
    second: Float64
    tiles: Int64

    def report(self, rng: np.random.Generator) -> dict[str, Any]:
        """Return the classifier's AUC with its interval, the AUC of each feature alone, and the means of statistics."""
        folds = np.unique(self.tiles, return_inverse=True)[1] % FOLDS
        area, low, high = auc_interval(out_of_fold(self.first, self.second, folds), self.tiles, rng)
        means = {
            name: [float(rows[:, self.names.index(name)].mean()) for rows in (self.first, self.second)]
            for name in STATISTICS
        }
        singles = single_aucs(self.names, self.first, self.second)
        return {"windows": len(self.first), "auc": area, "interval": [low, high], "features": singles, "means": means}


def compare(parts: Sequence[UInt8], others: Sequence[UInt8], corners: Int64) -> Compared:
    """Return the windows at `corners` of a recording's parts beside those of its counterpart."""
    (names, first), (_, second) = w.table(parts, corners), w.table(others, corners)
    return Compared(names, first, second, np.tile(tiles(corners, TILE), len(parts)))


def sensor_with(reset_noise: float, clock_ripple: float) -> Sensor:
    """Return a sensor of radiance gain 1 with the project's photons per spike and uniform pixels."""
    photons = SENSOR.photons_per_spike
    return Sensor(1.0, photons=photons, reset_noise=reset_noise, clock_ripple=clock_ripple)


def fit_sensor(spikes: UInt8, corners: Int64, seed: int) -> Sensor:
    """Return the sensor of GRID whose still windows at `corners` the classifier tells least from the recording's."""
    areas: dict[tuple[float, float], float] = {}
    for values in GRID:
        sensor = sensor_with(*values)
        found = compare(w.halves(spikes), w.counterpart(spikes, sensor, seed), corners)
        areas[values] = found.report(np.random.default_rng(seed))["auc"]
        print(f"reset noise {values[0]:g}, clock ripple {values[1]:g}: AUC {areas[values]:.3f} where it is fitted")
    return sensor_with(*min(areas, key=lambda values: areas[values]))


def split(corners: Int64) -> tuple[Int64, Int64]:
    """Return the corners in the black and in the white tiles of a chessboard."""
    white = (corners // TILE).sum(1) % 2 == 1
    return corners[~white], corners[white]


def realism(
    recording: Positional[Path],
    *,
    width: int = 400,
    height: int = 250,
    reset_noise: float | None = None,
    clock_ripple: float | None = None,
    seed: int = 0,
    out: Path = Path("runs/realism"),
    page: Path | None = None,
) -> int:
    """Tell a real recording from simulated ones of equal rates: OUT/realism.json, .md, .csv and .png.

    Args:
        recording: Raw stream of a real camera that does not move, of 200 ticks or more; something in it moves.
        width: Pixels in a row.
        height: Rows.
        reset_noise: Of the mended sensor, in thresholds; left out, both are fitted, on every other square of 40 pixels.
        clock_ripple: Of the mended sensor, in thresholds.
        seed: Seed of everything random.
        out: Folder for the results.
        page: Results page whose block `<!-- realism -->` is written anew.
    """
    if page is not None:
        read_page(page, "realism")  # before the work
    stream = open_stream(recording, width, height, w.RATE_HZ)
    if stream.n_ticks < 2 * w.TICKS:
        raise problem(recording, f"{2 * w.TICKS} ticks or more", f"{stream.n_ticks}", "give a longer recording")
    spikes = stream.window(0, 2 * w.TICKS)
    regions = w.regions_of(spikes)
    corners = {region: w.corners_of(pixels) for region, pixels in regions.items()}
    fitted, corners["still"] = split(corners["still"])  # nothing is fitted to the other squares
    for region, of in (*corners.items(), ("still", fitted)):
        if len(np.unique(tiles(of, TILE))) < FOLDS:
            raise problem(recording, f"{region} pixels in {FOLDS} places or more", f"{len(of)} windows", "film more")
    given = reset_noise is not None or clock_ripple is not None
    found = sensor_with(reset_noise or 0.0, clock_ripple or 0.0) if given else fit_sensor(spikes, fitted, seed + 30)
    sensors, rng = {"before": sensor_with(0.0, 0.0), "after": found}, np.random.default_rng(seed)
    report: dict[str, Any] = {"reset_noise": found.reset_noise, "clock_ripple": found.clock_ripple, "seed": seed}
    pairs = {
        (make, name): _counterpart_and_control(make, spikes, sensor, seed)
        for make in (w.counterpart, w.moving_counterpart)
        for name, sensor in sensors.items()
    }
    for region, of in corners.items():
        for name in sensors:
            made, again = pairs[w.moving_counterpart if region == "moving" else w.counterpart, name]
            report[f"{region}, {name}"] = compare(w.halves(spikes), made, of).report(rng)
            report[f"{region}, {name}, control"] = compare(made, again, of).report(rng)
    report["ranks"] = _ranks(spikes, regions, sensors, seed)
    write_json(out / "realism.json", report)
    text = to_markdown(report)
    write_text(out / "realism.md", text + "\n")
    rows = [[case, name, value] for case, found in _cases(report).items() for name, value in found["features"].items()]
    write_csv(out / "realism.csv", ["case", "feature", "auc"], rows)
    write_plot(out / "realism.png", report)
    print(text)
    if page is not None:
        write_text(page, with_block(read_page(page, "realism"), "realism", [text]))
    return 0


def _counterpart_and_control(
    make: Counterpart, spikes: UInt8, sensor: Sensor, seed: int
) -> tuple[list[UInt8], list[UInt8]]:
    """Return the counterpart of a recording, and the counterpart of that one."""
    made = make(spikes, sensor, seed + 10)
    return made, make(np.concatenate(made), sensor, seed + 20)


def _ranks(spikes: UInt8, regions: dict[str, Mask], sensors: dict[str, Sensor], seed: int) -> dict[str, Any]:
    light, makers = w.course(spikes), makers_here()
    recordings = {"real": spikes, **{name: w.record(*light, sensor, seed) for name, sensor in sensors.items()}}
    found = {name: prediction_errors(recorded, regions, makers) for name, recorded in recordings.items()}
    errors = {region: {name: of[region] for name, of in found.items()} for region in regions}
    tau = {
        region: {name: agreement(of["real"], of[name]) for name in of if name != "real"}
        for region, of in errors.items()
    }
    return {"errors": errors, "kendall": tau}


def _cases(report: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in report.items() if isinstance(value, dict) and "auc" in value}


def to_markdown(report: dict[str, Any]) -> str:
    """Return the tables: AUC, features alone and statistics of still windows, and ranks."""
    cases = _cases(report)
    rows = []
    for region in report["ranks"]["errors"]:
        for name in ("before", "after"):
            found, control = cases[f"{region}, {name}"], cases[f"{region}, {name}, control"]
            rows.append([region, name, str(2 * found["windows"]), _area(found), _area(control)])
    lines = markdown(["windows", "sensor", "number", "AUC, real against simulated", "AUC, control"], rows)
    before, after = cases["still, before"], cases["still, after"]
    shown = [[n, f"{v:.2f}", f"{after['features'][n]:.2f}"] for n, v in [*before["features"].items()][:SHOWN]]
    lines += ["", *markdown(["one feature alone, still windows", "AUC before", "AUC after"], shown)]
    values = [(n, *before["means"][n], after["means"][n][1]) for n in STATISTICS]
    lines += [
        "",
        *markdown(
            ["statistic, still windows", "real", "before", "after"],
            [[n, *(f"{v:.4f}" for v in of)] for n, *of in values],
        ),
    ]
    ranks = report["ranks"]
    heads = [f"{region}, {name}" for region, of in ranks["errors"].items() for name in of]
    columns = [of[name] for of in ranks["errors"].values() for name in of]
    errors = [[maker, *(f"{1e3 * column[maker]:.3f}" for column in columns)] for maker in columns[0]]
    tau = [
        f"{of[name]:.2f}" if name != "real" else "" for region, of in ranks["kendall"].items() for name in ("real", *of)
    ]
    errors.append(["Kendall's rank correlation with real", *tau])
    lines += ["", *markdown(["error of the next ticks' rate, squared, 1e-3", *heads], errors)]
    return "\n".join(lines)


def _area(found: dict[str, Any]) -> str:
    low, high = found["interval"]
    return f"{found['auc']:.3f} ({low:.3f} to {high:.3f})"


def write_plot(path: Path, report: dict[str, Any]) -> None:
    """Write the AUC of each feature alone on still windows, before and after; 1/2 tells nothing."""
    cases = _cases(report)
    before, after = cases["still, before"], cases["still, after"]
    names = [*before["features"]][: 2 * SHOWN]
    figure = new_figure((8, 5.2))
    axes, at = figure.subplots(), np.arange(len(names))[::-1]
    for k, (label, found) in enumerate((("before", before), ("after", after))):
        areas = [found["features"][n] for n in names]
        axes.plot(areas, at, "o", color=method_color(2 * k), label=f"{label}: all features {_area(found)}")
    axes.axvline(0.5, color="0.5", lw=1)
    axes.set_yticks(at, names, fontsize=8)
    axes.set(xlim=(0, 1), xlabel="AUC of one feature alone: below 1/2 the real windows have more of it")
    axes.grid(alpha=0.3)
    figure.legend(loc="outside upper center", ncols=2, fontsize=8)
    save_figure(figure, path)
