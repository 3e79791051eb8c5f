from __future__ import annotations

import hashlib
import itertools
import json
import os
import re
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import submitters
from changes import edit_json, files_in
from submissions import board, edit_with_ledger, enter, entry_of, read, submit

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import locked, write_bytes, write_json
from spike4dgs.benchmark.runs.record import of_scenes
from spike4dgs.leaderboard import entry
from spike4dgs.leaderboard.entry import check_numbers, entry_path, remove_parts, write_entry
from spike4dgs.leaderboard.rank import write_boards
from spike4dgs.leaderboard.reading import read_entries
from spike4dgs.leaderboard.thumbnails import Thumbnails, sheet_path, sheet_size, webp


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: e["verification"].update(label="certified"), "at verification/label"),
        (lambda e: e["verification"].update(label="claimed"), "at verification"),
        (lambda e: e["verification"].update(label="re-fitted"), "at verification"),
        (lambda e: e.update(note="x"), "'note' was unexpected"),
        (lambda e: e["record"]["method"].update(trained_on=["x" * 201]), "at record/method/trained_on/0"),
        (lambda e: e["record"]["method"].update(trained_on=list(map(str, range(51)))), "at record/method/trained_on"),
        (lambda e: e["record"].update(note="x"), "at record"),
        (
            lambda e: e["verification"]["truth"]["pattern-0"].update(noise_share=0.5),
            "at verification/truth/pattern-0/noise_share_error",
        ),
        (lambda e: e["record"]["method"].update(name="other"), "found that of local/pattern-0+1@"),
        (lambda e: e["record"]["dataset"]["scenes"].update({"pattern-0": "0" * 64}), "found that of local/"),
        (lambda e: e["record"]["mean"].update(psnr=50.0), "expected psnr ="),
    ],
)
def test_damaged_entries_are_refused_by_name_and_block_nobody(entered: Path, change: Any, message: str) -> None:
    edit_with_ledger(entry_of(entered), change)
    enter(entered, "rough", verified=False)
    (only,) = board(entered)["boards"]
    assert [r["method"] for r in only["rows"]] == ["rough"]
    (refused,) = board(entered)["refused"]
    assert refused["entry"].endswith("tfp+4dgs.json") and message in refused["reason"]


def test_a_label_that_was_edited_by_hand_is_noticed(done: Path, said: Any) -> None:
    path = enter(done, verified=False)
    verified = read(enter(done, "rough"))["verification"]
    edit_json(path, lambda e: e.update(verification={**verified, "truth": {}}))
    enter(done, "bad", verified=False)
    assert "tfp+4dgs.json: expected an entry as LEDGER lists it" in said()
    assert [r["method"] for r in board(done)["boards"][0]["rows"]] == ["rough", "bad"]
    with pytest.raises(UserError, match="LEDGER"):
        enter(done)
    assert read(enter(done, replace=True))["verification"]["label"] == "re-scored"


def test_a_damaged_ledger_is_an_error_with_its_line(entered: Path) -> None:
    ledger = entered / "board/LEDGER"
    ledger.write_text(ledger.read_text() + "not a line\n")
    with pytest.raises(UserError, match=r"LEDGER: expected lines of a sha256.* found line 2: 'not a line'"):
        enter(entered, "rough")


def test_half_written_files_of_killed_processes_block_nobody(entered: Path) -> None:
    path = entry_of(entered)
    for part in (path.with_name(".rough.part.json"), path.with_name(".tfp+4dgs.77.part.json")):
        part.write_text('{"half":')
    (entered / "board/.leaderboard.9.part.json").write_text("{")
    (path.parent / ".a.part").mkdir()  # no process of ours left that
    (path.parent / os.fsdecode(b"caf\xe9.json")).write_text("{")
    enter(entered, "rough")
    assert len(board(entered)["boards"][0]["rows"]) == 2
    assert [refused["entry"].partition("/caf")[2] for refused in board(entered)["refused"]] == ["\\udce9.json"]
    assert not [name for name in files_in(entered / "board") if ".part" in name]
    assert (path.parent / ".a.part").is_dir()


def test_a_lost_ledger_is_not_replaced_by_a_new_one(entered: Path) -> None:
    (entered / "board/LEDGER").unlink()
    for name in ("tfp+4dgs", "rough"):
        with pytest.raises(UserError, match="LEDGER: expected the ledger of the entries, found none; restore"):
            enter(entered, name)
    assert not (entered / "board/LEDGER").exists()


def test_a_seed_is_a_whole_number(entered: Path) -> None:
    record = read(entry_of(entered))["record"]
    record["method"]["seed"] = 1.0  # JSON Schema takes it for an integer, and a file's name does not
    with pytest.raises(UserError, match="a seed from 0 up"):
        entry_path(record)


