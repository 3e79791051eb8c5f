"""Run methods on scenes: every method on every scene with every seed, a result record for each method and seed.

OUT/predictions/METHOD/SCENE/   the rendered images; a later run resumes by their content key alone
OUT/models/METHOD/SCENE.safetensors   the fitted model, for `render` and `view`
OUT/results/METHOD.json         the result records, scored from those files
OUT/logs/METHOD__SCENE.log      the traceback of a failed cell
OUT/work/KEY/                   the checkpoint of an unfinished fit
OUT/seed-K/                     the same for each further seed K

Cells are fitted here one after another, or by processes or the workers of a cluster in any order. Either way a fit may
have a process for itself (`apart`). This process writes and scores everything.
"""

from __future__ import annotations

import shutil
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from uuid import uuid4

from rich.console import Console

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import locked, remove_parts, write_text
from spike4dgs.benchmark.method import Budget, Method, no_progress
from spike4dgs.benchmark.metrics.measure import AUTO, Selection, select_metrics
from spike4dgs.benchmark.metrics.ssim_window import SSIM_WINDOW
from spike4dgs.benchmark.runs.apart.fit import Apart, fit_job
from spike4dgs.benchmark.runs.cell import Failure, Job, failure_of, is_done, why_not_kept
from spike4dgs.benchmark.runs.display import RunDisplay, ShownCell, cell_summary
from spike4dgs.benchmark.runs.executors import WORKERS_DIED, RunUnordered, check_workers, unordered_executor
from spike4dgs.benchmark.runs.predictions import open_predictions, read_info
from spike4dgs.benchmark.runs.record import (
    Cell,
    Record,
    build_record,
    check_method_name,
    check_scenes,
    missing_cell,
    with_earlier_scenes,
    write_record,
)
from spike4dgs.benchmark.runs.refinement import SUFFIX
from spike4dgs.benchmark.runs.remote_cell import SharedFolder, fit_order, make_order, store
from spike4dgs.benchmark.runs.score import open_for, score_scene
from spike4dgs.benchmark.scene.scene import Scene


@dataclass(frozen=True)
class Settings:
    """The settings that all cells of a run share."""

    out: Path
    seed: int = 0
    device: str = "cpu"
    budget: Budget = Budget()
    metrics: tuple[str, ...] = (AUTO,)
    seeds: int = 1  # seed, seed + 1, ...
    workers: int = 1
    scheduler: str | None = None
    refit: bool = False  # also where predictions are there
    typical_s: Mapping[str, float] = field(default_factory=dict)  # of fits by method, somewhere: their ratios count
    apart: Apart | None = None  # fits have a process each, which sees the training part alone; None: they see all
    refined: bool | None = None  # as of a job

    @property
    def spreads(self) -> bool:
        """Whether workers fit, several cells at once."""
        return self.workers != 1 or self.scheduler is not None

    def folder(self, seed: int) -> Path:
        """Return the folder that keeps what comes of a seed."""
        return self.out if seed == self.seed else self.out / f"seed-{seed}"


def split_folder(out: Path, split: str | None, scenes: Sequence[Scene]) -> Path:
    """Return the folder of a run: OUT/SPLIT of a split that is named and not the default of its scenes, else OUT."""
    return out / split if split and not all(scene.is_default_split for scene in scenes) else out


def predictions_folder(out: Path, method: str, scene: str) -> Path:
    """Return the folder in which a run keeps the predictions of a cell."""
    return out / "predictions" / method / scene


