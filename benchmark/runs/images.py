"""The pictures of a run: a sheet of each scene with its video, and the scatter of quality against time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.reports.scatter import write_scatter
from spike4dgs.benchmark.reports.sheet import write_sheet
from spike4dgs.benchmark.reports.sheet_video import write_sheet_video
from spike4dgs.benchmark.runs.earlier import is_shown
from spike4dgs.benchmark.runs.record import Record
from spike4dgs.benchmark.runs.run import predictions_folder
from spike4dgs.benchmark.scene.scene import Scene


def write_images(scenes: Sequence[Scene], records: Sequence[Record], out: Path) -> list[str]:
    """Write sheet_SCENE and its video for each scene, and scatter; return which videos were not written, and why.

    A method without its predictions is in no sheet.
    """
    left_out = []
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
