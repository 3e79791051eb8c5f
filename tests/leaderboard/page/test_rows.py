"""The rows come from entries and runs, and a run that equals an entry is not a second row."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from dummy_methods import CountMethod, run
from submissions import enter, release_of, submit

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import write_json
from spike4dgs.benchmark.runs.record import of_scenes, read_record
from spike4dgs.leaderboard.page.rows import OWN, Board, find_board, gather, titles
from spike4dgs.leaderboard.rank import REFINED
from spike4dgs.leaderboard.tracks import ARCHIVE, PUBLIC

COMMITTED = Path(__file__).resolve().parents[3] / "leaderboard"


def test_the_committed_entries_are_all_there(committed: list[Board]) -> None:
    for folder, name in ((PUBLIC, "entries"), (ARCHIVE, "archive")):
        found = {path for b in committed if b.folder == folder for r in b.rows for path in r.entries}
        assert found == {p.relative_to(COMMITTED).as_posix() for p in (COMMITTED / name).glob("*/*.json")}
    assert not any(r.ranked for b in committed if b.folder == ARCHIVE for r in b.rows)
    assert len(set(titles(committed))) == len(committed)


def test_a_run_alone_makes_a_board_of_its_own(finished: Path, tmp_path: Path) -> None:
    (board,) = [b for b in gather(tmp_path / "none", (finished / "out",))[0] if b.rows]
    assert board.scenes == ["pattern-0", "pattern-1"] and "no track" in board.why
    rows = {r.name: r for r in board.rows}
    assert {r.label for r in board.rows} == {OWN}
    assert rows["out/tfp+4dgs"].ranked and set(rows["out/tfp+4dgs"].predictions) == set(board.scenes)
    assert not rows["out/bad"].ranked and rows["out/bad"].why == "pattern-0 failed, pattern-1 failed"


def test_a_run_lends_its_images_to_the_entry_that_it_became(done: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    release_of(done, monkeypatch)
    enter(done)
    boards, _ = gather(done / "board", (done / "out",))
    rows = {r.name: r for r in find_board(boards, "patterns").rows}
    assert sorted(rows) == ["out/bad", "out/rough", "tfp+4dgs"]
    assert rows["tfp+4dgs"].label == "re-scored" and set(rows["tfp+4dgs"].predictions) == {"pattern-0", "pattern-1"}


def test_seeds_of_fewer_scenes_are_a_board_of_their_own(done: Path) -> None:
    """As a run of several seeds that was killed leaves them."""
    whole = read_record(done / "out/results/tfp+4dgs.json")
    part = of_scenes({**whole, "method": {**whole["method"], "seed": 1}}, ["pattern-1"])
    write_json(done / "out/seed-1/results/tfp+4dgs.json", part)
    (done / "out/seed-1/results/.tfp+4dgs.77.part.json").write_text("{")  # and half of a file
    boards = [b for b in gather(done / "none", (done / "out",))[0] if b.rows]
    assert sorted(b.scenes for b in boards) == [["pattern-0", "pattern-1"], ["pattern-1"]]
    assert [len(r.records) for b in boards for r in b.rows if r.name == "out/tfp+4dgs"] == [1, 1]


def test_refined_scores_of_a_run_have_no_rank(done: Path) -> None:
    record = read_record(done / "out/results/rough.json")
    write_json(
        done / "out/results/rough.refined.json", {**record, "method": {**record["method"], "name": "rough.refined"}}
    )
    (board,) = [b for b in gather(done / "none", (done / "out",))[0] if b.rows]
    found = {r.name: (r.ranked, r.why) for r in board.rows}
    assert (found["out/rough"], found["out/rough.refined"]) == ((True, ""), (False, REFINED))


def test_a_run_of_other_seeds_than_an_entry_is_a_row_or_lends_no_images(done: Path) -> None:
    scenes = (done / "s0", done / "s1")
    run(done / "out/seed-1", [*scenes], CountMethod("rough", steps=1), seed=1)
    enter(done, "rough")
    (board,) = gather(done / "board", (done / "out",))[0]
    rows = {r.name: r for r in board.rows}
    assert [r["method"]["seed"] for r in rows["out/rough"].records] == [0, 1], "the entry is of seed 0 alone"
    assert all(set(rows[name].predictions) == set(board.scenes) for name in ("rough", "out/rough"))
    files = {"predictions": done / "out/seed-1/predictions/rough", "scenes": scenes}
    submit(done / "out/seed-1/results/rough.json", leaderboard=done / "board", **files)
    (board,) = gather(done / "board", (done / "out/seed-1",))[0]
    (row,) = board.rows
    assert len(row.records) == 2 and not row.predictions, "it shows the images of seed 0"


def test_rows_and_boards_of_one_name_are_told_apart(done: Path) -> None:
    """Runs whose folders have one name, and their boards of one scene in two revisions."""
    record = read_record(done / "out/results/rough.json")
    for folder, sha256, revision in (("a/x", "1", "3"), ("b/x", "2", "3"), ("c/x", "2", "4")):
        other = json.loads(json.dumps(record).replace(record["dataset"]["scenes"]["pattern-0"], revision * 64))
        other["scenes"]["pattern-0"]["predictions_sha256"] = sha256 * 64
        write_json(done / folder / "results/rough.json", other)
    boards = [b for b in gather(done / "none", [done / name for name in ("a/x", "b/x", "c/x")])[0] if b.rows]
    assert [[row.name for row in board.rows] for board in boards] == [["x/rough", "x/rough (2)"], ["x/rough"]]
    assert [find_board(boards, title) for title in titles(boards)] == boards


def test_a_folder_without_records_and_an_unknown_track_are_refused(tmp_path: Path, committed: list[Board]) -> None:
    with pytest.raises(UserError, match="results/"):
        gather(tmp_path / "none", (tmp_path,))
    with pytest.raises(UserError, match="ideal"):
        find_board(committed, "indoor")
