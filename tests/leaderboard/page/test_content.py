"""What the page is given of a board, against the records and the published tables."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from page_boards import board, cell, failed, row

from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.leaderboard.page.content import board_content, details, page_metrics
from spike4dgs.leaderboard.page.rows import Board, find_board
from spike4dgs.leaderboard.page.scores import compare_rows, image_scores, rounded

COMMITTED = Path(__file__).resolve().parents[3] / "leaderboard"


def test_cells_are_those_of_the_entry_and_published_values_those_of_the_paper(committed: list[Board]) -> None:
    found = find_board(committed, "ideal")
    content = board_content(found, "ideal")
    number = {m["id"]: i for i, m in enumerate(page_metrics())}
    index = next(i for i, r in enumerate(content["rows"]) if r["name"] == "tfp+4dgs")
    folder = next((COMMITTED / "entries").glob("2-ideal@*"))
    record = json.loads((folder / "tfp+4dgs.json").read_text())["record"]
    for s, scene in enumerate(content["scenes"]):
        values = content["rows"][index]["cells"][s]["v"]
        expected = record["scenes"][scene["id"]]
        assert values[number["psnr"]] == pytest.approx(expected["metrics"]["psnr"], rel=1e-6)
        assert values[number["fit_seconds"]] == pytest.approx(expected["fit_seconds"], rel=1e-6)
        assert scene["revision"] == record["dataset"]["scenes"][scene["id"]]
    # Tables 1 and 2 of the paper, TFP + 4DGS. Table 2 has no PSNR.
    assert [scene["id"].split("-")[0] for scene in content["scenes"]] == sorted(
        ["jaywalk", "bicycle", "motor", "car", "van", "bricks", "chips", "turntable", "bird"]
    )
    values = content["published"]["rows"][str(index)]
    assert values["psnr"] == [27.15, None, None, 25.01, None, 27.96, 26.57, None, 25.27]
    assert [v is None for v in values["brisque"]] == [v is not None for v in values["psnr"]]
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
    public = board_content(find_board(committed, "ideal"), "o")
    assert [scene["sensor"] for scene in public["scenes"]] == ["noisy"] * 9
    other = board_content(find_board(committed, "car-0-paper"), "c")
    assert [scene["sensor"] for scene in other["scenes"]] == ["not stated"], "an older record, not of the release"
    made = [row(name, {"s": cell({"psnr": np.ones(2)}), "t": cell({"psnr": np.ones(2)})}) for name in "ab"]
    made[0].first["sensors"] = {"s": "ideal", "t": "noisy"}
    made[1].first["sensors"] = {"s": "ideal"}
    assert [scene["sensor"] for scene in board_content(board("b", made), "b")["scenes"]] == ["ideal", "noisy"]


def test_the_hardware_is_that_of_the_fit() -> None:
    nowhere = {"environment": None, "harness": None}
    rows = [row("a", {"s": cell({}), "t": failed()}), row("b", dict.fromkeys("st", cell({}, fitted_with=nowhere)))]
    assert [r["hardware"] for r in board_content(board("b", rows), "b")["rows"]] == ["a CPU", "not stated"]


def test_a_metric_that_nobody_computed_again_gives_no_rank() -> None:
    """A false LPIPS, where the verifier lacked the weights."""
    values = {"psnr": np.full(2, 20.0), "lpips_vgg": np.full(2, 0.3)}
    honest, false = row("honest", {"s": cell(values)}), row("false", {"s": cell({**values, "lpips_vgg": np.zeros(2)})})
    refit = {"verification": {"unverified": ["lpips_vgg"], "refit": None}}
    false = replace(false, entries={"local/s@0/false.json": refit})
    scores = image_scores(board("b", [honest, false]), "lpips_vgg")
    assert list(scores.values) == [0]
    assert scores.left_out == {1: f"{METRICS['lpips_vgg'].title} as claimed: nobody computed it again"}
    assert list(image_scores(board("b", [honest, false]), "psnr").values) == [0, 1]
    content = board_content(board("b", [honest, false]), "b")
    assert [r["unverified"] for r in content["rows"]] == [[], ["lpips_vgg"]]


def test_rows_are_compared_where_every_image_has_a_score() -> None:
    a, b = np.array([30.0, 31.0]), np.array([20.0, 21.0])
    rows = [
        row("good", {"s": cell({"psnr": a})}),
        row("worse", {"s": cell({"psnr": b})}),
        row("failed", {"s": failed()}, why="s failed"),
        row("claimed", {"s": cell({"psnr": a})}, ranked=False, why="nothing was computed again"),
        row("short", {"s": cell({"psnr": a[:1]})}),
    ]
    scores = image_scores(board("b", rows), "psnr")
    assert scores.images == [["cam_03/000000", "cam_03/000020"]]
    assert list(scores.values) == [0, 1]
    assert scores.left_out == {2: "s failed", 3: "nothing was computed again", 4: "no PSNR of 1 images"}
    comparison = compare_rows(scores, "psnr")
    assert comparison is not None and comparison.means.tolist() == [30.5, 20.5]
    nothing = image_scores(board("b", rows), "flip")
    assert not nothing.values and compare_rows(nothing, "flip") is None


def test_images_without_a_score_in_any_row_have_no_part() -> None:
    values = np.array([1.0, 2.0, 3.0])
    rows = [row(name, {"s": cell({"temporal_error": values})}) for name in ("a", "b")]
    for r in rows:
        r.first["scenes"]["s"]["per_image"]["cam_03/000000"]["temporal_error"] = None
    scores = image_scores(board("b", rows), "temporal_error")
    assert scores.images == [["cam_03/000020", "cam_03/000040"]] and len(scores.values) == 2


def test_numbers_keep_seven_digits() -> None:
    assert rounded(39.8697538919) == 39.86975 and rounded(None) is None and rounded(0.00123456789) == 0.001234568
