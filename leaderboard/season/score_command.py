"""`season score`: score submitted predictions, or methods that the maintainers run, against the hidden scenes."""

from __future__ import annotations

import sys
from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.locks import locked
from spike4dgs.benchmark.metrics.selection import AUTO, select_metrics
from spike4dgs.benchmark.reports.console import make_console, results_table
from spike4dgs.benchmark.runs.run import Settings
from spike4dgs.benchmark.runs.score import score_predictions
from spike4dgs.leaderboard.season.predict_command import find_chosen, predict_all
from spike4dgs.leaderboard.season.results import (
    METHOD,
    PREDICTIONS,
    Result,
    read_results,
    write_result,
    write_table,
)
from spike4dgs.leaderboard.season.season_file import SEASONS, Season, is_revealed, read_season
from spike4dgs.leaderboard.season.secret_folder import open_committed, runs_folder


def score(
    number: Positional[int],
    *,
    secret: Path,
    predictions: tuple[Path, ...] = (),
    methods: tuple[str, ...] = (),
    metrics: tuple[str, ...] = (AUTO,),
    device: str = "auto",
    seasons: Path = SEASONS,
) -> int:
    """Score submissions to a season: predictions of participants, and installed methods, which are run first.

    Methods get the training parts alone, with the season's budget and seed. A name is scored once. Each result is in
    SEASONS/NUMBER/results, the table in table.md: commit and push both before the reveal.

    Args:
        number: Number of the season.
        secret: Folder of `season make`.
        predictions: Predictions folders, each with one folder per scene id.
        methods: Installed methods by name.
        metrics: auto (all that this machine can compute), or ids such as lpips_vgg. PSNR, SSIM and the temporal error
            are always computed.
        device: Of the methods: auto, cpu or cuda.
        seasons: Folder of the public files.
    """
    season = read_season(seasons, number)
    if is_revealed(seasons, number):
        fix = "submit to the next season: whoever knows the seeds can make the truth"
        raise problem(f"season {number}", "a season whose seeds are secret", "revealed ones", fix)
    if not (predictions or methods):
        raise problem("season score", "--predictions or --methods", "neither", "name what to score")
    if predictions and season.streams == "hidden":
        fix = "take the method itself: --methods"
        raise problem("--predictions", "a season with published streams", "hidden ones", fix)
    selection = select_metrics(metrics)
    with locked(secret / ".lock", secret, "a folder in which nobody else scores"):
        scenes = open_committed(secret, season)
        submitted = [(PREDICTIONS, folder) for folder in predictions]
        failed = _run(season, secret, methods, device) if methods else set()
        submitted += [(METHOD, runs_folder(secret) / "predictions" / name) for name in methods if name not in failed]
        for way, folder in submitted:
            try:
                record = score_predictions(folder, scenes, selection, season.training_revisions)
                write_result(seasons, number, Result(way, record))
            except UserError as e:  # one participant's mistake does not stop the others
                print(f"error: {e}", file=sys.stderr)
                failed.add(folder.name)
        table = write_table(seasons, season)
    make_console().print(results_table([result.record for result in read_results(seasons, season)]))
    print(f"table: {table}; results: {table.parent / 'results'}")
    return 1 if failed else 0


def _run(season: Season, secret: Path, methods: tuple[str, ...], device: str) -> set[str]:
    """Run methods on the training parts; return the names of those that failed."""
    chosen, on = find_chosen(methods, device)
    settings = Settings(runs_folder(secret), season.fit_seed, on, season.fit_budget)
    return predict_all(open_committed(secret, season, training=True), chosen, settings)
