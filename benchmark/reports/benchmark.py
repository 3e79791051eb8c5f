"""Run methods on the scenes of one split, and write all that people look at.

OUT/results.csv                 all records, a row for each method, seed and scene
OUT/table.{md,tex}              means and scenes in the columns of the terminal, the best in bold
OUT/sheet_SCENE.{png,pdf,mp4}   truth, renders and errors of each scene
OUT/scatter.{png,pdf}           quality against time

Records that earlier runs left in OUT on the same scenes are in all of these. Images show the first seed. The rest of
OUT is as `run_matrix` keeps it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.method import Method
from spike4dgs.benchmark.reports.console import Columns, print_results
from spike4dgs.benchmark.reports.paper_files import write_results_table
from spike4dgs.benchmark.reports.scatter import write_scatter
from spike4dgs.benchmark.reports.sheet import write_sheet
from spike4dgs.benchmark.reports.sheet_video import write_sheet_video
from spike4dgs.benchmark.runs.record import Record
from spike4dgs.benchmark.runs.results import earlier_records, is_shown, of_one_seed, write_results
from spike4dgs.benchmark.runs.run import Settings, predictions_folder, run_matrix
from spike4dgs.benchmark.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class SplitRun:
    """A run on scenes with one split: its records, and those of earlier runs in the same folder."""

    scenes: Sequence[Scene]
    settings: Settings
    records: list[Record]
    earlier: list[Record]


def run_split(
    scenes: Sequence[Scene], methods: Sequence[Method], settings: Settings, console: Console, columns: Columns = "short"
) -> SplitRun:
    """Fit methods on scenes or resume them, print the table, and write table and images."""
    out = settings.out
    records = run_matrix(scenes, methods, settings, console)
    earlier, left_out = earlier_records(out, records, [scene.id for scene in scenes])
    lines = [f"not in the table: {line}" for line in left_out]
    every = [*earlier, *records]
    _say(console, *lines)
    print_results(console, every, columns)
    write_results(out / "results.csv", every)
    write_results_table(out, every)
    _say(console, *_write_images(scenes, of_one_seed(every), settings))
    _say(console, f"images: {out}/sheet_*.png and {out}/scatter.png; values: {out}/results.csv")
    _say(console, f"for papers and slides: the same as .pdf, {out}/table.md, table.tex and sheet_*.mp4")
    return SplitRun(scenes, settings, records, earlier)


def _write_images(scenes: Sequence[Scene], records: Sequence[Record], settings: Settings) -> list[str]:
    """Write the sheets, their videos and the scatter; return which videos were not written, and why.

    A method without its predictions is in no sheet.
    """
    left_out, out = [], settings.out
    for scene in scenes:
        of_all = {r["method"]["name"]: predictions_folder(out, r["method"]["name"], scene.id) for r in records}
        folders = {name: of_all[name] for r in records if is_shown(r, scene, of_all[name := r["method"]["name"]])}
        write_sheet(out / f"sheet_{scene.id}.png", scene, folders, records)
        try:
            write_sheet_video(out / f"sheet_{scene.id}.mp4", scene, folders, records)
        except UserError as e:  # the numbers of a long run are worth more than its video
            left_out.append(f"no video: {e}")
    write_scatter(out / "scatter.png", records)
    return left_out


def _say(console: Console, *lines: str) -> None:
    for line in lines:
        console.print(line, highlight=False, markup=False)
