"""`season reveal`: publish the secret seeds of a season that is over."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.environment import utc_now
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import write_text
from spike4dgs.leaderboard.season import opening
from spike4dgs.leaderboard.season.opening import read_opening
from spike4dgs.leaderboard.season.results import read_results
from spike4dgs.leaderboard.season.season_file import SEASONS, read_season, season_folder


def reveal(number: Positional[int], *, secret: Path, seasons: Path = SEASONS) -> int:
    """Publish the seeds of a season: SEASONS/NUMBER/opening.json, whose SHA-256 is the commitment.

    It is refused before the closing day is over, and where nothing was scored. Nothing can be scored afterwards.

    Args:
        number: Number of the season.
        secret: Folder of `season make`.
        seasons: Folder of the public files.
    """
    season = read_season(seasons, number)
    if season.closes is not None and utc_now()[: len(season.closes)] <= season.closes:
        fix = "wait: whoever knows the seeds can make the truth"
        raise problem(f"season {number}", f"a day after {season.closes}", utc_now(), fix)
    if not read_results(seasons, season):
        fix = "score the submissions first: no result counts after the reveal"
        raise problem(season_folder(seasons, number), "results", "none", fix)
    path = season_folder(seasons, number) / opening.NAME
    found = read_opening(secret / opening.NAME, season.opening_sha256)
    write_text(path, found.text)
    print(f"season {number}: seeds in {path}; `sha256sum {path}` gives the commitment {season.opening_sha256}")
    print(f"check it with `spike4dgs season check {number}`; `season publish` now writes the whole scenes")
    return 0
