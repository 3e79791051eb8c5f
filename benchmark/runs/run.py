"""`run-benchmark`: every method on every scene, then scores, table, images and leaderboard entries.

OUT/predictions/METHOD/SCENE/   what was rendered: the only thing a later run resumes by (its content key)
OUT/models/METHOD/SCENE.safetensors   the fitted model, for `render` and `view`
OUT/results/METHOD.json         the result records, scored from those files
OUT/logs/METHOD__SCENE.log      the traceback of a failed cell
OUT/work/KEY/                   the checkpoint of an unfinished fit
OUT/sheet_SCENE.png, OUT/scatter.png, OUT/leaderboard/

A run on another split than the default one keeps all this in OUT/SPLIT/, and so does a table that compares splits.
"""

from __future__ import annotations

import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from tyro.conf import Positional

from spike4dgs.benchmark.runs.cell import Job, is_done, run_job
from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import write_text
from spike4dgs.benchmark.locks import locked
from spike4dgs.benchmark.reports.paper_files import write_paper_table
from spike4dgs.benchmark.method import Budget, Method, find_methods, make_budget
from spike4dgs.benchmark.results.refinement import SUFFIX
from spike4dgs.benchmark.reports.figures import cell_summary, make_console, results_table, write_scatter, write_sheet
from spike4dgs.benchmark.results.record import Cell, Record, build_record, check_method_name, missing_cell, write_record
from spike4dgs.benchmark.runs.display import RunDisplay
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.benchmark.results.score import open_for, score_scene
from spike4dgs.benchmark.scene.scene import open_scenes
from spike4dgs.benchmark.metrics.selection import AUTO, Selection, select_metrics
from spike4dgs.benchmark.reports.paper_tables import IMAGE_TABLE, TRACKS, published, table_scenes
from spike4dgs.benchmark.weights import WeightsError


@dataclass(frozen=True)
class Settings:
    """What all cells of a run share."""

    out: Path
    seed: int = 0
    device: str = "cpu"
    budget: Budget = Budget()
    metrics: tuple[str, ...] = (AUTO,)


def predictions_folder(out: Path, method: str, scene: str) -> Path:
    """Where a run keeps the predictions of a cell."""
    return out / "predictions" / method / scene


def run_matrix(
    scenes: Sequence[Scene], methods: Sequence[Method], settings: Settings, console: Console
) -> list[Record]:
    """Run, or resume, every method on every scene, and score everything from the files. One record per method.

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
    """The cells of the job's variants."""
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


