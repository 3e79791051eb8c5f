"""Records of oracles, which were given the truth: nothing of a leaderboard or a season takes them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from dummy_methods import CountMethod, run
from small_scenes import write_small_scene
from submissions import edit_with_ledger, entry_of, read, submit

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.runs.predictions import read_info
from spike4dgs.benchmark.runs.record import read_record
from spike4dgs.cli.submit import submit_all
from spike4dgs.leaderboard.reading import read_entries
from spike4dgs.leaderboard.season.results import Result, write_result

REFUSED = r"expected a method that fits from spikes, found an oracle \(images, steps\)"


@pytest.fixture
def ran(tmp_path: Path) -> Path:
    """The run of an oracle, and of the method itself, on one scene."""
    marked = CountMethod("counts+oracle-images-steps")
    marked.oracle = ("images", "steps")  # type: ignore[attr-defined]
    run(tmp_path / "out", [write_small_scene(tmp_path / "s0")], CountMethod("counts"), marked, metrics=("psnr",))
    return tmp_path


def record_of(ran: Path, name: str = "counts+oracle-images-steps") -> Path:
    return ran / f"out/results/{name}.json"


def test_predictions_and_records_say_what_an_oracle_replaced(ran: Path) -> None:
    folder = ran / "out/predictions/counts+oracle-images-steps/pattern-0"
    assert read_info(folder).method.oracle == ("images", "steps")
    assert read_record(record_of(ran))["method"]["oracle"] == ["images", "steps"]
    assert "oracle" not in read_record(record_of(ran, "counts"))["method"]


@pytest.mark.parametrize("verified", [False, True])
def test_submit_refuses_an_oracle_and_takes_the_method_itself(ran: Path, verified: bool) -> None:
    def files(name: str) -> dict[str, Any]:
        return {"predictions": ran / "out/predictions" / name, "scenes": (ran / "s0",)} if verified else {}

    board = ran / "board"
    assert submit(record_of(ran, "counts"), leaderboard=board, **files("counts")) == 0
    with pytest.raises(UserError, match=REFUSED):
        submit(record_of(ran), leaderboard=board, **files("counts+oracle-images-steps"))
    found, _ = read_entries(board, "local")
    assert [e["record"]["method"]["name"] for e in found.values()] == ["counts"]


def test_a_run_that_submits_all_refuses_it_too(ran: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = {record_of(ran): None, record_of(ran, "counts"): None}
    assert submit_all(results, scenes=(), leaderboard=ran / "board") == 1
    assert "found an oracle (images, steps)" in capsys.readouterr().err


def test_a_record_without_the_mark_does_not_fit_its_predictions(ran: Path) -> None:
    record = json.loads(record_of(ran).read_text())
    del record["method"]["oracle"]
    record_of(ran).write_text(json.dumps(record))
    predictions = ran / "out/predictions/counts+oracle-images-steps"
    with pytest.raises(UserError, match="expected predictions of counts.oracle-images-steps as in the record"):
        submit(record_of(ran), predictions=predictions, scenes=(ran / "s0",), leaderboard=ran / "board")


def test_an_entry_that_was_put_into_the_folder_is_refused_by_who_reads_it(entered: Path) -> None:
    path = entry_of(entered)
    edit_with_ledger(path, lambda entry: entry["record"]["method"].update(oracle=["images", "steps"]))
    with pytest.raises(UserError, match=REFUSED):
        read(path)


def test_a_season_takes_none(ran: Path) -> None:
    with pytest.raises(UserError, match=REFUSED):
        write_result(ran / "seasons", 1, Result("method", read_record(record_of(ran))))