def test_sheets_without_an_entry_go_if_the_ledger_knows_them(entered: Path) -> None:
    path, photo = entry_of(entered), entered / "board/archive/2024/photo.webp"
    path.unlink()
    write_bytes(photo, b"theirs")
    remove_parts(entered / "board")
    assert photo.is_file() and not sheet_path(path).exists()


@pytest.mark.parametrize("name", ["../../evil", "a/b", "..", ".hidden", "", "a\n", "CON", "aux.v2", "name.", "x" * 101])
def test_names_that_are_no_file_names_everywhere_are_refused(done: Path, name: str) -> None:
    edit_json(done / "out/results/tfp+4dgs.json", lambda r: r["method"].update(name=name))
    with pytest.raises(UserError) as e:
        enter(done, verified=False)
    assert "\n" not in str(e.value) and not (done / "board").exists()


@pytest.mark.parametrize("name", ["../../../out", "/tmp/out", "a/b", "..", "other"])
def test_the_datasets_name_leads_nowhere(done: Path, name: str) -> None:
    before = files_in(done)
    edit_json(done / "out/results/tfp+4dgs.json", lambda r: r["dataset"].update(name=name))
    with pytest.raises(UserError, match=r"expected the name pattern-0\+pattern-1|at dataset/name"):
        enter(done, verified=False)
    assert files_in(done).keys() == before.keys()


def test_names_that_differ_by_case_alone_are_refused(done: Path) -> None:
    """Whatever their seeds and their boards."""
    enter(done, "rough", verified=False)
    record = json.loads((done / "out/results/rough.json").read_text())
    part = of_scenes(record, ["pattern-1"])
    for number, (found, seed) in enumerate(itertools.product((record, part), (0, 5))):
        result = done / f"{number}.json"
        write_json(result, {**found, "method": {**found["method"], "name": "Rough", "seed": seed}})
        with pytest.raises(UserError, match=r"Rough.*\.json: expected a name that differs by more than case"):
            submit(result, leaderboard=done / "board")
        write_json(result, {**found, "method": {**found["method"], "seed": seed}})
        assert submit(result, leaderboard=done / "board") == 0


def test_a_seed_of_its_own_is_an_entry_of_its_own(done: Path) -> None:
    record = json.loads((done / "out/results/tfp+4dgs.json").read_text())
    assert entry_path(record).endswith("/tfp+4dgs.json")
    for seed in (7, 2**63 - 1):
        record["method"]["seed"] = seed
        write_json(done / "seeded.json", record)
        assert submit(done / "seeded.json", leaderboard=done / "board") == 0
        assert read(entry_of(done, f"tfp+4dgs@seed-{seed}"))["record"]["method"]["seed"] == seed
    for seed in (-1, 2**63, 10**30):
        record["method"]["seed"] = seed
        with pytest.raises(UserError, match="expected a seed from 0 up, of 64 bits"):
            entry_path(record)
    write_json(done / "seeded.json", record | {"method": record["method"] | {"seed": 2**63}})
    with pytest.raises(UserError):
        submit(done / "seeded.json", leaderboard=done / "board")


@pytest.mark.parametrize("value", [1e308, -1e16, 10**400, float("nan"), float("inf"), 1.0000001e15])
def test_numbers_out_of_bounds_are_refused(value: float) -> None:
    with pytest.raises(UserError, match=r"expected numbers within \+-1e\+15"):
        check_numbers({"a": [1, {"b": value}]}, Path("x"))
    with pytest.raises(UserError, match="expected numbers within"):
        check_numbers({"seed": [value]}, Path("x"))
    check_numbers({"a": [1e15, -3, None, True, "1e400"]}, Path("x"))


def test_a_huge_fit_time_blocks_nobody(done: Path) -> None:
    """Neither as a record nor, with a ledger line, as an entry."""
    path = enter(done, "rough", verified=False)
    text = path.read_text()
    for value in (10**400, "1e400", 1e308, "NaN"):
        record = json.loads((done / "out/results/tfp+4dgs.json").read_text())
        record["scenes"]["pattern-0"]["fit_seconds"] = "HUGE"
        (done / "huge.json").write_text(json.dumps(record).replace('"HUGE"', str(value)))
        with pytest.raises(UserError) as e:
            submit(done / "huge.json", leaderboard=done / "board")
        assert "\n" not in str(e.value)
        entry = json.loads(text)
        entry["record"]["scenes"]["pattern-0"]["fit_seconds"] = "HUGE"
        path.write_text(json.dumps(entry).replace('"HUGE"', str(value)))
        enter(done, verified=False)
        assert [item["entry"].rpartition("/")[2] for item in board(done)["refused"]] == ["rough.json"]


def test_a_ledger_line_without_its_entry_is_what_a_kill_leaves(done: Path, released: None) -> None:
    path = enter(done)
    entry = json.loads(path.read_bytes())
    path.unlink()
    assert read_entries(done / "board", "entries", "local") == ({}, {})
    write_entry(done / "board", entry["record"], entry["verification"], replace=False)
    write_boards(done / "board")
    assert read(entry_of(done, "tfp+4dgs"))["record"] == entry["record"]


