"""Many submitters at once, some killed: no entry is lost, nobody is blocked, and the boards follow from the entries."""

from __future__ import annotations

from pathlib import Path

import pytest
from submitters import lost, make_results, same_boards, submit_under_fire

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import locked
from spike4dgs.leaderboard import entry


@pytest.mark.slow
def test_submitters_at_once_and_killed_lose_nothing(done: Path, tmp_path: Path) -> None:
    results = make_results(done / "out/results/rough.json", tmp_path / "results", 8)
    hits, codes = submit_under_fire(tmp_path / "board", results, kills=12)
    assert hits == 12 and codes == [0] * 8
    assert not lost(tmp_path / "board", results)
    (tmp_path / "copy").mkdir()
    assert same_boards(tmp_path / "board", tmp_path / "copy")


def test_a_lock_that_is_never_released_ends_in_a_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(entry, "WAIT_S", 0.2)
    with locked(tmp_path / ".lock", tmp_path, "nobody"):
        with pytest.raises(UserError, match="expected a leaderboard that other submissions leave in time, found a run"):
            with entry.lock(tmp_path):
                pass
    with entry.lock(tmp_path):
        pass
