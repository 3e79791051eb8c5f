"""Help for tests of the leaderboard: submit a finished run's records, read and change the files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.files import write_json
from spike4dgs.leaderboard.submit_command import submit

Record = dict[str, Any]


def enter(done: Path, name: str = "tfp+4dgs", verified: bool = True, **options: Any) -> Path:
    """Submit a method's record and return the path of its entry."""
    if verified:
        options = {
            "predictions": done / "out/predictions" / name,
            "scenes": (done / "s0", done / "s1"),
            **options,
        }
    assert submit(done / f"out/results/{name}.json", leaderboard=done / "board", **options) == 0
    return next((done / "board/entries").glob(f"*/{name}.json"))


def edit(path: Path, change: Any) -> None:
    data = json.loads(path.read_text())
    change(data)
    write_json(path, data)


def everything(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def board(done: Path) -> dict[str, Any]:
    return json.loads((done / "board/leaderboard.json").read_text())
