from __future__ import annotations

import copy
import json
import shutil
from pathlib import Path
from typing import Any

from dummy_methods import CountMethod, run
from submissions import Record, board, enter

from spike4dgs.benchmark.metrics.table import METRICS, PRIMARY
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.leaderboard.entry import read_entry
from spike4dgs.leaderboard.rank import rank_entries, write_leaderboard
from spike4dgs.leaderboard.submit_command import submit


def test_rows_are_ranked_and_failures_come_last(done: Path) -> None:
    enter(done, "bad", verified=False)
    enter(done, "rough")
    enter(done)
    (only,) = board(done)["boards"]
    rows = only["rows"]
    assert [(r["method"], r["rank"]) for r in rows] == [("tfp+4dgs", 1), ("rough", 2), ("bad", None)]
    assert rows[0]["mean"][PRIMARY] > rows[1]["mean"][PRIMARY]
    assert rows[2]["status"] == {"pattern-0": "failed", "pattern-1": "failed"}
    assert rows[2]["mean"][PRIMARY] is None and rows[2]["fit_seconds"] is None
    assert [m["id"] for m in board(done)["metrics"]] == list(METRICS)
    check_schema(board(done), load_schema("spike4dgs.leaderboard", "leaderboard.schema.json"), "board", "")


def entry_of(record: Record, name: str, psnr: float | None, submitted: str) -> Record:
    record = copy.deepcopy(record)
    record["method"]["name"] = name
    record["mean"][PRIMARY] = psnr
    checked = {"label": "verified", "unverified": []}
    return {"schema": "spike4dgs-entry/1", **checked, "submitted": submitted, "record": record}


def test_of_equal_values_the_earlier_submission_is_first(finished: Path) -> None:
    record = json.loads((finished / "out/results/rough.json").read_text())
    rows = rank_entries(
        [
            entry_of(record, "later", 20.0, "2026-01-02T00:00:00Z"),
            entry_of(record, "none", None, "2026-01-01T00:00:00Z"),
            entry_of(record, "best", 21.0, "2026-01-03T00:00:00Z"),
            entry_of(record, "earlier", 20.0, "2026-01-01T00:00:00Z"),
        ]
    )
    assert [(r["method"], r["rank"]) for r in rows] == [("best", 1), ("earlier", 2), ("later", 3), ("none", None)]


def test_a_method_with_one_failed_scene_is_not_ranked(done: Path) -> None:
    class Half(CountMethod):
        def fit(self, scene: Any, *args: Any, **kwargs: Any) -> Any:
            if scene.id == "pattern-1":
                raise ValueError("too dark")
            return super().fit(scene, *args, **kwargs)

    run(done / "out", [done / "s0", done / "s1"], Half("half"))
    entry = read_entry(enter(done, "half"))
    assert entry["label"] == "verified", "what was scored was verified"
    (row,) = board(done)["boards"][0]["rows"]
    assert row["rank"] is None and row["status"] == {"pattern-0": "ok", "pattern-1": "failed"}


def test_only_records_of_one_dataset_compare(done: Path) -> None:
    enter(done)
    run(done / "single", [done / "s1"], CountMethod("other"))
    submit(done / "single/results/other.json", leaderboard=done / "board")
    names = [(b["dataset"]["name"], [r["method"] for r in b["rows"]]) for b in board(done)["boards"]]
    assert sorted(names) == [("pattern-0+pattern-1", ["tfp+4dgs"]), ("pattern-1", ["other"])]


def test_the_leaderboard_is_made_from_the_entries_alone(done: Path) -> None:
    enter(done)
    enter(done, "rough")
    before = (done / "board/leaderboard.json").read_bytes()
    (done / "board/leaderboard.json").unlink()
    write_leaderboard(done / "board")
    assert (done / "board/leaderboard.json").read_bytes() == before


def test_the_committed_leaderboard_follows_from_the_committed_entries(tmp_path: Path) -> None:
    committed = Path(__file__).resolve().parents[2] / "leaderboard"
    shutil.copytree(committed / "entries", tmp_path / "entries")
    write_leaderboard(tmp_path)
    assert (tmp_path / "leaderboard.json").read_bytes() == (committed / "leaderboard.json").read_bytes()
