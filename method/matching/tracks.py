"""Matches between views, and the tracks that they make: each begins at a pixel of an anchor view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from spike4dgs.benchmark.arrays import Float64, Int64


@dataclass(frozen=True, eq=False)
class PairMatches:
    """M matches of points of a view r in a view j."""

    point: Int64  # [M] number of the point in view r, the same for all j
    at: Float64  # [M, 2] px, in r
    uv: Float64  # [M, 2] px, in j
    error: Float64  # [M] px, expected of each coordinate of uv


Matches = Mapping[tuple[int, int], PairMatches]  # by ordered pair of views (r, j)


@dataclass(frozen=True, eq=False)
class Tracks:
    """N points, each a pixel of its anchor view, and M sights of them by other views."""

    anchor: Int64  # [N] view
    at: Float64  # [N, 2] px
    track: Int64  # [M] number of the point that is seen
    view: Int64  # [M] by which
    uv: Float64  # [M, 2] px
    error: Float64  # [M] px

    def where(self, kept: np.ndarray) -> Tracks:
        """Return the tracks with some of the sights [M] bool; the points stay."""
        return Tracks(self.anchor, self.at, self.track[kept], self.view[kept], self.uv[kept], self.error[kept])


def make_tracks(matches: Matches, most: int, rng: np.random.Generator) -> Tracks:
    """Return the tracks of matches; of each anchor view at most `most`, those that most views see first."""
    anchors, at, track, view, uv, error = [], [], [], [], [], []
    first = 0
    for r in sorted({pair[0] for pair in matches}):
        mine = {j: m for (i, j), m in sorted(matches.items()) if i == r and len(m.point)}
        if not mine:
            continue
        points, counts = np.unique(np.concatenate([m.point for m in mine.values()]), return_counts=True)
        order = np.lexsort((rng.random(len(points)), -counts))[:most]
        kept = np.sort(points[order])
        place = np.zeros((len(kept), 2))
        for j, m in mine.items():
            number = np.searchsorted(kept, m.point).clip(max=len(kept) - 1)
            used = kept[number] == m.point
            place[number[used]] = m.at[used]
            track.append(first + number[used])
            view.append(np.full(int(used.sum()), j))
            uv.append(m.uv[used])
            error.append(m.error[used])
        anchors.append(np.full(len(kept), r))
        at.append(place)
        first += len(kept)
    if not anchors:
        none = np.zeros(0, np.int64)
        return Tracks(none, np.zeros((0, 2)), none, none, np.zeros((0, 2)), np.zeros(0))
    return Tracks(*(np.concatenate(x) for x in (anchors, at, track, view, uv, error)))
