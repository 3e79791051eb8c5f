"""The scores of a board image by image, and its methods compared by them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.variants import world_of
from spike4dgs.leaderboard.page.intervals import Comparison, compare
from spike4dgs.leaderboard.page.rows import Board, Row

DIGITS = 7  # significant ones of a score on the page: more than any metric is accurate to


@dataclass(frozen=True)
class ImageScores:
    """One metric on a board.

    `images`: for each scene the names of the images that every compared row has a score of. `values`: for each of
    these rows, by its number on the board, and each scene the scores [images, seeds]. `left_out`: why other rows are
    not compared, by number.
    """

    images: list[list[str]]
    values: dict[int, list[Float64]]
    left_out: dict[int, str]
    worlds: list[str]  # of each scene


def rounded(value: float | None) -> float | None:
    """Return a number with `DIGITS` significant digits: what the page has, so that it computes the same."""
    return None if value is None else float(f"{value:.{DIGITS}g}")


def image_scores(board: Board, metric: str) -> ImageScores:
    """Return the scores of a metric.

    A row is compared if it may be ranked, the metric was computed again from its images, and it has a score for every
    image that most of these rows have one for, of those that have any: one row does not decide for all. An image
    without a score in every row, such as the first of a temporal error, has no part in any mean.
    """
    left_out = {i: row.why or "not ranked" for i, row in enumerate(board.rows) if not row.ranked}
    claimed = f"{METRICS[metric].title} as claimed: nobody computed it again"
    left_out |= {i: claimed for i, row in enumerate(board.rows) if row.ranked and metric in row.unverified}
    scored = {i: _scored(row, board.scenes, metric) for i, row in enumerate(board.rows) if i not in left_out}
    images = [_of_most([names[s] for names in scored.values()]) for s in range(len(board.scenes))]
    for i, names in scored.items():
        lacking = sum(len(set(u) - n) for u, n in zip(images, names, strict=True))
        if lacking or not all(images):
            left_out[i] = f"no {METRICS[metric].title} of {lacking} images" if lacking else "no scores"
    values = {i: [] if i in left_out else _values(board.rows[i], board.scenes, images, metric) for i in scored}
    return ImageScores(images, {i: v for i, v in values.items() if v}, left_out, list(map(world_of, board.scenes)))


def _scored(row: Row, scenes: list[str], metric: str) -> list[set[str]]:
    """Return for each scene the images that have a score from every seed."""
    return [
        set.intersection(
            *(
                {name for name, values in r["scenes"][scene]["per_image"].items() if values[metric] is not None}
                for r in row.records
            )
        )
        for scene in scenes
    ]


def _of_most(scored: list[set[str]]) -> list[str]:
    """Return the images of a scene that more than half of the rows have a score of; rows without any do not count."""
    counts = Counter(name for names in scored for name in names)
    rows = sum(map(bool, scored))
    return sorted(name for name, count in counts.items() if 2 * count > rows)


def _values(row: Row, scenes: list[str], images: list[list[str]], metric: str) -> list[Float64]:
    """Return the scores [images, seeds] of each scene, as `rounded` gives them: all of a scene in one text."""
    found = []
    for scene, names in zip(scenes, images, strict=True):
        of_seeds = [record["scenes"][scene]["per_image"] for record in row.records]
        scores = tuple(per_image[name][metric] for name in names for per_image in of_seeds)
        texts = (f"%.{DIGITS}g " * len(scores) % scores).split()
        found.append(np.array(list(map(float, texts)), np.float64).reshape(len(names), -1))
    return found


def compare_rows(scores: ImageScores, metric: str) -> Comparison | None:
    """Return the comparison of the rows in `scores.values`, in their order; None where there is none to compare."""
    if not scores.values:
        return None
    return compare(list(scores.values.values()), METRICS[metric].higher_is_better, scores.worlds)
