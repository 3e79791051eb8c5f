"""`report oracle-ladder`: a method as it is, and the same with one thing replaced by the truth or one limit removed.

OUT/truth/   what the oracles are given, rendered from the scene's own generator; kept for the next run
OUT/ladder.md, ladder.csv, ladder_METHOD.png   what each rung gains; the rest is as `run-benchmark` keeps it

What oracles hand to a fit is no part of a scene, so no other fit can meet it; their records say `oracle`, and no
leaderboard takes them.
"""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from tyro.conf import Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import write_text
from spike4dgs.benchmark.method import DEFAULT_BUDGET, choose_device_for, make_budget
from spike4dgs.benchmark.metrics.measure import AUTO, mean
from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.benchmark.reports.figure import new_figure, save_figure
from spike4dgs.benchmark.runs.display import RunDisplay
from spike4dgs.benchmark.runs.record import Record
from spike4dgs.benchmark.runs.run import Settings, run_matrix, split_folder
from spike4dgs.benchmark.scene.scene import Scene, open_scenes
from spike4dgs.studies.kit.timing import markdown, write_csv
from spike4dgs.studies.oracle_methods import Ladder, oracle_ladders
from spike4dgs.studies.oracle_truth import Truth, WorldTruth, find_truth

SAMPLES = 128  # of a pixel of the true images: their noise is then a third of that of images from spikes
MEAN = "mean"
COLUMNS = {"psnr": "PSNR, dB", "psnr_dynamic": "PSNR where things move, dB", "fit_seconds": "fit, s"}
_GAINS = ("psnr", "psnr_dynamic")  # columns that are compared with the fit as it is
Values = dict[str, float | None]  # by column


def oracle_ladder(
    scenes: Positional[tuple[Path, ...]],
    *,
    methods: tuple[str, ...] = (),
    samples: int = SAMPLES,
    out: Path = Path("runs/oracle"),
    seed: int = 0,
    seeds: int = 1,
    workers: int = 1,
    scheduler: str | None = None,
    device: str = "auto",
    budget: str = DEFAULT_BUDGET,
    metrics: tuple[str, ...] = (AUTO,),
    split: str | None = None,
    allow_gaps: bool = False,
) -> int:
    """Fit recipes as they are, then with one thing replaced by the truth or one limit removed: what does each gain?

    The rungs are the true images, points, velocities or calibration, more Gaussians, and more steps. OUT gets
    ladder.md, ladder.csv and ladder_METHOD.png. A killed run resumes: give the same command again.

    Args:
        scenes: Scene folders of `make-dataset`: their training cameras are rendered again.
        methods: Recipes by name; spike4dgs-x if left out.
        samples: Samples per pixel of the true images, a power of two.
        out: Folder for the ladders, the truth, and what `run-benchmark` keeps.
        seed: Seed that every fit gets.
        seeds: Number of seeds, from that one up; the ladder shows means over them.
        workers: Processes that fit, each on its share of this machine's cores.
        scheduler: Address of a dask.distributed scheduler, tcp://HOST:PORT, whose workers fit.
        device: auto, cpu or cuda.
        budget: quick, standard (4 times the steps), or a multiple of quick.
        metrics: auto (all that this machine can compute), or ids such as lpips_vgg.
        split: Training views and held-out views, such as corner or views-3; each scene's default if left out.
        allow_gaps: Accept recordings with gaps.
    """
    opened, console = open_scenes(scenes, allow_gaps, split), make_console()
    out = split_folder(out, split, opened)
    ladders = oracle_ladders(methods, out / "truth", samples)
    if scheduler is None or device == "auto":
        device = choose_device_for([rung.method for ladder in ladders for rung in ladder.rungs], device)
    settings = Settings(out, seed, device, make_budget(budget), metrics, seeds, workers, scheduler)
    records = climb(opened, ladders, find_truth, out / "truth", samples, settings, console)
    console.print(f"ladder: {out}/ladder.md, ladder.csv and ladder_*.png", highlight=False, markup=False)
    failed = [r["method"]["name"] for r in records for c in r["scenes"].values() if c["status"] == "failed"]
    if failed:
        console.print(f"failed: {', '.join(failed)}", highlight=False, markup=False)
    return 1 if failed else 0


def climb(
    scenes: Sequence[Scene],
    ladders: Sequence[Ladder],
    truth_of: Callable[[Scene], WorldTruth],
    folder: Path,
    samples: int,
    settings: Settings,
    console: Console,
) -> list[Record]:
    """Render the truth of the scenes into `folder`, fit all rungs or resume them, and report what each gains.

    Return the records of all rungs. Raises UserError before any work for a scene that was not generated here, and for a
    budget that four times the steps have no meaning for.
    """
    if settings.budget.published:
        raise problem("--budget", "quick, standard or a multiple", "paper", "choose another budget")
    truths = [truth_of(scene) for scene in scenes]
    with RunDisplay(console, len(scenes)) as display:
        for scene, truth in zip(scenes, truths, strict=True):
            ticks = sorted({t for ladder in ladders for t in ladder.image_ticks(scene.n_ticks)})
            with display.cell(f"truth of {scene.id}") as shown:
                kept = Truth.of(folder, scene.id, scene.revision, samples)
                truth.write(kept, ticks, samples, shown.progress)
    methods = {rung.method.name: rung.method for ladder in ladders for rung in ladder.rungs}
    records = run_matrix(scenes, list(methods.values()), settings, console)
    for ladder in ladders:
        for line in ladder.left_out:
            console.print(f"{ladder.method}: left out: {line}", highlight=False, markup=False)
    tables = [make_table(ladder, [scene.id for scene in scenes], records) for ladder in ladders]
    write_ladder(settings.out, tables)
    for table in tables:
        console.print(to_markdown(table), highlight=False, markup=False)
    return records


