"""`season publish`: copy the tars that may be public by now: training parts, and after the reveal whole scenes."""

from __future__ import annotations

import shutil
from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path, sha256_file
from spike4dgs.leaderboard.season.season_file import SEASONS, is_revealed, read_season
from spike4dgs.leaderboard.season.secret_folder import pack_file


def publish(number: Positional[int], *, secret: Path, out: Path, seasons: Path = SEASONS) -> int:
    """Write what may be public by now as tars: the scenes' training parts, and after the reveal the whole scenes.

    Training parts have no truth: participants fit them and submit predictions. Each tar has the committed SHA-256.

    Args:
        number: Number of the season.
        secret: Folder of `season make`.
        out: Folder for the tars.
        seasons: Folder of the public files.
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
            print(f"{expected}  {out / source.name}")
    return 0
