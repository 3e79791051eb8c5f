"""Points that somebody marked in an array's images, such as a body's joints: a CSV of camera, frame, point, x, y.

x and y are pixels as OpenCV and the trackers of keypoints count them: 0, 0 is the centre of the first pixel.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.arrays import Float64
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.exchange.foreign_camera import CENTRE
from spike4dgs.benchmark.files import read_text
from spike4dgs.benchmark.untrusted import MAX_LENGTH, shown

COLUMNS = ("camera", "frame", "point", "x", "y")
_WHAT = "points marked in images"
_MOST_BYTES = 1 << 26  # about two million points


@dataclass(frozen=True, eq=False)
class MarkedPoints:
    """N observations: `of[i]` is the (frame, point) that `camera[i]` sees at `uv[i]`, pixel centres at +0.5."""

    camera: tuple[str, ...]
    of: tuple[tuple[str, str], ...]
    uv: Float64  # [N, 2]


def read_marked_points(path: Path) -> MarkedPoints:
    """Read a CSV with a head line. Raises UserError for other columns, bad numbers, and a point marked twice."""
    try:
        text = read_text(path, _WHAT, _MOST_BYTES).removeprefix("\ufeff")  # spreadsheets write it first
        reader = csv.reader(io.StringIO(text, newline=""))
        rows = [(reader.line_num, row) for row in reader if row]
    except (ValueError, csv.Error) as e:
        raise problem(path, f"{_WHAT} (CSV)", f"damaged text ({str(e)[:200]})", "write it again") from None
    if not rows or tuple(rows[0][1]) != COLUMNS:
        found = shown(",".join(rows[0][1]) if rows else "")
        raise problem(path, f"a head line {','.join(COLUMNS)}", found, "write these columns")
    cameras, points, uv, known = [], [], [], set()
    for line, row in rows[1:]:
        try:
            camera, frame, point, x, y = row
            at = float(x) + CENTRE, float(y) + CENTRE
            if not all(math.isfinite(v) and abs(v) < MAX_LENGTH for v in at):
                raise ValueError
        except ValueError:
            expected = "camera, frame, point and two finite numbers"
            raise problem(f"{path}, line {line}", expected, shown(",".join(row)), "correct it") from None
        if (camera, frame, point) in known:
            raise problem(f"{path}, line {line}", "a point once in a frame", shown(",".join(row)), "remove one")
        known.add((camera, frame, point))
        cameras.append(camera)
        points.append((frame, point))
        uv.append(at)
    return MarkedPoints(tuple(cameras), tuple(points), np.array(uv, np.float64).reshape(-1, 2))
