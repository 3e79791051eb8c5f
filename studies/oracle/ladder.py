"""Ladders of oracles: a method as it is, and the same with one thing replaced by the truth or one limit removed.

OUT/truth/   what the oracles are given, rendered from the scene's own generator; kept for the next run
OUT/ladder.md, ladder.csv, ladder_METHOD.png   what each rung gains; the rest is as `run` keeps it

Oracles and truth come from other rooms, which this one does not import: the command line passes the functions in. What
they hand to a fit is no part of a scene, so no other fit can meet it; their records say `oracle`, and no leaderboard
takes them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from rich.console import Console

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.method import Method, Progress
from spike4dgs.benchmark.runs.display import RunDisplay
from spike4dgs.benchmark.runs.record import Record
from spike4dgs.benchmark.runs.run import Settings, run_matrix
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.studies.oracle.report import LadderTable, make_table, print_ladder, write_ladder
from spike4dgs.studies.oracle.truth import Truth

SAMPLES = 128  # of a pixel of the true images: their noise is then a third of that of images from spikes


@dataclass(frozen=True, eq=False)
class Rung:
    """A fit of a ladder, and what is said of it."""

    title: str
    method: Method


@dataclass(frozen=True, eq=False)
class Ladder:
    """The fits of a method: first the method as it is."""

    method: str
    rungs: tuple[Rung, ...]
    image_ticks: Callable[[int], Sequence[int]]  # length of a clip -> the ticks whose images the fits compare with
    left_out: tuple[str, ...] = ()  # rungs that the method has no use for, with the reason


class MakeLadders(Protocol):
    """Makes the ladders of methods by their names. Their oracles read their truth from the folder `truth`."""

    def __call__(self, names: Sequence[str], truth: Path, samples: int) -> tuple[Ladder, ...]:
        """Return a ladder for each name; that of the reference design without names."""
        ...


class SceneTruth(Protocol):
    """The truth of one scene, which can be rendered."""

    def write(self, truth: Truth, ticks: Sequence[int], samples: int, progress: Progress) -> None:
        """Render what `truth` lacks of the images at `ticks`, the points and the maps."""
        ...


FindTruth = Callable[[Scene], SceneTruth]  # raises UserError for a scene that was not generated here


def climb(
    scenes: Sequence[Scene],
    ladders: Sequence[Ladder],
    find_truth: FindTruth,
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
        raise problem("--budget", "quick, standard or a multiple beside --oracle", "paper", "choose another budget")
    truths = [find_truth(scene) for scene in scenes]
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
    tables = [tabulate(ladder, scenes, records) for ladder in ladders]
    for table in tables:
        print_ladder(table, console)
    write_ladder(settings.out, tables)
    return records


def tabulate(ladder: Ladder, scenes: Sequence[Scene], records: Sequence[Record]) -> LadderTable:
    """Return the table of a ladder from the records of its rungs, the mean over their seeds."""
    rungs = [(rung.title, rung.method.name) for rung in ladder.rungs]
    return make_table(ladder.method, rungs, [scene.id for scene in scenes], records)