@dataclass(frozen=True)
class JobFiles:
    """A job, and where a run keeps what comes of it."""

    job: Job
    out: Path
    refit: bool = False
    apart: Apart | None = None

    @property
    def title(self) -> str:
        """The cell as people read it."""
        return f"{self.job.method.name} on {self.job.scene.id}, seed {self.job.seed}"

    @property
    def folders(self) -> list[Path]:
        """The predictions folders of the job's variants."""
        return [predictions_folder(self.out, variant.name, self.job.scene.id) for variant in self.job.variants]

    @property
    def model(self) -> Path:
        """The file of the fitted model."""
        return self.out / "models" / self.job.method.name / f"{self.job.scene.id}.safetensors"

    @property
    def work(self) -> Path:
        """The folder of the checkpoint."""
        return self.out / "work" / self.job.key[:16]

    @property
    def log(self) -> Path:
        """The file for the traceback of a failure."""
        return self.out / "logs" / f"{self.job.method.name}__{self.job.scene.id}.log"

    def is_done(self, shown: ShownCell) -> bool:
        """Return whether all predictions are there, whole and undamaged, and say what becomes of those that are."""
        if self.refit:
            shutil.rmtree(self.work, ignore_errors=True)
            shown.note("fitted anew (--refit)")
            return False
        if all(is_done(self.job, folder) for folder in self.folders):
            made = open_predictions(self.folders[0], self.job.scene.targets).info.created
            shown.note(f"kept: predictions of {made}, of the same method, code, settings, scene, seed and budget")
            return True
        if why := why_not_kept(self.job, self.folders[0]):
            shown.note(f"replaces predictions with {why}")
        return False


def run_matrix(
    scenes: Sequence[Scene], methods: Sequence[Method], settings: Settings, console: Console
) -> list[Record]:
    """Run, or resume, every method on every scene with every seed, and score everything from the files.

    Return a record per seed and method, in this order. A cell that fails does not stop the others: its reason is in the
    record and its traceback in a log file. Raises UserError for scenes that are damaged or given twice, before any work
    begins, and where the cluster cannot go on.
    """
    check_scenes(scenes)
    if settings.seeds < 1:
        raise problem("--seeds", "a number from 1 up", str(settings.seeds), "correct it")
    check_workers(settings.workers, settings.scheduler)
    for method in methods:
        check_method_name(method.name)
    for scene in scenes:
        check_inputs(scene)
    selection = select_metrics(settings.metrics)
    jobs = [
        JobFiles(
            Job(method, scene, seed, settings.device, settings.budget, settings.refined),
            settings.folder(seed),
            settings.refit,
            settings.apart,
        )
        for seed in range(settings.seed, settings.seed + settings.seeds)
        for method in methods
        for scene in scenes
    ]
    found: dict[int, list[Cell]] = {}
    records: dict[int, list[Record]] = {}
    kinds = [] if settings.spreads else [files.job.method.name for files in jobs]
    with (
        locked(settings.out / ".lock", settings.out, "a folder that no other run uses"),
        RunDisplay(console, len(jobs), kinds, settings.typical_s) as display,
    ):
        remove_parts(settings.out)
        for k, cells in run_cells(jobs, settings, selection, display):
            found[k] = cells
            first = k - k % len(scenes)  # of the cells of one record
            if all(n in found for n in range(first, first + len(scenes))):
                rows = [found[first + n] for n in range(len(scenes))]
                records[first] = _write_records(jobs[first], scenes, rows, settings)
    return [record for first in sorted(records) for record in records[first]]


def run_cells(
    jobs: Sequence[JobFiles], settings: Settings, selection: Selection, display: RunDisplay
) -> Iterator[tuple[int, list[Cell]]]:
    """Run or resume the cells, here or by workers. Yield their positions and the cells of their variants."""
    if settings.spreads:
        with unordered_executor(settings.workers, settings.scheduler) as run:
            yield from _spread(jobs, settings.out, run, selection, display)
    else:
        for k, files in enumerate(jobs):
            with display.cell(files.title) as shown:
                yield k, _settle(files, fit_here(files, shown), selection, shown)


def fit_here(files: JobFiles, shown: ShownCell) -> Failure | None:
    """Fit on this machine, or keep what is there; return the failure of the method, if it failed."""
    try:
        if not files.is_done(shown):
            fit_job(files.job, files.folders, files.model, files.work, shown.progress, shown.note, files.apart)
    except Exception as e:  # whatever a method does wrong is its cell's failure, not the run's
        return failure_of(e)
    return None