def run_benchmark(
    scenes: Positional[tuple[Path, ...]] = (),
    *,
    table: int | None = None,
    track: str = TRACKS[0],
    data: Path = Path("data"),
    profile: str = "small",
    methods: tuple[str, ...] = (),
    out: Path = Path("runs/benchmark"),
    seed: int = 0,
    device: str = "auto",
    budget: str = "quick",
    metrics: tuple[str, ...] = (AUTO,),
    split: str | None = None,
    leaderboard: Path | None = None,
    replace: bool = False,
    allow_gaps: bool = False,
) -> int:
    """Fit methods on scenes, score them, and enter them into a leaderboard. A killed run resumes where it was.

    Args:
        scenes: Scene folders.
        table: Instead of scenes, a table of the paper: 1 (outdoor), 2 (objects), 3 (components), 4 (supervision), 5
            (number of views; drawn as views.png), 6 (images from spikes), 7 (MSDI without SPSS).
        track: Of table 1 or 2: calibrated (methods are given the rig's poses) or uncalibrated (each estimates its own).
        data: Folder of the table's scenes.
        profile: Profile of the table's scenes.
        methods: Methods by name; all that are installed, or all rows of the table, if left out.
        out: Folder for predictions, results, images and logs; for another split than the default, OUT/SPLIT is.
        seed: Seed that every fit gets.
        device: auto, cpu or cuda.
        budget: quick, standard (4 times the steps), paper (each publication's steps), or a multiple of quick.
        metrics: auto (all that this machine can compute), or ids such as lpips_vgg. PSNR, SSIM and the temporal error
            are always computed.
        split: Training views and held-out views, such as corner or views-3; each scene's default if left out.
        leaderboard: Leaderboard folder to submit to; OUT/leaderboard if left out.
        replace: Replace entries of the same name in that leaderboard.
        allow_gaps: Accept recordings with gaps.
    """
    if track != TRACKS[0] and table in (None, IMAGE_TABLE):
        fix = "without a table, name the methods, such as tfp+colmap+4dgs"
        raise problem("--track", "--table 1 or 2 beside it", f"--table {table}" if table else "no table", fix)
    if table == IMAGE_TABLE:
        return _image_table(scenes, data, profile, out, allow_gaps)
    paper = None if table is None else published(table, track)
    if paper and scenes:
        raise problem("--table", "no scene folders beside it", str(scenes[0]), "use --data and --profile")
    scenes = table_scenes(paper, data, profile) if paper else scenes
    known = find_methods()
    methods = methods or (tuple(m for m in paper.rows if m in known) if paper else ())
    if unknown := [m for m in methods if m not in known]:
        raise problem("--methods", f"names among {', '.join(sorted(known))}", ", ".join(unknown), "correct the names")
    if not known:
        raise problem("--methods", "an installed method", "none", "install a package that registers one")
    chosen = [known[name] for name in dict.fromkeys(methods or known)]
    console, place = make_console(), (seed, choose_device(device), make_budget(budget), metrics)
    splits = paper.splits if paper and paper.splits and split is None else (split,)
    runs, refused = [], False
    for name in splits:
        opened = open_scenes(scenes, allow_gaps, name)
        folder = out / name if name and not all(s.is_default_split for s in opened) else out
        settings = Settings(folder, *place)
        records = run_matrix(opened, chosen, settings, console)
        console.print(results_table(records))
        write_images(opened, records, folder)
        _say(console, f"images: {folder}/sheet_*.png and {folder}/scatter.png")
        refused |= _submit(records, scenes, settings, leaderboard, replace)
        runs.append((opened, records))
    if paper:
        folder = out if len(runs) > 1 else folder
        worlds = {path.name: world for path, world in zip(scenes, paper.worlds, strict=True)}
        write_paper_table(paper, runs, worlds, select_metrics(metrics).metrics, folder)
        _say(console, f"table {paper.number}: {folder}/table.md, .csv, .tex, .json")
    every = [r for _, records in runs for r in records]
    cells = [(f"{r['method']['name']} on {s}", c["status"]) for r in every for s, c in r["scenes"].items()]
    failed = [name for name, status in cells if status == "failed"]
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed or refused else 0


def _say(console: Console, text: str) -> None:
    console.print(text, highlight=False, markup=False)


def _image_table(scenes: tuple[Path, ...], data: Path, profile: str, out: Path, allow_gaps: bool) -> int:
    """Table 6 compares images, not methods: the command `speed images` measures it."""
    from spike4dgs.benchmark.cli import load_speed

    worlds = [world for number in (1, 2) for world in published(number).worlds]
    chosen = scenes or tuple(p for world in worlds if (p := data / f"{world}-0-{profile}").is_dir())
    if not chosen:
        fix = f"spike4dgs make-dataset --all --profile {profile} --out {data}"
        raise problem(data, f"a scene WORLD-0-{profile}", "none", fix)
    gaps = ["--allow-gaps"] if allow_gaps else []
    return int(load_speed("images")([*map(str, chosen), "--out", str(out), *gaps]))


def write_images(scenes: Sequence[Scene], records: Sequence[Record], out: Path) -> None:
    """Write sheet_SCENE.png for each scene, and scatter.png."""
    for scene in scenes:
        folders = {r["method"]["name"]: predictions_folder(out, r["method"]["name"], scene.id) for r in records}
        write_sheet(out / f"sheet_{scene.id}.png", scene, folders, records)
    write_scatter(out / "scatter.png", records)


def _submit(
    records: Sequence[Record], scenes: tuple[Path, ...], settings: Settings, leaderboard: Path | None, replace: bool
) -> bool:
    """Submit every record. True where the leaderboard refused one: the run's results stand all the same."""
    from spike4dgs.benchmark.cli import load  # the leaderboard is another room: only the command line knows it

    submit, refused = load("submit"), False
    for name in (r["method"]["name"] for r in records):
        predictions = settings.out / "predictions" / name
        try:
            submit(
                settings.out / "results" / f"{name}.json",
                predictions=predictions if predictions.is_dir() else None,
                scenes=scenes,
                leaderboard=leaderboard or settings.out / "leaderboard",
                replace=replace or leaderboard is None,
            )
        except UserError as e:
            print(f"error: {e}", file=sys.stderr)
            refused = True
    return refused
