"""Crops of what moves: one box, in every image of a clip, so that methods and times can be compared."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

Value = TypeVar("Value", bound=np.generic)
MARGIN = 0.15  # around what moves, of its size
SMALLEST = 24  # pixels of a crop's side: smaller ones show no context
STILL = (
    1.5  # a box that holds all of the motion stays where it is if its area is at most so many times a following one's
)


class Box(NamedTuple):
    """A part of an image, in pixels; x and y of its upper left corner."""

    x: int
    y: int
    width: int
    height: int

    @property
    def area(self) -> int:
        """Pixels."""
        return self.width * self.height

    def of(self, image: NDArray[Value]) -> NDArray[Value]:
        """Return this part of an image [H, W, ...], a view."""
        return image[self.y : self.y + self.height, self.x : self.x + self.width]


def crops(moving: Sequence[NDArray[np.bool_]]) -> list[Box | None]:
    """Return a box around what moves in each image [H, W] of a clip, all of one size; None where nothing does.

    The box is the same in all images where that costs little (`STILL`), so that the motion is seen; otherwise it
    follows what moves.
    """
    tight = [bounds(mask) for mask in moving]
    known = [box for box in tight if box]
    if not known:
        return [None] * len(tight)
    height, width = moving[0].shape
    following = _widened([b.width for b in known], [b.height for b in known], width, height)
    whole = bounds(np.logical_or.reduce(list(moving)))
    assert whole is not None
    still = _widened([whole.width], [whole.height], width, height)
    if still[0] * still[1] <= STILL * following[0] * following[1]:
        box = _centred(whole, *still, width, height)
        return [box if own else None for own in tight]
    return [_centred(box, *following, width, height) if box else None for box in tight]


def _widened(widths: list[int], heights: list[int], width: int, height: int) -> tuple[int, int]:
    """Return the size of the largest box with its margin, within the image."""
    w, h = (max(SMALLEST, *(round(side * (1 + 2 * MARGIN)) for side in sides)) for sides in (widths, heights))
    return min(width, w), min(height, h)


def _centred(box: Box, w: int, h: int, width: int, height: int) -> Box:
    x, y = box.x + box.width // 2 - w // 2, box.y + box.height // 2 - h // 2
    return Box(min(max(x, 0), width - w), min(max(y, 0), height - h), w, h)


def bounds(mask: NDArray[np.bool_]) -> Box | None:
    """Return the smallest box around the pixels that are true; None where there are none."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return None
    x, y = int(columns[0]), int(rows[0])
    return Box(x, y, int(columns[-1]) + 1 - x, int(rows[-1]) + 1 - y)