def _spread(
    jobs: Sequence[JobFiles], out: Path, run: RunUnordered, selection: Selection, display: RunDisplay
) -> Iterator[tuple[int, list[Cell]]]:
    """Fit by workers. While they work, the cells that need none are scored."""
    folder = SharedFolder(out.absolute(), uuid4().hex)
    write_text(folder.token_file, folder.token)
    settled: dict[int, Failure | None] = {}
    orders, notes = {}, defaultdict[int, list[str]](list)
    for k, files in enumerate(jobs):
        try:
            if files.is_done(ShownCell(no_progress, notes[k].append)):
                settled[k] = None
            else:
                orders[k] = make_order(files.job, folder, files.work, files.apart)
        except Exception as e:  # a method that cannot travel
            settled[k] = failure_of(e)
    arrivals = run(fit_order, list(orders.values()))
    display.say(f"{len(orders)} cells go to workers and appear as they come back")
    for k, failure in settled.items():
        with display.cell(jobs[k].title, notes[k]) as shown:
            yield k, _settle(jobs[k], failure, selection, shown)
    sent = list(orders)
    for position, result in arrivals:
        k = sent[position]
        with display.cell(jobs[k].title, notes[k]) as shown:
            if result == WORKERS_DIED:
                result = Failure("failed", "its workers died one after another (out of memory?)", WORKERS_DIED)
            if not isinstance(result, Failure):
                store(result, jobs[k].folders, jobs[k].model)
                for line in result.notes:
                    shown.note(line)
            failure = result if isinstance(result, Failure) else None
            yield k, _settle(jobs[k], failure, selection, shown)


def _settle(files: JobFiles, failure: Failure | None, selection: Selection, shown: ShownCell) -> list[Cell]:
    """Score what a cell left, or write why there is nothing. Return the cells of the job's variants."""
    job, log = files.job, files.log
    if failure is None:
        try:
            cells = [score_scene(open_for(folder, job.scene), job.scene, selection) for folder in files.folders]
            log.unlink(missing_ok=True)
        except Exception as e:  # such as damaged images
            failure = failure_of(e)
    if failure is not None:
        write_text(log, failure.traceback)
        seen = f" (see logs/{log.name})" if failure.status == "failed" else ""
        cells = [missing_cell(failure.status, f"{failure.reason}{seen}"[:2000])] * len(job.variants)
    for variant, cell in zip(job.variants, cells, strict=True):
        shown.note(f"{'' if variant == job.info else SUFFIX[1:] + ': '}{cell_summary(cell)}")
    return cells


def _write_records(
    files: JobFiles, scenes: Sequence[Scene], rows: Sequence[Sequence[Cell]], settings: Settings
) -> list[Record]:
    """Write the records of a method's variants with the seed of `files`; `rows` has their cells of each scene."""
    records = []
    device = settings.device if settings.scheduler is None else "cpu"  # of this process, which scored
    for info, cells in zip(files.job.variants, zip(*rows, strict=True), strict=True):
        by_scene = {scene.id: cell for scene, cell in zip(scenes, cells, strict=True)}
        record = build_record(info, scenes, by_scene, device)
        path = files.out / "results" / f"{info.name}.json"
        record = with_earlier_scenes(record, path, partial(_is_same_fit, files, info.name))
        write_record(path, record)
        records.append(record)
    return records


def _is_same_fit(files: JobFiles, method: str, scene: str, revision: str) -> bool:
    """Return whether the predictions of a variant that a run keeps of another scene are of the job's fit."""
    try:
        return read_info(predictions_folder(files.out, method, scene)).key == files.job.key_on(scene, revision)
    except UserError:
        return False


def check_inputs(scene: Scene) -> None:
    """Hash every file that the run will read. Raises UserError at the first damaged one."""
    if not scene.targets:
        raise problem(scene.root, "a scene with targets", "none in targets.json", "use a scene that has ground truth")
    if (side := min(min(c.width, c.height) for c in scene.cameras.values())) < SSIM_WINDOW:
        raise problem(scene.root, f"views of {SSIM_WINDOW} pixels or more each way", f"{side}", "use larger views")
    _ = scene.training
    for t in scene.targets:
        scene.manifest.path(f"images/{t.name}.exr")
        scene.manifest.path(f"masks/{t.name}.png")
