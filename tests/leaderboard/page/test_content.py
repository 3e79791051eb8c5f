"""What the page is given of a board, against the records and the published tables."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from page_boards import board, cell, failed, row

from spike4dgs.leaderboard.page.content import board_content, details, page_metrics
from spike4dgs.leaderboard.page.rows import Board, find_board

COMMITTED = Path(__file__).resolve().parents[3] / "leaderboard"


def test_cells_are_those_of_the_entry_and_published_values_those_of_the_paper(committed: list[Board]) -> None:
    found = find_board(committed, "outdoor-small")
    content = board_content(found, "outdoor-small")
    number = {m["id"]: i for i, m in enumerate(page_metrics())}
    index = next(i for i, r in enumerate(content["rows"]) if r["name"] == "tfp+4dgs")
    folder = next((COMMITTED / "entries").glob("1-outdoor-small@*"))
    record = json.loads((folder / "tfp+4dgs.json").read_text())["record"]
    for s, scene in enumerate(content["scenes"]):
        values = content["rows"][index]["cells"][s]["v"]
        expected = record["scenes"][scene["id"]]
        assert values[number["psnr"]] == pytest.approx(expected["metrics"]["psnr"], rel=1e-6)
        assert values[number["fit_seconds"]] == pytest.approx(expected["fit_seconds"], rel=1e-6)
        assert scene["revision"] == record["dataset"]["scenes"][scene["id"]]
    # Table 1 of the paper, TFP + 4DGS, in the order bicycle, car, jaywalk, motor, van.
    assert content["published"]["rows"][str(index)]["psnr"] == [27.15, 25.01, 27.96, 26.57, 25.27]
    own = next(i for i, r in enumerate(content["rows"]) if r["name"] == "spike4dgs-x")
    assert str(own) not in content["published"]["rows"], "the paper has no such method"
    (entry,) = details(found)[index]["entries"]
    assert f"{entry['sha256']}  {entry['path']}" in (COMMITTED / "LEDGER").read_text()
    assert details(found)[index]["records"][0]["command"] == record["command"]


def test_a_failed_cell_has_no_value_and_a_reason() -> None:
    content = board_content(board("b", [row("a", {"s": cell({"psnr": np.ones(2)}), "t": failed("boom")})]), "b")
    assert content["rows"][0]["cells"][1]["why"] == "failed: boom"
    assert set(content["rows"][0]["cells"][1]["v"]) == {None}
    assert content["rows"][0]["parts"]["images"] == "tfp" and content["rows"][0]["budget"] == "1 x quick"
    assert content["published"] is None


def test_sensors_are_the_releases_or_what_records_state(committed: list[Board]) -> None:
    public = board_content(find_board(committed, "outdoor-small"), "o")
    assert [scene["sensor"] for scene in public["scenes"]] == ["noisy"] * 5
    other = board_content(find_board(committed, "car-0-paper"), "c")
    assert [scene["sensor"] for scene in other["scenes"]] == ["not stated"], "an older record, not of the release"
    made = [row(name, {"s": cell({"psnr": np.ones(2)}), "t": cell({"psnr": np.ones(2)})}) for name in "ab"]
    made[0].first["sensors"] = {"s": "ideal", "t": "noisy"}
    made[1].first["sensors"] = {"s": "ideal"}
    assert [scene["sensor"] for scene in board_content(board("b", made), "b")["scenes"]] == ["ideal", "noisy"]
