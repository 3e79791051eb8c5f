"""Check what a season's maintainers committed to and published. Public files are all that it needs."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import sha256_file, visible
from spike4dgs.benchmark.runs.apart.training_part import write_training_part
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.benchmark.scene.verify import verify_content
from spike4dgs.leaderboard.season.results import TABLE, read_result, read_results, result_path, table_text
from spike4dgs.leaderboard.season.season_file import (
    OPENING_NAME,
    HiddenScene,
    Season,
    Seed,
    is_revealed,
    read_opening,
    season_folder,
)
from spike4dgs.leaderboard.verify import verify_record

_FORGED = "the published file was changed after the commitment, or is another season's"


def checks(
    season: Season, seasons: Path, scenes: Path | None = None, predictions: Path | None = None
) -> Iterator[Callable[[], str]]:
    """Yield the checks of a season's public files, of its `scenes` and of the scored `predictions`.

    Each returns a line on what is right or could not be checked, or raises UserError for what is wrong.
    """
    yield partial(_check_seeds, season, seasons)
    yield partial(_check_results, season, seasons)
    for scene in season.scenes:
        yield partial(_check_pack, f"{scene.id}-training.tar", scene.training_pack_sha256, scenes)
        yield partial(_check_pack, f"{scene.id}.tar", scene.pack_sha256, scenes)
        yield partial(_check_scene, scene, season, seasons, scenes)
    for path in visible(result_path(seasons, season.season, "*").parent, "*.json"):
        yield partial(_check_scores, path.stem, season, seasons, scenes, predictions)


def _check_seeds(season: Season, seasons: Path) -> str:
    """Check that opening.json is what was committed to, and that it names the season's scenes and code."""
    if not is_revealed(seasons, season.season):
        return f"not checked: the seeds, which are not revealed; the commitment is {season.opening_sha256}"
    path = season_folder(seasons, season.season) / OPENING_NAME
    found = read_opening(path, season.opening_sha256)
    expected = (season.season, [(s.id, s.world, s.variant, s.profile) for s in season.scenes], season.harness)
    stated = (found.season, [(s.scene, s.world, s.variant, s.profile) for s in found.scenes], found.harness)
    if stated != expected:
        raise problem(path, f"season, scenes and code {expected}, as in season.json", str(stated), _FORGED)
    return f"ok: the seeds of {len(found.scenes)} scenes are those committed to, sha256 {found.sha256}"


def _check_results(season: Season, seasons: Path) -> str:
    """Check that every result is consistent and of the committed scenes, and that the table follows from them."""
    results = read_results(seasons, season)
    path = season_folder(seasons, season.season) / TABLE
    if not results and not path.exists():
        return "not checked: results, of which there are none"
    if not path.is_file() or path.read_text(encoding="utf-8") != table_text(season, results):
        raise problem(path, "the table of the results", "another one, or none", "make it again from the results")
    return f"ok: {len(results)} results are of the committed scenes, and the table follows from them"


def _check_pack(name: str, sha256: str, scenes: Path | None) -> str:
    path = None if scenes is None else scenes / name
    if path is None or not path.is_file():
        return f"not checked: {name}, whose sha256 is {sha256}"
    if (found := sha256_file(path)) != sha256:
        raise problem(path, f"sha256 {sha256}, as committed", found, _FORGED)
    return f"ok: {path} is the tar committed to"


def _check_scene(scene: HiddenScene, season: Season, seasons: Path, scenes: Path | None) -> str:
    """Check that a scene folder is the one committed to, and that the published training part is a part of it."""
    folder = None if scenes is None else scenes / scene.id
    seed = _seed(scene, season, seasons)
    if folder is None or not folder.is_dir():
        how = f"`{seed.command} --out FOLDER`" if seed else "the tar, once the season is over"
        return f"not checked: {scene.id}, which you get by {how}; then give --scenes"
    opened = _open_checked(folder, scene, season)
    if seed and (stated := str(opened.meta["source"].get("seed"))) != seed.seed:
        raise problem(folder, f"seed {seed.seed}, as revealed", stated, _FORGED)
    with tempfile.TemporaryDirectory() as work:
        part = write_training_part(opened, Path(work) / scene.id)
        if part.revision != scene.training_revision:
            expected = f"a training part of revision {scene.training_revision[:16]}..., as committed"
            raise problem(folder, expected, f"{part.revision[:16]}...", _FORGED)
    return f"ok: {folder} is the scene committed to, revision {opened.revision}"


def _seed(scene: HiddenScene, season: Season, seasons: Path) -> Seed | None:
    """Return the revealed seed of a scene; None where it is not known, or not the one committed to."""
    try:
        path = season_folder(seasons, season.season) / OPENING_NAME
        return next((s for s in read_opening(path, season.opening_sha256).scenes if s.scene == scene.id), None)
    except UserError:  # of which `_check_seeds` tells
        return None


def _open_checked(folder: Path, scene: HiddenScene, season: Season) -> Scene:
    """Open a scene, every file of which is checked. Raises UserError unless it has the committed revision."""
    opened = open_scene(folder)
    for line in (*opened.manifest.problems(), *verify_content(opened)):
        raise UserError(line)
    if opened.revision != scene.revision:
        facts = {**season.rendered_on, "commit": season.harness["commit"]}
        versions = ", ".join(f"{name} {value}" for name, value in sorted(facts.items()))
        fix = f"other programs or another CPU ({versions}) render other bytes: if you made it, check {scene.id}.tar"
        raise problem(folder, f"revision {scene.revision}, as committed", opened.revision, fix)
    return opened


def _check_scores(name: str, season: Season, seasons: Path, scenes: Path | None, predictions: Path | None) -> str:
    path = result_path(seasons, season.season, name)
    there = scenes is not None and all((scenes / scene.id).is_dir() for scene in season.scenes)
    if scenes is None or not there or predictions is None or not (predictions / name).is_dir():
        return f"not checked: the scores of {name}, which take --scenes and --predictions with {name}/"
    opened = [open_scene(scenes / scene.id) for scene in season.scenes]
    record, given = read_result(path).record, predictions / name
    unverified = verify_record(record, path, given, opened, fitted=season.training_revisions).unverified
    but = f"; as claimed, not computed again: {', '.join(sorted(unverified))}" if unverified else ""
    return f"ok: the scores of {name} follow from its predictions{but}"
