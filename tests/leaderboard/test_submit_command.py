from __future__ import annotations

import inspect
import json
from pathlib import Path
from typing import Any

import pytest
from dummy_methods import CountMethod, run
from submissions import edit, enter, everything

from spike4dgs.benchmark.errors import UserError
from spike4dgs.leaderboard.entry import read_entry
from spike4dgs.leaderboard.submit_command import submit


def test_with_files_an_entry_is_verified(done: Path, capsys: pytest.CaptureFixture[str]) -> None:
    entry = read_entry(enter(done))
    assert entry["label"] == "verified"
    assert entry["record"] == json.loads((done / "out/results/tfp+4dgs.json").read_text())
    assert capsys.readouterr().out == "tfp+4dgs: verified, rank 1 of 1 on pattern-0+pattern-1\n"


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ((), "no --predictions"),
        (("scenes",), "no --predictions"),
        (("predictions",), "no --scenes for pattern-0, pattern-1"),
        (("predictions", "one"), "no --scenes for pattern-1"),
    ],
)
def test_without_files_an_entry_is_self_reported(
    done: Path, given: tuple[str, ...], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    options: dict[str, Any] = {"predictions": done / "out/predictions/tfp+4dgs"} if "predictions" in given else {}
    options |= {"scenes": (done / "s0", done / "s1")} if "scenes" in given else {}
    options |= {"scenes": (done / "s0",)} if "one" in given else {}
    assert read_entry(enter(done, verified=False, **options))["label"] == "self-reported"
    assert f"self-reported ({reason}), rank 1" in capsys.readouterr().out


def test_submitting_twice_changes_nothing(done: Path) -> None:
    enter(done)
    before = everything(done / "board")
    enter(done)
    assert everything(done / "board") == before
    enter(done, verified=False)
    assert everything(done / "board") == before, "a verified entry stays so"


def test_scoring_again_is_the_same_record(done: Path) -> None:
    enter(done)
    before = everything(done / "board")
    edit(done / "out/results/tfp+4dgs.json", lambda r: r.update(created="2031-01-01T00:00:00Z", command="another"))
    enter(done)
    assert everything(done / "board") == before


def test_a_self_reported_entry_can_be_verified_later(done: Path) -> None:
    submitted = read_entry(enter(done, verified=False))["submitted"]
    entry = read_entry(enter(done))
    assert (entry["label"], entry["submitted"]) == ("verified", submitted)


def test_another_record_needs_replace(done: Path) -> None:
    path = enter(done)
    before = path.read_bytes()
    run(done / "out", [done / "s0", done / "s1"], CountMethod("tfp+4dgs", steps=2))
    with pytest.raises(UserError, match=r"tfp\+4dgs\.json: expected no entry .* found another record; pass --replace"):
        enter(done)
    assert path.read_bytes() == before
    enter(done, replace=True)
    assert read_entry(path)["record"]["method"]["params"] == {"steps": 2}


def test_the_default_folder_is_the_repositorys() -> None:
    assert inspect.signature(submit).parameters["leaderboard"].default == Path("leaderboard")
