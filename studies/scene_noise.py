"""`report scene-noise`: how much rendering noise is in scenes, from the audits of `make-dataset --audit`.

The audit finds the noise of an image I from two more renderings A and B with other random numbers, as the mean of
(I - A)(I - B). Noise of ground truth bounds every score; that of the streams is to lie below the sensor's.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tyro.conf import Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_json, write_text
from spike4dgs.benchmark.reports.figure import new_figure, save_figure
from spike4dgs.studies.kit.timing import markdown, show_table, write_csv

COLUMNS = (
    "scene",
    "made in, s",
    "streams: whole, moving, objects, dB",
    "correlation 1 ms apart",
    "truth: whole, moving, objects, dB",
    "radiance error, %",
    "truth against whole paths, moving, dB",
)
GOALS_DB = {"streams": 46.0, "truth": 52.0}
_REGIONS = ("whole_db", "moving_db", "object_db")


def scene_noise(folders: Positional[tuple[Path, ...]] = (Path("data"),), *, out: Path = Path("runs/noise")) -> int:
    """Tabulate and plot the rendering noise of audited scenes: OUT/noise.md, .csv and .png.

    Args:
        folders: Folders of scenes that `make-dataset --audit` made, with their reports ID.report.json.
        out: Folder for the results.
    """
    reports = [
        read_json(path, "a scene's report") for folder in folders for path in sorted(folder.glob("*.report.json"))
    ]
    audited = [report for report in reports if (report.get("audit") or {}).get("noise")]
    if not audited:
        expected, found = "reports of audited scenes", f"{len(reports)} reports without an audit" if reports else "none"
        raise problem(", ".join(map(str, folders)), expected, found, "make scenes with `make-dataset --audit`")
    rows = [_row(report) for report in audited]
    write_text(out / "noise.md", "\n".join([*markdown(COLUMNS, rows), ""]))
    write_csv(out / "noise.csv", COLUMNS, rows)
    _plot(audited, out / "noise.png")
    show_table("", COLUMNS, rows, None)
    print(f"written: {out}/noise.md, .csv, .png")
    return 0


def _row(report: dict[str, Any]) -> list[str]:
    noise, ticks = report["audit"]["noise"], report["audit"]["ticks"]["total"]
    streams, truth = noise["streams"], noise["truth"]
    return [
        report["scene"],
        f"{report['total_s'] - report['stages_s'].get('audit', 0):.0f}",
        " / ".join(_number(streams[region]) for region in _REGIONS),
        _number(streams["correlation_moving"], 2),
        " / ".join(_number(truth[region]) for region in _REGIONS),
        _number(ticks["mean_percent"]),
        _number(noise.get("truth_against_paths", {}).get("moving_db")),
    ]


def _number(value: float | None, digits: int = 1) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _plot(reports: Sequence[dict[str, Any]], path: Path) -> None:
    """Write the noise where things move, a pair of bars a scene, with the goals as lines."""
    figure = new_figure((1.5 + 0.5 * len(reports), 3.6))
    axes, at = figure.subplots(), np.arange(len(reports))
    for k, (name, goal) in enumerate(GOALS_DB.items()):
        values = [report["audit"]["noise"][name]["moving_db"] or np.nan for report in reports]
        bars = axes.bar(at + 0.4 * k - 0.2, values, 0.38, label=name)
        axes.axhline(goal, color=bars[0].get_facecolor(), lw=1, ls="--")
    axes.set(ylabel="noise where things move, dB", ylim=(30, None))
    axes.set_xticks(at, [report["scene"] for report in reports], rotation=45, ha="right", fontsize=8)
    figure.legend(loc="outside upper right", ncols=2, fontsize=8)
    save_figure(figure, path)
