"""The images by which rows are compared."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from spike4dgs.leaderboard.page.scores import ImageScores, image_scores


def scores_of(*rows: str) -> ImageScores:
    """Scores of rows on one scene, from the names of the images, a letter each, that a row has a score of."""
    found = []
    for names in rows:
        per_image = {name: {"psnr": 20.0 if name in names else None} for name in sorted({*names, "z"})}
        record = {"scenes": {"car-0-tiny": {"per_image": per_image}}}
        found.append(SimpleNamespace(ranked=True, why="", unverified=[], records=[record]))
    return image_scores(cast(Any, SimpleNamespace(rows=found, scenes=["car-0-tiny"])), "psnr")


def test_an_image_of_one_row_alone_does_not_unrank_the_others() -> None:
    found = scores_of("abc", "abc", "abcx")
    assert found.images == [["a", "b", "c"]] and set(found.values) == {0, 1, 2} and not found.left_out
    found = scores_of("abc", "abx")
    assert found.images == [["a", "b"]] and not found.left_out


def test_a_row_that_lacks_images_of_most_is_left_out_and_one_without_any_does_not_count() -> None:
    found = scores_of("abc", "ab", "abc", "", "", "", "")
    assert found.images == [["a", "b", "c"]] and set(found.values) == {0, 2}
    assert found.left_out[1] == "no PSNR of 1 images" and found.left_out[3] == "no PSNR of 3 images"
    assert set(scores_of("", "").left_out.values()) == {"no scores"}