def test_a_ledger_alone_is_a_leaderboard_that_was_being_made(done: Path, tmp_path: Path) -> None:
    (tmp_path / "board").mkdir()
    (tmp_path / "board/LEDGER").write_text("")
    assert submit(done / "out/results/rough.json", leaderboard=tmp_path / "board") == 0


def replace_entry(done: Path, monkeypatch: pytest.MonkeyPatch, killed_at: str = "") -> Path:
    """Replace an entry and its sheet; a process is killed as it calls a function of `entry`, if one is named."""
    path = entry_of(done)
    old = read(path)
    sheet = Thumbnails(webp(np.full((48, 120), 99, np.uint8), quality=50, method=6), {})
    stated = {**old["thumbnails"], "sha256": hashlib.sha256(sheet.sheet).hexdigest()}
    assert sheet_size(stated) == (120, 48)
    record = {**old["record"], "method": {**old["record"]["method"], "version": "9"}}

    def kill(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as changed, suppress(KeyboardInterrupt):
        if killed_at:
            changed.setattr(entry, killed_at, kill)
        write_entry(done / "board", record, old["verification"], True, replace(sheet, stated=stated))
    return path


@pytest.mark.parametrize("killed_at", ["write_bytes", "write_json", "sheet_path", "mark_replaced"])
def test_a_replacement_that_was_killed_leaves_an_entry_with_its_sheet(
    entered: Path, monkeypatch: pytest.MonkeyPatch, problems: Any, killed_at: str
) -> None:
    path = replace_entry(entered, monkeypatch, killed_at)
    written = json.loads(path.read_text())["record"]["method"]["version"] == "9"
    assert written == (killed_at in ("sheet_path", "mark_replaced"))
    enter(entered, "bad", verified=False)  # any submission tidies up, and makes the boards
    assert not problems(entered) and not list(path.parent.glob(".*.webp"))
    replace_entry(entered, monkeypatch)
    enter(entered, "rough", verified=False)
    assert not problems(entered) and read(path)["record"]["method"]["version"] == "9"


def test_an_earlier_entry_that_was_put_back_is_noticed(
    entered: Path, monkeypatch: pytest.MonkeyPatch, problems: Any
) -> None:
    path, board = entry_of(entered), entered / "board"
    earlier, sheet, ledger = path.read_bytes(), sheet_path(path).read_bytes(), (board / "LEDGER").read_text()
    replace_entry(entered, monkeypatch)
    path.write_bytes(earlier)
    sheet_path(path).write_bytes(sheet)
    assert any("expected an entry as LEDGER lists it" in line for line in problems(entered))
    lines = (board / "LEDGER").read_text().splitlines()
    assert sorted(line.endswith("  replaced") for line in lines) == [False, True]
    assert {line.removesuffix("  replaced") for line in lines} > set(ledger.splitlines())
    enter(entered, replace=True)  # who submits it again may put it back
    assert not problems(entered)


def test_an_entry_that_was_removed_is_noticed_unless_its_lines_go_too(entered: Path, problems: Any) -> None:
    enter(entered, "rough", verified=False)
    path = entry_of(entered)
    sheet_path(path).unlink()
    path.unlink()
    write_boards(entered / "board")
    (line,) = problems(entered)
    assert f"{path}: expected an entry, as LEDGER has a line of it, found none; restore it" in line
    ledger = entered / "board/LEDGER"
    ledger.write_text("".join(line for line in ledger.read_text().splitlines(True) if "tfp+4dgs" not in line))
    assert not problems(entered)
    ledger.write_text(f"{'0' * 64}  archive/a@0/a.json\n" + ledger.read_text())
    assert not problems(entered), "as the package has no archive"
    (entered / "board/archive").mkdir()
    assert len(problems(entered)) == 1


@pytest.mark.slow
def test_submitters_at_once_and_killed_lose_nothing(done: Path, tmp_path: Path) -> None:
    """Forks of a process of their own: each fork of one that has run many tests copies tables of gigabytes of pages."""
    command = [sys.executable, submitters.__file__, str(tmp_path), str(done / "out/results/rough.json"), "4", "8"]
    found = subprocess.run(command, capture_output=True, text=True, check=False)
    expected = rf"4 submitters, 8 kills, \d+ s: exit codes {re.escape(str([0] * 4))}, lost \[\], same boards True\n"
    assert re.fullmatch(expected, found.stdout), found.stdout + found.stderr


def test_a_lock_that_is_never_released_ends_in_a_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(entry, "WAIT_S", 0.2)
    message = "expected a leaderboard that other submissions leave in time, found a run"
    with locked(tmp_path / ".lock", tmp_path, "nobody"), pytest.raises(UserError, match=message):
        entry.lock(tmp_path).__enter__()
    with entry.lock(tmp_path):
        pass
