"""`season make`, `publish`, `predict`, `score`, `reveal`, `check`: benchmarks whose scenes are hidden until the end."""

from __future__ import annotations

import sys
from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.method import DEFAULT_BUDGET, choose_device_for, get_method, make_budget
from spike4dgs.benchmark.metrics.measure import AUTO
from spike4dgs.benchmark.reports.console import make_console, print_results
from spike4dgs.benchmark.runs.apart.fit import Apart
from spike4dgs.benchmark.runs.run import Settings
from spike4dgs.benchmark.scene.scene import open_scenes
from spike4dgs.leaderboard.season import publish as public
from spike4dgs.leaderboard.season import season_file
from spike4dgs.leaderboard.season.check import checks
from spike4dgs.leaderboard.season.make import make_season
from spike4dgs.leaderboard.season.results import predict_all, read_results, score_season
from spike4dgs.leaderboard.season.season_file import (
    OPENING_NAME,
    SEASONS,
    Rendering,
    Seed,
    is_announced,
    read_season,
    season_folder,
)


def make(
    number: Positional[int],
    *,
    worlds: tuple[str, ...],
    secret: Path,
    profile: str = "small",
    rendering: Rendering = "split",
    closes: str | None = None,
    hide_streams: bool = False,
    budget: str = DEFAULT_BUDGET,
    fit_seed: int = 0,
    workers: int = 1,
    seasons: Path = SEASONS,
) -> int:
    """Draw secret seeds, make the hidden scenes of a season, and write the commitments to them.

    SEASONS/NUMBER/season.json is public: commit and push it now, before anybody submits. Keep SECRET private. The same
    command resumes a killed run. Commitments are never changed.

    Args:
        number: Number of the season, from 0 up.
        worlds: Names of worlds; one hidden scene of each is made.
        secret: Folder for the seeds and the scenes, which only its owner can read.
        profile: Profile of the scenes: tiny, small or paper.
        rendering: Rendering of the scenes, as in make-dataset.
        closes: Last day of submissions, such as 2027-01-31; if left out, they end with the reveal.
        hide_streams: Publish no training streams, so that only methods can be submitted.
        budget: Budget of methods that the maintainers run: quick, standard, paper, or a multiple of quick.
        fit_seed: Seed of those fits.
        workers: Number of rendering processes.
        seasons: Folder of the public files.
    """
    from spike4dgs.generators import make_dataset as scenes

    def make_scene(seed: Seed, out: Path) -> int:
        settings = scenes.SceneSettings(seed.profile, int(seed.seed), seed.variant, rendering=seed.rendering)
        return scenes.make_dataset([settings.job(seed.world)], out, workers=workers)

    for world in worlds:  # a typo is told before the secret is drawn, which would keep it
        scenes.SceneSettings(profile, rendering=rendering).job(world)
    folder = season_folder(seasons, number)
    if make_season(
        number,
        worlds,
        secret,
        seasons,
        make_scene,
        profile=profile,
        rendering=rendering,
        closes=closes,
        hide_streams=hide_streams,
        budget=budget,
        fit_seed=fit_seed,
    ):
        path = folder / season_file.NAME
        print(f"season {number}: commitments in {path}: commit and push them; keep {secret} secret")
    else:
        print(f"season {number}: complete, kept: {folder}")
    return 0


def publish(number: Positional[int], *, secret: Path, out: Path, seasons: Path = SEASONS) -> int:
    """Write tars of what may be public so far: training parts, and whole scenes after the reveal.

    Training parts contain no ground truth. Participants fit them and submit predictions. Each tar has the committed
    SHA-256.

    Args:
        number: Number of the season.
        secret: Folder of `season make`.
        out: Folder for the tars.
        seasons: Folder of the public files.
    """
    for path, sha256 in public.publish(number, secret, out, seasons):
        print(f"{sha256}  {path}")
    return 0


