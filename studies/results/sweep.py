"""Fit and score the cells of the plan, and keep a record of each.

OUT/CODE/predictions/METHOD/SCENE/, OUT/CODE/work/ and so on are as `run-benchmark` keeps them, for each digest CODE of
the methods' code: what a killed sweep had fitted is found again by the same code alone. Cells with a record are done.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from rich.console import Console

from spike4dgs.benchmark.environment import cpu_name
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import locked, remove_parts
from spike4dgs.benchmark.method import Method, get_method, make_budget
from spike4dgs.benchmark.metrics.measure import select_metrics
from spike4dgs.benchmark.runs.apart.fit import Apart
from spike4dgs.benchmark.runs.cell import Job
from spike4dgs.benchmark.runs.display import RunDisplay
from spike4dgs.benchmark.runs.refinement import SUFFIX as REFINED
from spike4dgs.benchmark.runs.refinement import is_refined
from spike4dgs.benchmark.runs.run import JobFiles, Settings, check_inputs, run_cells
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.leaderboard.reading import typical_fit_seconds
from spike4dgs.studies.results.code_state import CodeState, code_digest
from spike4dgs.studies.results.plan import CEILING, Cell, knowledge_of
from spike4dgs.studies.results.records import (
    DIGITS,
    FAILED,
    METRICS,
    Key,
    Record,
    key_of,
    read_records,
    scores_of,
    short,
    with_finite,
    write_row,
)
from spike4dgs.studies.results.scenes import revisions_of
from spike4dgs.studies.results.tables.ceilings import measure_ceiling
from spike4dgs.studies.results.tables.images import SUFFIX as IMAGES
from spike4dgs.studies.results.tables.images import measure_images
from spike4dgs.studies.sensors import bits_per_second, sensors_of

DEVICE = "cpu"  # of every published number


@dataclass(frozen=True)
class SweepSettings:
    """Where a sweep reads and writes, and how long it goes on."""

    scenes_of: Path  # the folder that holds the scene folders
    records: Path
    out: Path
    workers: int = 1
    limit_hours: float | None = None
    quiet: bool = False

    def is_over(self, start: float) -> bool:
        """Return whether the hours of a sweep that began at `start` (monotonic) are over."""
        return self.limit_hours is not None and time.monotonic() - start > 3600 * self.limit_hours


@dataclass(frozen=True)
class Outcome:
    """Cells that a sweep left: how many have no record, and a line for each that failed. Skipped ones are neither.

    Among the failed are those that a quiet pass did not fit again, skipped or not.
    """

    left: int
    failed: tuple[str, ...]


def sweep(
    cells: Sequence[Cell], methods: Mapping[str, Method], state: CodeState, settings: SweepSettings, console: Console
) -> Outcome:
    """Measure the cells that have no record yet, in their order.

    In a quiet pass those whose record is of a busy one are fitted again, for their times. A cell that fails keeps the
    metrics that it had, or has a record that says why, and is tried again by the next sweep. Raises UserError for
    damaged scenes, where another sweep runs, and where the code changes meanwhile.
    """
    if settings.quiet and settings.workers > 1:
        raise problem("--quiet", "one worker, which has the machine to itself", "--workers", "leave one of them out")
    scenes = _open(cells, settings.scenes_of, console)
    with ExitStack() as held:
        for folder in (settings.records, settings.out):
            lock = folder / ".lock"
            held.enter_context(locked(lock, folder, "a folder that no other sweep uses", temporary=True))
            remove_parts(folder)
        records = read_records(settings.records)
        each = {scene.id: scene for scene in scenes.values()}
        revisions = revisions_of(each.values(), records.values(), settings.records, console)
        here = [cell for cell in cells if _place(cell) in scenes]
        todo = [cell for cell in here if not _is_done(records.get(_key(cell)), settings.quiet)]
        console.print(f"{len(cells)} cells planned, {len(here) - len(todo)} measured, {len(todo)} to measure")
        codes = {name: code_digest(name) for name in dict.fromkeys(cell.row for cell in here)}
        _say_other_code(here, records, codes, console)
        kept, start = _Kept(scenes, revisions, codes, state, settings, records), time.monotonic()
        for cell in (cell for cell in todo if _needs_no_fit(cell.row)):
            scene = scenes[_place(cell)]
            kept.keep(cell, measure_ceiling(scene) if cell.row == CEILING else measure_images(cell.row, scene))
            if settings.is_over(start):
                break
        else:
            _measure([cell for cell in todo if not _needs_no_fit(cell.row)], methods, kept, start, console)
        if settings.is_over(start):
            console.print(f"--limit-hours {settings.limit_hours:g}: no further cell is begun")
        failed = [r for r in map(records.get, map(_key, here)) if r and (r["error"] or "").startswith(FAILED)]
        left = sum(_key(cell) not in records for cell in cells)
        return Outcome(left, (*map(_failure, failed), *kept.spared))


def _open(cells: Iterable[Cell], folder: Path, console: Console) -> dict[tuple[str, str], Scene]:
    """Open the scenes of the plan that are there, in each split, and check what a fit reads of them."""
    scenes: dict[tuple[str, str], Scene] = {}
    wanted = dict.fromkeys(map(_place, cells))
    for name, split in wanted:
        if (folder / name).is_dir():
            scenes[name, split] = open_scene(folder / name, allow_gaps=True, split=split)
            check_inputs(scenes[name, split])
    if not scenes:
        fix = "spike4dgs make-dataset --track ideal --out DIR, and --scenes-of DIR"
        first = next((name for name, _ in wanted), "car-0-small")
        raise problem(folder, f"scenes of the plan, such as {first}", "none", fix)
    if missing := dict.fromkeys(name for name, split in wanted if (name, split) not in scenes):
        console.print(f"not in {folder}, left out: {', '.join(missing)}")
    return scenes


def _place(cell: Cell) -> tuple[str, str]:
    return cell.scene, cell.split


def _needs_no_fit(row: str) -> bool:
    return row.endswith(IMAGES) or row == CEILING


def _key(cell: Cell) -> Key:
    return cell.row, cell.scene, cell.seed, make_budget(cell.budget).label, cell.split


def _is_done(record: Record | None, quiet: bool) -> bool:
    if record is None or record["error"] is not None:
        return False
    return record["quiet"] or not quiet or record["row"] == CEILING  # a ceiling has no times


def _failure(record: Record) -> str:
    return f"{record['row']} on {record['scene']}, seed {record['seed']}: {record['error']}"


def _say_other_code(
    cells: Iterable[Cell], records: Mapping[Key, Record], codes: Mapping[str, str], console: Console
) -> None:
    kept = {r["row"] for r in map(records.get, map(_key, cells)) if r and r["code"] != codes[r["row"]]}
    if kept:
        names = ", ".join(sorted(kept))
        console.print(f"kept, measured by other code: {names}; remove a row's file to measure it anew", markup=False)


@dataclass(frozen=True)
class _Kept:
    """What is known of the cells, and their records so far. `spared`: failures that left a record as it was."""

    scenes: Mapping[tuple[str, str], Scene]  # by id and split
    revisions: Mapping[str, str]
    codes: Mapping[str, str]
    state: CodeState
    settings: SweepSettings
    records: dict[Key, Record]
    spared: list[str] = field(default_factory=list)

    def keep(self, cell: Cell, measured: Record) -> None:
        """Write a measured cell into its row's file and into `records`; a failure takes the place of no metrics.

        Raises UserError where the code is no longer what was to be measured.
        """
        if (found := code_digest(cell.row)) != self.codes[cell.row]:
            fix = "start again; a sweep needs a checkout that nobody edits"
            raise problem("the methods' code", self.codes[cell.row], f"{found}: it changed meanwhile", fix)
        revision, own = self.revisions[cell.scene], self.scenes[_place(cell)].revision[:DIGITS]
        record: Record = {
            "row": cell.row,
            "scene": cell.scene,
            "revision": revision,
            **({"equivalent": own} if own != revision else {}),
            "seed": cell.seed,
            "budget": make_budget(cell.budget).label,
            "split": cell.split,
            "commit": self.state.commit,
            **({"dirty": True} if self.state.dirty else {}),
            "code": found,
            "tuned_on": cell.tuned_on,
            **with_finite(measured),
            "quiet": self.settings.quiet,
            "cpu": cpu_name(),
        }
        before = self.records.get(key_of(record))
        if record["error"] is not None and before is not None and before["error"] is None:
            self.spared.append(f"{_failure(record)}; its earlier record stays")
            return
        self.records[key_of(record)] = record
        write_row(self.settings.records, cell.row, self.records.values())


def _measure(todo: Sequence[Cell], methods: Mapping[str, Method], kept: _Kept, start: float, console: Console) -> None:
    """Fit and score the cells, and keep each at once, until the hours that began at `start` are over."""
    settings = kept.settings
    jobs = [
        JobFiles(
            Job(
                get_method(cell.row.removesuffix(REFINED), methods),
                kept.scenes[_place(cell)],
                cell.seed,
                DEVICE,
                make_budget(cell.budget),
                refined=is_refined(cell.row),
            ),
            settings.out / kept.codes[cell.row] / f"{cell.budget}-{cell.split}" / f"seed-{cell.seed}",
            settings.quiet,  # its times are of one whole fit
            Apart(),
        )
        for cell in todo
    ]
    selection = select_metrics().among(METRICS)
    shared = Settings(settings.out, workers=settings.workers)
    with RunDisplay(console, len(jobs), [cell.row for cell in todo], typical_fit_seconds()) as display:
        for k, scored in run_cells(jobs, shared, selection, display):
            job = jobs[k].job
            kept.keep(
                todo[k],
                {
                    "knowledge": knowledge_of(job.method),
                    "bits_per_second": short(bits_per_second(job.scene, sensors_of(job.method))),
                    **scores_of(scored[-1 if job.refined else 0]),
                },
            )
            if settings.is_over(start):
                return
