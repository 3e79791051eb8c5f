"""`run-benchmark`: run methods on scenes, then write the table, the images and the leaderboard's entries.

OUT has the layout of `benchmark.reports.benchmark`, with leaderboard/ and, for a table of the paper, table.*. A run on
another split than the default keeps all this in OUT/SPLIT/, and so does a table that compares splits.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import OmitArgPrefixes, Positional

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import check_writable
from spike4dgs.benchmark.method import (
    DEFAULT_BUDGET,
    Method,
    choose_device_for,
    find_methods,
    get_method,
    make_budget,
    with_settings,
)
from spike4dgs.benchmark.metrics.measure import AUTO, select_metrics
from spike4dgs.benchmark.release.scenes import track_folders
from spike4dgs.benchmark.reports.benchmark import SplitRun, run_split
from spike4dgs.benchmark.reports.console import Columns, make_console
from spike4dgs.benchmark.reports.paper_files import in_every_split, write_paper_table
from spike4dgs.benchmark.reports.paper_tables import (
    POSES,
    PublishedTable,
    over_seeds,
    published,
    table_scenes,
)
from spike4dgs.benchmark.runs.apart.fit import Apart
from spike4dgs.benchmark.runs.record import Record, of_scenes
from spike4dgs.benchmark.runs.refinement import SUFFIX
from spike4dgs.benchmark.runs.run import Settings, split_folder
from spike4dgs.benchmark.scene.scene import open_scene, open_scenes
from spike4dgs.cli.options import From, SetValues
from spike4dgs.cli.submit import submit_all
from spike4dgs.leaderboard.entry import check_folder
from spike4dgs.leaderboard.reading import typical_fit_seconds
from spike4dgs.leaderboard.tracks import is_equivalent, release_line, track_scenes

_NEEDS = {"profile": ("table",), "data": ("table", "track"), "source": ("track",)}  # what they do nothing without

# What makes a track's scenes, where `make-dataset` has no track of its name.
_MADE = {
    "quick-start": "car turntable --profile small",
    "no-flat-field": "--track ideal",
    "uncalibrated": "--track ideal",
}


@dataclass(frozen=True)
class SceneChoice:
    """Which scenes, and how they are split.

    Args:
        table: Instead of scenes, a table of the paper: 1 (outdoor), 2 (objects), 3 (components), 4 (supervision), 5
            (number of views; plotted in views.png), 7 (MSDI without SPSS).
        poses: For table 1 or 2: given (methods get the rig's poses) or estimated (each estimates its own).
        track: Instead of scenes, a track such as ideal. Its scenes are read from DATA, and missing ones are
            downloaded.
        source: Where the release with the track's scenes is; SPIKE4DGS_RELEASE if left out.
        data: Folder of the table's or track's scenes.
        profile: Profile of the table's scenes.
        split: Training views and held-out views, such as corner or views-3; each scene's default if left out.
        allow_gaps: Accept recordings with gaps.
    """

    table: int | None = None
    poses: str = POSES[0]
    track: str | None = None
    source: From = None
    data: Path = Path("data")
    profile: str = "small"
    split: str | None = None
    allow_gaps: bool = False


@dataclass(frozen=True)
class FitChoice:
    """How methods are fitted and scored.

    Args:
        methods: Names of methods; all installed ones, or all rows of the table, if left out.
        settings: Other settings, such as trainer.lr_means=0.0002. Rows include them in their names, and stay off public
            tracks.
        out: Folder for predictions, results, images and logs; OUT/SPLIT for another split than the default.
        seed: Seed of every fit.
        seeds: Number of seeds, counted up from --seed. The table shows means over them; files of a further seed K
            are in OUT/seed-K.
        workers: Number of fitting processes, each on its share of this machine's cores.
        scheduler: Address of a dask.distributed scheduler, tcp://HOST:PORT, whose workers fit. They read the scenes
            at the same paths.
        device: auto, cpu or cuda. auto depends on this machine, even for the workers of a scheduler.
        budget: quick, standard (4 times the steps), paper (each publication's steps), or a multiple of quick.
        metrics: auto (all that this machine can compute), or ids such as lpips_vgg. PSNR, SSIM and the temporal
            error are always computed.
        refit: Fit again even if OUT has predictions of the same method, code, settings, scene, seed and budget.
        in_process: Fit in the benchmark's process, for debuggers. By default, each fit has a separate process that is
            given only the training part of its scene.
        columns: Columns of the table on the terminal: short, or all metrics and costs. results.csv has all.
    """

    methods: tuple[str, ...] = ()
    settings: SetValues = ()
    out: Path = Path("runs/benchmark")
    seed: int = 0
    seeds: int = 1
    workers: int = 1
    scheduler: str | None = None
    device: str = "auto"
    budget: str = DEFAULT_BUDGET
    metrics: tuple[str, ...] = (AUTO,)
    refit: bool = False
    in_process: bool = False
    columns: Columns = "short"


@dataclass(frozen=True)
class EntryChoice:
    """Where the records are entered.

    Args:
        leaderboard: Leaderboard folder to submit to; OUT/leaderboard if left out.
        replace: Replace entries of the same name in that leaderboard, unless they are verified better.
    """

    leaderboard: Path | None = None
    replace: bool = False


def run_benchmark(
    scenes: Positional[tuple[Path, ...]] = (),
    *,
    choice: OmitArgPrefixes[SceneChoice] = SceneChoice(),
    fits: OmitArgPrefixes[FitChoice] = FitChoice(),
    entries: OmitArgPrefixes[EntryChoice] = EntryChoice(),
) -> int:
    """Fit methods on scenes, score them, and enter them into a leaderboard. A killed run resumes where it stopped.

    Running other methods on the same scenes with the same --out, budget and kind of device adds them to the table and
    the sheets.

    Args:
        scenes: Scene folders.
    """
    if choice.poses != POSES[0] and choice.table is None:
        fix = "name the methods, such as tfp+colmap+4dgs"
        raise problem("--poses", "--table 1 or 2 beside it", "no table", fix)
    if choice.track is not None and (scenes or choice.table is not None):
        found = str(scenes[0]) if scenes else f"--table {choice.table}"
        raise problem("--track", "neither scenes nor a table beside it", found, "use --data for the folder")
    default = SceneChoice()
    for name, needed in _NEEDS.items():
        if getattr(choice, name) != getattr(default, name) and all(getattr(choice, other) is None for other in needed):
            option = "--from" if name == "source" else f"--{name}"
            expected = f"{' or '.join(f'--{other}' for other in needed)} beside it"
            raise problem(option, expected, "none", f"leave {option} out")
    if entries.leaderboard is not None:  # before the fits
        check_folder(entries.leaderboard)
        check_writable(entries.leaderboard)
    paper = None if choice.table is None else published(choice.table, choice.poses)
    if paper:
        if scenes:
            raise problem("--table", "no scene folders beside it", str(scenes[0]), "use --data and --profile")
        return _run_table(paper, choice, fits, entries)
    if choice.track is not None:
        options = _MADE.get(choice.track, f"--track {choice.track}")
        made = f"spike4dgs make-dataset {options} --out {shlex.quote(str(choice.data))}"
        scenes = track_folders(track_scenes(choice.track), choice.data, choice.source, is_equivalent, made)
    runs = _run(scenes, _choose_methods(fits, None), (choice.split,), choice.allow_gaps, fits)
    return _finish(runs, scenes, choice.allow_gaps, entries)


def _run_table(paper: PublishedTable, choice: SceneChoice, fits: FitChoice, entries: EntryChoice) -> int:
    """Run the rows of a table of the paper, and write it with the published values."""
    scenes = table_scenes(paper, choice.data, choice.profile)
    splits = paper.splits if paper.splits and choice.split is None else (choice.split,)
    runs = _run(scenes, _choose_methods(fits, paper), splits, choice.allow_gaps, fits)
    rows = [[*(r for r in run.earlier if plain_name(r) in paper.rows), *run.records] for run in runs]
    shown = []
    for run, records in zip(runs, rows, strict=True):
        ids = {scene.id for scene in run.scenes}  # not those of earlier runs
        shown.append((run.scenes, over_seeds([of_scenes(record, ids) for record in records])))
    folder = fits.out if len(runs) > 1 else runs[0].settings.out
    worlds = {path.name: world for path, world in zip(scenes, paper.worlds, strict=True)}
    write_paper_table(paper, in_every_split(shown), worlds, select_metrics(fits.metrics).metrics, folder)
    text = f"table {paper.number}: {folder}/table.md, .csv, .tex, .json"
    make_console().print(text, highlight=False, markup=False)
    return _finish(runs, scenes, choice.allow_gaps, entries)


def _run(
    scenes: Sequence[Path],
    methods: Sequence[Method],
    splits: Sequence[str | None],
    allow_gaps: bool,
    fits: FitChoice,
) -> list[SplitRun]:
    """Run methods on scenes with each split; in OUT, or in OUT/SPLIT where it is not the scenes' default."""
    device = fits.device
    if fits.scheduler is None or device == "auto":
        device = choose_device_for(methods, device)
    budget, console, runs = make_budget(fits.budget), make_console(), list[SplitRun]()
    every = [open_scenes(scenes, allow_gaps, split) for split in splits]  # what lacks a split says so before the fits
    for split, opened in zip(splits, every, strict=True):
        if not runs and (line := release_line(opened)):
            console.print(line, highlight=False, markup=False)
        out = split_folder(fits.out, split, opened)
        chosen = (fits.metrics, fits.seeds, fits.workers, fits.scheduler, fits.refit)
        apart = None if fits.in_process else Apart()
        settings = Settings(out, fits.seed, device, budget, *chosen, typical_fit_seconds(), apart)
        runs.append(run_split(opened, methods, settings, console, fits.columns))
    return runs


def _choose_methods(fits: FitChoice, paper: PublishedTable | None) -> list[Method]:
    """Return the methods by name, with the settings of --set; without names the table's rows, or all installed ones."""
    known = find_methods()
    names = fits.methods or (tuple(m for m in paper.rows if m in known) if paper else ())
    if not known:
        raise problem("--methods", "an installed method", "none", "install a package that registers one")
    methods = [get_method(name, known) for name in dict.fromkeys(names or known)]
    return [with_settings(method, fits.settings) for method in methods]


def _finish(runs: Sequence[SplitRun], scenes: tuple[Path, ...], allow_gaps: bool, entries: EntryChoice) -> int:
    """Submit every record, and name the cells that failed; return the exit code. What is refused stays in OUT."""
    refused, failed = 0, []
    for run in runs:
        names = [(run.settings.folder(r["method"]["seed"]), r["method"]["name"]) for r in run.records]
        folders = {out / "results" / f"{name}.json": out / "predictions" / name for out, name in names}
        refused += submit_all(
            {result: folder if folder.is_dir() else None for result, folder in folders.items()},
            scenes=_with_neighbours(scenes, run, allow_gaps),
            leaderboard=entries.leaderboard or run.settings.out / "leaderboard",
            replace=entries.replace or entries.leaderboard is None,
            allow_gaps=allow_gaps,
        )
        make_console().print(
            f"ranking among the published entries: spike4dgs leaderboard --runs {shlex.quote(str(run.settings.out))}",
            highlight=False,
            markup=False,
        )
        ids = [scene.id for scene in run.scenes]  # not those that the records keep of earlier runs
        cells = [(r["method"], scene, r["scenes"][scene]["status"]) for r in run.records for scene in ids]
        failed += [f"{m['name']} on {scene}, seed {m['seed']}" for m, scene, status in cells if status == "failed"]
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed or refused else 0


def _with_neighbours(scenes: tuple[Path, ...], run: SplitRun, allow_gaps: bool) -> tuple[Path, ...]:
    """Return scene folders and, of the scenes that records keep of earlier runs, those that lie unchanged beside."""
    given = {s.id for s in run.scenes}
    of_all = [(scene, r["dataset"]) for r in run.records for scene in r["scenes"] if scene not in given]
    kept = {(scene, of["scenes"][scene], of["split"]) for scene, of in of_all}
    data = scenes[0].parent
    found = {data / scene for scene, revision, split in kept if _is_there(data / scene, revision, split, allow_gaps)}
    return (*scenes, *sorted(found))


def _is_there(path: Path, revision: str, split: str, allow_gaps: bool) -> bool:
    try:
        return open_scene(path, allow_gaps, split).revision == revision
    except UserError:
        return False


def plain_name(record: Record) -> str:
    """Return the name of a record's method, without the mark of refined held-out views."""
    return str(record["method"]["name"]).removesuffix(SUFFIX)
