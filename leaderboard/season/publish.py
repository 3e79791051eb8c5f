"""What becomes public of a season: the tars that may be by now, and in the end the secret seeds."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

from spike4dgs.benchmark.environment import utc_now
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path, sha256_file, write_text
from spike4dgs.leaderboard.season.results import read_results
from spike4dgs.leaderboard.season.season_file import (
    OPENING_NAME,
    Season,
    is_revealed,
    read_opening,
    read_season,
    season_folder,
)
from spike4dgs.leaderboard.season.secret_folder import pack_file


def publish(number: int, secret: Path, out: Path, seasons: Path) -> Iterator[tuple[Path, str]]:
    """Copy the tars that may be public by now into `out`: training parts, and after the reveal whole scenes.

    Yield each with its SHA-256, the committed one. Raises UserError where a tar has another, and before the reveal of
    a season whose streams are hidden.
    """
    season, revealed = read_season(seasons, number), is_revealed(seasons, number)
    if season.streams == "hidden" and not revealed:
        fix = "reveal the season first: its training streams are hidden until then"
        raise problem(f"season {number}", "published streams", "hidden ones", fix)
    for scene in season.scenes:
        for training in (True, False) if revealed else (True,):
            source = pack_file(secret, scene.id, training)
            expected = scene.training_pack_sha256 if training else scene.pack_sha256
            if not source.is_file() or (found := sha256_file(source)) != expected:
                shown = f"{found[:16]}..." if source.is_file() else "no such file"
                raise problem(source, f"the committed sha256 {expected[:16]}...", shown, "restore the file")
            with atomic_path(out / source.name) as part:
                shutil.copyfile(source, part)
            yield out / source.name, expected


def reveal(number: int, secret: Path, seasons: Path) -> Season:
    """Publish the seeds of a season as SEASONS/NUMBER/opening.json, whose SHA-256 is the commitment; return the season.

    Raises UserError before the closing day is over, and where nothing was scored.
    """
    season = read_season(seasons, number)
    if season.closes is not None and utc_now()[: len(season.closes)] <= season.closes:
        fix = "wait: whoever knows the seeds can make the truth"
        raise problem(f"season {number}", f"a day after {season.closes}", utc_now(), fix)
    if not read_results(seasons, season):
        fix = "score the submissions first: no result counts after the reveal"
        raise problem(season_folder(seasons, number), "results", "none", fix)
    path = season_folder(seasons, number) / OPENING_NAME
    found = read_opening(secret / OPENING_NAME, season.opening_sha256)
    write_text(path, found.text)
    return season
