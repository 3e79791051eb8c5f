"""A leaderboard of many entries: each is read once, and checked once as long as neither it nor the code changes."""

from __future__ import annotations

import copy
import json
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from changes import edit_json

from spike4dgs.benchmark.files import sha256_json, write_json
from spike4dgs.leaderboard import entry as entries
from spike4dgs.leaderboard import reading
from spike4dgs.leaderboard.entry import entry_path
from spike4dgs.leaderboard.ledger import add_line, read_ledger
from spike4dgs.leaderboard.page.rows import gather
from spike4dgs.leaderboard.rank import make_boards, write_boards
from spike4dgs.leaderboard.reading import FEWEST, read_all, read_briefs, read_checked
from spike4dgs.leaderboard.thumbnails import KEY
from spike4dgs.leaderboard.tracks import SHIPPED
from spike4dgs.leaderboard.verify_entries import verify_leaderboard

FOLDERS = ("entries", "local", "archive")


def add(board: Path, name: str) -> Path:
    """Add a shipped entry under another method's name, with other values."""
    (path,) = SHIPPED.glob("entries/*/tfp+static.json")
    entry = copy.deepcopy(json.loads(path.read_text(encoding="utf-8")))
    entry["record"]["method"]["name"] = name
    del entry[KEY]  # its sheet stays where it is
    add_line(board, sha256_json(entry), own := entry_path(entry["record"]))
    write_json(board / own, entry)
    return board / own


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A leaderboard of just as many entries as are kept."""
    board = tmp_path_factory.mktemp("whole") / "board"
    for i in range(FEWEST):
        add(board, f"m{i}")
    return board


@pytest.fixture
def board(whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of it that a test may damage, and a cache folder of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return Path(shutil.copytree(whole, tmp_path / "board"))


@pytest.fixture
def counts(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often files are read, and entries checked."""
    found: Counter[str] = Counter()

    def count(name: str) -> None:
        original: Callable[..., Any] = getattr(reading, name)

        def counted(*arguments: Any) -> Any:
            found[name] += 1
            return original(*arguments)

        monkeypatch.setattr(reading, name, counted)

    count("read_bytes")
    count("parse_entry")
    return found


def test_entries_are_checked_once(board: Path, counts: Counter[str]) -> None:
    first = write_boards(board)
    assert counts == {"read_bytes": FEWEST, "parse_entry": FEWEST}
    counts.clear()
    assert write_boards(board) == first
    assert counts == {"read_bytes": FEWEST}
    counts.clear()
    new = add(board, "new")
    (track,) = write_boards(board)["entries"]["boards"]
    assert counts == {"read_bytes": FEWEST + 1, "parse_entry": 1}
    assert len(track["rows"]) == FEWEST + 1
    counts.clear()
    edit_json(new, lambda entry: entry.update(submitted="2026-01-01T00:00:00Z"))
    (refused,) = write_boards(board)["entries"]["refused"]
    assert counts["parse_entry"] == 1 and "as after an edit by hand" in refused["reason"]


def test_the_page_and_the_ranking_check_nothing_again(board: Path, counts: Counter[str]) -> None:
    write_boards(board)
    counts.clear()
    whole, brief = (gather(board, (), brief=brief)[0] for brief in (False, True))
    assert counts == {"read_bytes": 2 * FEWEST}
    assert [row.name for row in whole[0].rows] == [row.name for row in brief[0].rows]
    assert {row.hardware for board in whole for row in board.rows} == {brief[0].rows[0].hardware} != {"not stated"}
    assert whole[0].rows[0].hashes == brief[0].rows[0].hashes
    path, sha256 = next(iter(whole[0].rows[0].hashes.items()))
    assert sha256 == sha256_json(json.loads((board / path).read_text(encoding="utf-8")))


def test_a_verification_checks_everything_and_reads_it_once(board: Path, counts: Counter[str]) -> None:
    write_boards(board)
    counts.clear()
    assert not verify_leaderboard(board).problems
    assert counts == {"read_bytes": FEWEST, "parse_entry": FEWEST}


def test_known_entries_are_what_checked_ones_are(board: Path) -> None:
    """Also the project's: archived entries, older metrics, two tracks."""
    committed = Path(__file__).resolve().parents[2] / "leaderboard"  # a wheel has no archive
    for folder in ("entries/2-small@*", "archive/bird-0-small+3@*", "archive/car-0-paper@*"):
        (found,) = committed.glob(folder)
        shutil.copytree(found, board / found.relative_to(committed))
    with (board / entries.LEDGER).open("a") as ledger:
        ledger.write((committed / entries.LEDGER).read_text())
    checked = read_all(board, *FOLDERS)
    assert len({Path(path).parent for path in checked.entries}) == 4 and not checked.refused
    boards = make_boards(checked)
    read_briefs(board)
    assert read_checked(board) == checked
    assert make_boards(read_briefs(board)) == boards


def test_another_version_of_the_code_checks_everything(
    board: Path, counts: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_boards(board)
    counts.clear()
    monkeypatch.setattr(reading, "_code", lambda: "another")
    write_boards(board)
    assert counts["parse_entry"] == FEWEST


def test_a_damaged_cache_is_none(board: Path, counts: Counter[str]) -> None:
    before = write_boards(board)
    (file,) = (board.parent / "cache").rglob("*.json")
    for damage in (b"", b"[]", b"{}", b'{"code": 1, "entries": 2}', b"\xff"):
        file.write_bytes(damage)
        counts.clear()
        assert write_boards(board) == before
        assert counts["parse_entry"] == FEWEST, damage


def test_without_a_cache_folder_entries_are_checked_each_time(
    board: Path, counts: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (board.parent / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(board.parent / "file"))
    assert write_boards(board) == write_boards(board)
    assert counts["parse_entry"] == 2 * FEWEST


def test_what_the_ledger_lacks_is_refused_though_it_was_checked(board: Path) -> None:
    write_boards(board)
    (board / entries.LEDGER).write_text("")
    assert not read_ledger(board)
    assert len(read_briefs(board).refused) == FEWEST and not read_briefs(board).entries


def test_an_entry_in_the_place_of_another_is_refused_though_it_was_checked(board: Path) -> None:
    write_boards(board)
    first, second = sorted(board.glob("entries/*/m1.json")) + sorted(board.glob("entries/*/m2.json"))
    second.write_bytes(first.read_bytes())
    (reason,) = read_briefs(board).refused.values()
    assert "m2.json" in reason and "m1.json" in reason