def predict(
    scenes: Positional[tuple[Path, ...]],
    *,
    methods: tuple[str, ...],
    out: Path = Path("runs/season"),
    budget: str = DEFAULT_BUDGET,
    seed: int = 0,
    device: str = "auto",
) -> int:
    """Fit methods on the training parts of hidden scenes, and render the targets for submission.

    Submit OUT/predictions/METHOD. A killed run resumes where it stopped.

    Args:
        scenes: Unpacked training parts of the season's scenes.
        methods: Names of methods.
        out: Folder for predictions, models and logs.
        budget: quick, standard (4 times the steps), paper (the publication's steps), or a multiple of quick.
        seed: Seed of all random numbers.
        device: auto, cpu or cuda.
    """
    if not methods:
        raise problem("--methods", "names of methods", "none", "see `spike4dgs methods`")
    chosen = [get_method(name) for name in methods]
    settings = Settings(out, seed, choose_device_for(chosen, device), make_budget(budget), apart=Apart())
    failed = predict_all(open_scenes(scenes), chosen, settings)
    print(f"predictions: {out / 'predictions'}, a folder for each method")
    return 1 if failed else 0


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

    Methods get only the training parts, with the season's budget and seed. A name is scored once. Results are in
    SEASONS/NUMBER/results, and their table is in table.md. Commit and push both before the reveal.

    Args:
        number: Number of the season.
        secret: Folder of `season make`.
        predictions: Predictions folders, each with one folder per scene id.
        methods: Names of installed methods.
        metrics: auto (all that this machine can compute), or ids such as lpips_vgg. PSNR, SSIM and the temporal error
            are always computed.
        device: Device of the methods: auto, cpu or cuda.
        seasons: Folder of the public files.
    """
    table, refused = score_season(
        number, secret, seasons, predictions=predictions, methods=methods, metrics=metrics, device=device
    )
    for line in refused:
        print(f"error: {line}", file=sys.stderr)
    results = read_results(seasons, read_season(seasons, number))
    print_results(make_console(), [result.record for result in results])
    print(f"table: {table}; results: {table.parent / 'results'}")
    return 1 if refused else 0


def reveal(number: Positional[int], *, secret: Path, seasons: Path = SEASONS) -> int:
    """Publish the seeds of a season: SEASONS/NUMBER/opening.json, whose SHA-256 is the commitment.

    This is refused until the closing day is over, and if nothing was scored. Nothing can be scored afterwards.

    Args:
        number: Number of the season.
        secret: Folder of `season make`.
        seasons: Folder of the public files.
    """
    season, path = public.reveal(number, secret, seasons), season_folder(seasons, number) / OPENING_NAME
    print(f"season {number}: seeds in {path}; `sha256sum {path}` gives the commitment {season.opening_sha256}")
    print(f"check it with `spike4dgs season check {number}`; `season publish` now writes the whole scenes")
    return 0


def check(
    number: Positional[int], *, scenes: Path | None = None, predictions: Path | None = None, seasons: Path = SEASONS
) -> int:
    """Check a season: the revealed seeds against the commitment, the scenes, and the scores.

    Unpack the scenes from the season's tars, or make them with the printed `make-dataset` commands, which use the
    revealed seeds. Each line says what is right or what could not be checked. Errors say what is wrong; the exit code
    is then 2.

    Args:
        number: Number of the season.
        scenes: Folder of the hidden scenes: ID/ (made by `make-dataset` or unpacked from a tar), ID.tar, or both.
        predictions: Folder of the scored predictions, METHOD/ID/, to score them again.
        seasons: Folder of the public files.
    """
    for option, folder in (("--scenes", scenes), ("--predictions", predictions)):
        if folder is not None and not folder.is_dir():
            raise problem(option, "a folder", f"{folder}, which is none", "correct the path")
    if not is_announced(seasons, number):
        fix = "run this in a checkout, or give --seasons FOLDER"
        raise problem(season_folder(seasons, number) / season_file.NAME, "a season", "no such file", fix)
    wrong = 0
    for one in checks(read_season(seasons, number), seasons, scenes, predictions):
        try:
            print(one())
        except UserError as e:
            print(f"error: {e}", file=sys.stderr)
            wrong += 1
    return 2 if wrong else 0