@dataclass(frozen=True)
class LadderTable:
    """The rungs of a method, the fit as it is first: rung -> scene, or the mean -> column -> value.

    A value is None where there is none; `errors` says why, by rung and scene.
    """

    method: str
    places: tuple[str, ...]  # the scenes, and their mean where there are several
    rungs: dict[str, dict[str, Values]]
    errors: dict[tuple[str, str], str]

    def gain(self, title: str, place: str, column: str) -> float | None:
        """Return by how much a rung is above the fit as it is; None where either has no value."""
        plain = next(iter(self.rungs.values()))[place][column]
        value = self.rungs[title][place][column]
        return None if plain is None or value is None else value - plain


def make_table(ladder: Ladder, scenes: Sequence[str], records: Sequence[Record]) -> LadderTable:
    """Return the table of a ladder, each rung the mean over the seeds in `records`."""
    rungs, errors = {}, {}
    for rung in ladder.rungs:
        mine = [r for r in records if r["method"]["name"] == rung.method.name]
        found = {}
        for scene in scenes:
            cells = [r["scenes"][scene] for r in mine]
            values = [{**(c["metrics"] or {}), "fit_seconds": c["fit_seconds"]} for c in cells]
            found[scene] = {column: mean([v.get(column) for v in values]) for column in COLUMNS}
            if why := "; ".join(str(c["error"]) for c in cells if c["error"]):
                errors[rung.title, scene] = why
        every = {column: mean([v[column] for v in found.values()]) for column in COLUMNS}
        rungs[rung.title] = {**found, MEAN: every} if len(scenes) > 1 else found
    return LadderTable(ladder.method, (*scenes, MEAN) if len(scenes) > 1 else (*scenes,), rungs, errors)


def write_ladder(out: Path, tables: Sequence[LadderTable]) -> None:
    """Write ladder.md and ladder.csv, with the gains over the fit as it is, and ladder_METHOD.png for each method."""
    lines = []
    for table in tables:
        for title, place in itertools.product(table.rungs, table.places):
            values = [*table.rungs[title][place].values(), *(table.gain(title, place, c) for c in _GAINS)]
            texts = ("" if v is None else f"{v:.4f}" for v in values)
            lines.append([table.method, title, place, *texts, table.errors.get((title, place), "")])
        plot(out / f"ladder_{table.method}.png", table)
    columns = ["method", "rung", "scene", *COLUMNS, *(f"{c}_gain" for c in _GAINS), "error"]
    write_csv(out / "ladder.csv", columns, lines)
    write_text(out / "ladder.md", "\n".join(to_markdown(table) for table in tables))


def to_markdown(table: LadderTable) -> str:
    """Return Markdown: a block for each column, its value and the gain in brackets, then errors."""
    lines = [f"# Where the dB of {table.method} are lost", ""]
    for column, title in COLUMNS.items():
        rows = [[rung, *(_text(table, rung, place, column) for place in table.places)] for rung in table.rungs]
        lines += [f"## {title}", "", *markdown(["rung", *table.places], rows), ""]
    errors = [f"- {title}, {scene}: {why}" for (title, scene), why in table.errors.items()]
    return "\n".join([*lines, *errors, ""] if errors else lines)


def _text(table: LadderTable, title: str, place: str, column: str) -> str:
    value = table.rungs[title][place][column]
    if value is None:
        return "-"
    if column not in _GAINS:
        return f"{value:.0f}"
    gain = table.gain(title, place, column)
    return f"{value:.2f}" if gain is None or title == next(iter(table.rungs)) else f"{value:.2f} ({_signed(gain)})"


def _signed(gain: float) -> str:
    """Return a gain with its sign, which a rounded zero has none of: +0.00."""
    return f"{round(gain, 2) + 0.0:+.2f}"


def plot(path: Path, table: LadderTable) -> None:
    """Write a PNG: the gain of each rung on each scene, as colour and number, everywhere and where things move."""
    plain, *others = table.rungs
    places = table.places
    figure = new_figure((3.2 + 1.9 * len(others), 1.9 + 0.42 * len(places)))
    gains = {c: [[_or_nan(table.gain(title, place, c)) for title in others] for place in places] for c in _GAINS}
    largest = float(np.nanmax(np.abs([*gains.values()]), initial=1e-9))
    for axes, (column, values) in zip(figure.subplots(1, 2, sharey=True), gains.items(), strict=True):
        axes.imshow(values, cmap="RdBu", vmin=-largest, vmax=largest, aspect="auto")
        for (y, x), gain in np.ndenumerate(values):
            color = "white" if abs(gain) > 0.6 * largest else "black"
            axes.text(x, y, "-" if np.isnan(gain) else _signed(gain), ha="center", va="center", fontsize=8, color=color)
        axes.set_xticks(range(len(others)), [textwrap.fill(title, 14) for title in others], fontsize=7)
        labels = [f"{p}: {_text(table, plain, p, _GAINS[0])} / {_text(table, plain, p, _GAINS[1])}" for p in places]
        axes.set_yticks(range(len(places)), labels, fontsize=8)
        axes.set_title(COLUMNS[column].replace("PSNR", "gain in PSNR"), fontsize=9)
    figure.suptitle(f"{table.method}: dB gained over the fit as it is (its PSNR / where things move)", fontsize=10)
    save_figure(figure, path)


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value
