from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from submissions import edit, edit_with_ledger, enter, release_of

from spike4dgs.cli.verify_leaderboard import verify_leaderboard
from spike4dgs.leaderboard import tracks


def problems(done: Path, capsys: pytest.CaptureFixture[str], **options: Any) -> list[str]:
    capsys.readouterr()
    code = verify_leaderboard(done / "board", **options)
    lines = capsys.readouterr().err.splitlines()
    assert code == (1 if lines else 0)
    return lines


def files(done: Path) -> dict[str, Any]:
    return {"predictions": done / "out/predictions", "scenes": (done / "s0", done / "s1")}


def test_what_submit_writes_has_no_problems(
    done: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    release_of(done, monkeypatch)
    enter(done)
    enter(done, "bad", verified=False)
    assert not problems(done, capsys)
    assert not problems(done, capsys, **files(done))
    verify_leaderboard(done / "board", **files(done))
    assert "release 1, 2 entries, 1 scored again, no problems" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: e["verification"].update(unverified=["psnr"]), "LEDGER"),
        (lambda e: e.update(submitted="2001-01-01T00:00:00Z"), "LEDGER"),
        (lambda e: e["record"].update(command="x"), "LEDGER"),
        (lambda e: e["verification"].update(label="best"), "at verification/label"),
    ],
)
def test_every_edit_by_hand_is_named(done: Path, change: Any, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = enter(done)
    edit(path, change)
    lines = problems(done, capsys)
    assert any("tfp+4dgs.json" in line and message in line for line in lines)
    assert any("local.json: expected what the entries give" in line for line in lines), "its row is gone"


def test_boards_follow_from_the_entries(done: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = enter(done)
    edit(done / "board/local.json", lambda b: b["boards"][0]["rows"][0].update(rank=None))
    (line,) = problems(done, capsys)
    assert "local.json: expected what the entries give" in line
    enter(done)
    moved = path.with_name("other.json")
    path.rename(moved)
    assert any("other.json: expected the entry of" in line for line in problems(done, capsys))


def test_a_forgery_that_agrees_with_itself_is_found_with_the_files(
    done: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An entry edited together with its ledger line and its board: only scoring again finds it."""

    def better(entry: dict[str, Any]) -> None:
        record = entry["record"]
        for cell in record["scenes"].values():
            for values in cell["per_image"].values():
                values["psnr"] += 1
            cell["metrics"]["psnr"] += 1
        record["mean"]["psnr"] += 1

    path = enter(done)
    edit_with_ledger(path, better)
    enter(done, "rough")  # writes the boards anew
    assert not problems(done, capsys)
    (line,) = problems(done, capsys, **files(done))
    assert "tfp+4dgs.json, scene pattern-0" in line and "as computed from the files" in line


def test_the_committed_leaderboard_has_no_problems(capsys: pytest.CaptureFixture[str]) -> None:
    tracks.read_release.cache_clear()
    assert verify_leaderboard(Path(__file__).resolve().parents[2] / "leaderboard") == 0
    assert "no problems" in capsys.readouterr().out
