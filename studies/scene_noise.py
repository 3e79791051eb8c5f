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
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.leaderboard.tracks import short
from spike4dgs.studies.kit.blocks import read_page, table_rows, with_block
from spike4dgs.studies.kit.timing import markdown, show_table, write_csv

COLUMNS = (
    "scene",
    "revision",
    "made in, s",
    "streams: whole, moving, objects, dB",
    "correlation 1 ms apart",
    "truth: whole, moving, objects, dB",
    "radiance error, %",
    "truth against whole paths, moving, dB",
)
GOALS_DB = {"streams": 46.0, "truth": 52.0}
_REGIONS = ("whole_db", "moving_db", "object_db")


def scene_noise(
    folders: Positional[tuple[Path, ...]] = (Path("data"),),
    *,
    out: Path = Path("runs/noise"),
    page: Path | None = None,
) -> int:
    """Tabulate and plot the rendering noise of audited scenes: OUT/noise.md, .csv and .png.

    Args:
        folders: Folders of scenes that `make-dataset --audit` made, with their reports ID.report.json.
        out: Folder for the results.
        page: Results page whose block `<!-- noise -->` gets the rows. Rows of other scenes that it has stay.
    """
    reports = [
        (folder, read_json(path, "a scene's report"))
        for folder in folders
        for path in sorted(folder.glob("*.report.json"))
    ]
    audited = [(folder, report) for folder, report in reports if (report.get("audit") or {}).get("noise")]
    if not audited:
        expected, found = "reports of audited scenes", f"{len(reports)} reports without an audit" if reports else "none"
        raise problem(", ".join(map(str, folders)), expected, found, "make scenes with `make-dataset --audit`")
    if page is not None:
        read_page(page, "noise")  # before anything is written
    rows = [_row(report, folder / report["scene"]) for folder, report in audited]
    write_text(out / "noise.md", "\n".join([*markdown(COLUMNS, rows), ""]))
    write_csv(out / "noise.csv", COLUMNS, rows)
    _plot([report for _, report in audited], out / "noise.png")
    if page is not None:
        _write_page(page, rows)
    show_table("", COLUMNS, rows, None)
    print(f"written: {out}/noise.md, .csv, .png")
    return 0


def _row(report: dict[str, Any], scene: Path) -> list[str]:
    noise, ticks = report["audit"]["noise"], report["audit"]["ticks"]["total"]
    streams, truth = noise["streams"], noise["truth"]
    return [
        report["scene"],
        short(open_scene(scene, allow_gaps=True).revision),
        f"{report['total_s'] - report['stages_s'].get('audit', 0):.0f}",
        " / ".join(_number(streams[region]) for region in _REGIONS),
        _number(streams["correlation_moving"], 2),
        " / ".join(_number(truth[region]) for region in _REGIONS),
        _number(ticks["mean_percent"]),
        _number(noise.get("truth_against_paths", {}).get("moving_db")),
    ]


def _write_page(page: Path, rows: Sequence[Sequence[str]]) -> None:
    """Put the rows into the page's block, in the order of the scenes' names."""
    text = read_page(page, "noise")
    lines = {line.split(" | ")[0]: line for line in [*table_rows(text, "noise"), *markdown(COLUMNS, rows)[2:]]}
    shown = [*markdown(COLUMNS, []), *(lines[scene] for scene in sorted(lines))]
    write_text(page, with_block(text, "noise", shown))


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
