"""Help for tests of the leaderboard: submit a finished run's records, change the files, make releases."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from changes import edit_json

from spike4dgs.benchmark.files import sha256_json, write_json
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.cli.submit import submit
from spike4dgs.leaderboard import tracks
from spike4dgs.leaderboard.entry import read_entry
from spike4dgs.leaderboard.ledger import add_line, read_ledger
from spike4dgs.leaderboard.tracks import RELEASE

Record = dict[str, Any]


def enter(done: Path, name: str = "tfp+4dgs", verified: bool = True, **options: Any) -> Path:
    """Submit a method's record and return the path of its entry."""
    if verified:
        options = {"predictions": done / "out/predictions" / name, "scenes": (done / "s0", done / "s1"), **options}
    assert submit(done / f"out/results/{name}.json", leaderboard=done / "board", **options) == 0
    return entry_of(done, name)


def entry_of(done: Path, name: str = "tfp+4dgs") -> Path:
    (path,) = (p for folder in ("entries", "local") for p in (done / "board" / folder).glob(f"*/{name}.json"))
    return path


def read(path: Path) -> dict[str, Any]:
    """Read an entry as the leaderboard does."""
    board = path.parents[2]
    return read_entry(board, path.relative_to(board).as_posix(), read_ledger(board))


def edit_with_ledger(path: Path, change: Any) -> None:
    """Change an entry as somebody who also knows the ledger would."""
    edit_json(path, change)
    board = path.parents[2]
    add_line(board, sha256_json(json.loads(path.read_text())), path.relative_to(board).as_posix())


def refitted(psnr: Mapping[str, float]) -> Any:
    """Return the change of an entry that states a second fit with these values, by scene."""
    refit = {"psnr": dict(psnr), "tolerance_db": 0.3, "bit_equal": False, "costs": {}, "apart": "process"}
    return lambda entry: entry["verification"].update(label="re-fitted", refit=refit)


def files_of(done: Path) -> dict[str, Any]:
    """The options of a run's predictions and scenes."""
    return {"predictions": done / "out/predictions", "scenes": (done / "s0", done / "s1")}


def raise_metric(record: Record, metric: str, by: float) -> None:
    """Forge a record that agrees with itself: every image's value, and so all means, higher."""
    for cell in record["scenes"].values():
        for values in [*cell["per_image"].values(), cell["metrics"]]:
            values[metric] += by
    record["mean"][metric] += by


def board(done: Path, name: str = "local") -> dict[str, Any]:
    return json.loads((done / f"board/{name}.json").read_text())


def write_release(folder: Path, all_tracks: Mapping[str, Any], ceilings: Mapping[str, float] | None = None) -> Path:
    """Write a release with the number of the current one; `ceilings` are by the scenes' ids."""
    of = {scene: revision for t in all_tracks.values() for scene, revision in t["scenes"].items()}
    named = {tracks.scene_name(scene, of[scene]): value for scene, value in (ceilings or {}).items()}
    data = {"schema": "spike4dgs-release/1", "release": RELEASE, "tracks": dict(all_tracks), "ceilings_db": named}
    path = folder / f"{RELEASE}.json"
    write_json(path, data)
    (folder / "SHA256SUMS").write_text(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n")
    return folder


def track(scenes: Mapping[str, str | None], withheld: tuple[str, ...] = (), split: str = "center") -> dict[str, Any]:
    status = "announced" if None in scenes.values() else "open"
    return {"title": "A track", "status": status, "split": split, "withheld": [*withheld], "scenes": dict(scenes)}


def release_of(
    done: Path, monkeypatch: pytest.MonkeyPatch, ceilings: Mapping[str, float] | None = None, **revisions: str
) -> None:
    """Ship a release whose tracks `patterns` and `unposed` have the run's two scenes."""
    scenes = {s.id: s.revision for s in (open_scene(done / "s0"), open_scene(done / "s1"))}
    scenes |= {name.replace("_", "-"): revision for name, revision in revisions.items()}
    all_tracks = {"patterns": track(scenes), "unposed": track(scenes, ("poses",))}
    monkeypatch.setattr(tracks, "FOLDER", write_release(done / "releases", all_tracks, ceilings))
    tracks.read_release.cache_clear()
