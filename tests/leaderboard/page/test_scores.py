"""Which rows are compared, and by which images."""

from __future__ import annotations

import numpy as np
from page_boards import board, cell, failed, row

from spike4dgs.leaderboard.page.scores import compare_rows, image_scores, rounded


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


def test_images_without_a_score_in_any_row_have_no_part() -> None:
    values = np.array([1.0, 2.0, 3.0])
    rows = [row(name, {"s": cell({"temporal_error": values})}) for name in ("a", "b")]
    for r in rows:
        r.first["scenes"]["s"]["per_image"]["cam_03/000000"]["temporal_error"] = None
    scores = image_scores(board("b", rows), "temporal_error")
    assert scores.images == [["cam_03/000020", "cam_03/000040"]] and len(scores.values) == 2


def test_a_metric_that_nobody_has_compares_nothing() -> None:
    scores = image_scores(board("b", [row("a", {"s": cell({"psnr": np.ones(2)})})]), "flip")
    assert not scores.values and compare_rows(scores, "flip") is None


def test_numbers_keep_seven_digits() -> None:
    assert rounded(39.8697538919) == 39.86975 and rounded(None) is None and rounded(0.00123456789) == 0.001234568
