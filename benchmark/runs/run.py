"""Run methods on scenes: every method on every scene, a result record for each method.

OUT/predictions/METHOD/SCENE/   the rendered images; a later run resumes by their content key alone
OUT/models/METHOD/SCENE.safetensors   the fitted model, for `render` and `view`
OUT/results/METHOD.json         the result records, scored from those files
OUT/logs/METHOD__SCENE.log      the traceback of a failed cell
OUT/work/KEY/                   the checkpoint of an unfinished fit
"""

from __future__ import annotations

import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import write_text
from spike4dgs.benchmark.locks import locked
from spike4dgs.benchmark.method import Budget, Method
from spike4dgs.benchmark.metrics.selection import AUTO, Selection, select_metrics
from spike4dgs.benchmark.reports.console import cell_summary
from spike4dgs.benchmark.results.record import Cell, Record, build_record, check_method_name, missing_cell, write_record
from spike4dgs.benchmark.results.refinement import SUFFIX
from spike4dgs.benchmark.results.score import open_for, score_scene
from spike4dgs.benchmark.runs.cell import Job, is_done, run_job
from spike4dgs.benchmark.runs.display import RunDisplay
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.benchmark.weights import WeightsError


@dataclass(frozen=True)
class Settings:
    """The settings that all cells of a run share."""

    out: Path
    seed: int = 0
    device: str = "cpu"
    budget: Budget = Budget()
    metrics: tuple[str, ...] = (AUTO,)


def predictions_folder(out: Path, method: str, scene: str) -> Path:
    """Return the folder in which a run keeps the predictions of a cell."""
    return out / "predictions" / method / scene


def run_matrix(
    scenes: Sequence[Scene], methods: Sequence[Method], settings: Settings, console: Console
) -> list[Record]:
    """Run, or resume, every method on every scene, and score everything from the files. Return a record per method.

    A cell that fails does not stop the others: its reason is in the record and its traceback in a log file.
    Raises UserError for scenes that are damaged or given twice, before any work begins.
    """
    if len({s.id for s in scenes}) < len(scenes):
        raise problem("scenes", "distinct scenes", ", ".join(s.id for s in scenes), "give each scene once")
    for method in methods:
        check_method_name(method.name)
    for scene in scenes:
        _check_inputs(scene)
    selection = select_metrics(settings.metrics)
    records = []
    with (
        locked(settings.out / ".lock", settings.out, "a folder that no other run uses"),
        RunDisplay(console, len(scenes) * len(methods)) as display,
    ):
        for method in methods:
            jobs = [Job(method, scene, settings.seed, settings.device, settings.budget) for scene in scenes]
            rows = [_run_cell(job, selection, settings.out, display) for job in jobs]
            for info, cells in zip(jobs[0].variants, zip(*rows, strict=True), strict=True):
                by_scene = {scene.id: cell for scene, cell in zip(scenes, cells, strict=True)}
                record = build_record(info, scenes, by_scene, settings.device)
                write_record(settings.out / "results" / f"{info.name}.json", record)
                records.append(record)
    return records


def _run_cell(job: Job, selection: Selection, out: Path, display: RunDisplay) -> list[Cell]:
    """Run or resume a job, and return the cells of its variants."""
    folders = [predictions_folder(out, variant.name, job.scene.id) for variant in job.variants]
    log = out / "logs" / f"{job.method.name}__{job.scene.id}.log"
    with display.cell(f"{job.method.name} on {job.scene.id}") as shown:
        try:
            if all(is_done(job, folder) for folder in folders):
                shown.note("predictions are there: scored from the files")
            else:
                model = out / "models" / job.method.name / f"{job.scene.id}.safetensors"
                run_job(job, folders, model, out / "work" / job.key[:16], shown.progress, shown.note)
            cells = [score_scene(open_for(folder, job.scene), job.scene, selection) for folder in folders]
            log.unlink(missing_ok=True)
        except Exception as e:  # whatever a method does wrong is its cell's failure, not the run's
            write_text(log, traceback.format_exc())
            if isinstance(e, WeightsError):
                missing = missing_cell("skipped", e.reason)  # records travel: no paths of this machine
            else:
                reason = str(e) if isinstance(e, UserError) else f"{type(e).__name__}: {e}"
                missing = missing_cell("failed", f"{reason} (see logs/{log.name})"[:2000])
            cells = [missing] * len(folders)
        for variant, cell in zip(job.variants, cells, strict=True):
            shown.note(f"{'' if variant == job.info else SUFFIX[1:] + ': '}{cell_summary(cell)}")
    return cells


def _check_inputs(scene: Scene) -> None:
    """Hash every file that the run will read. Raises UserError at the first damaged one."""
    if not scene.targets:
        raise problem(scene.root, "a scene with targets", "none in targets.json", "use a scene that has ground truth")
    _ = scene.training
    for t in scene.targets:
        scene.manifest.path(f"images/{t.name}.exr")
        scene.manifest.path(f"masks/{t.name}.png")
