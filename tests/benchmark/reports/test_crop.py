"""Crops contain what moves, have one size, and stay where they are as long as they can."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from spike4dgs.benchmark.reports.panels import SMALLEST, bounds, crops


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.floats(0.0005, 0.2))
def test_every_crop_contains_its_mask_and_all_have_one_size(seed: int, count: int, density: float) -> None:
    rng = np.random.default_rng(seed)
    height, width = (int(v) for v in rng.integers(8, 90, 2))
    masks = [rng.random((height, width)) < density * rng.integers(0, 2) for _ in range(count)]
    found = crops(masks)
    assert [box is None for box in found] == [not mask.any() for mask in masks]
    boxes = [box for box in found if box]
    assert len({(box.width, box.height) for box in boxes}) <= 1
    for mask, box in zip(masks, found, strict=True):
        if box:
            assert box.of(mask).sum() == mask.sum() and box.of(mask).shape == (box.height, box.width)
            assert box.x >= 0 and box.y >= 0 and box.x + box.width <= width and box.y + box.height <= height


def test_a_crop_stands_still_where_the_motion_is_small_and_follows_where_it_is_large() -> None:
    def clip(step: int) -> list[np.ndarray]:
        masks = [np.zeros((80, 400), bool) for _ in range(4)]
        for k, mask in enumerate(masks):
            mask[20:50, 10 + step * k : 60 + step * k] = True
        return masks

    still, following = crops(clip(2)), crops(clip(90))
    assert len(set(still)) == 1 and still[0] is not None and still[0].width == round(56 * 1.3)
    assert len(set(following)) == 4 and following[0] is not None and following[0].width == 65, "50 and its margins"
    # The left edge is 7.5 pixels before what moves, but for the first, which the image's edge stops.
    assert [box.x for box in following if box] == [3, 93, 183, 273]


def test_crops_hold_some_context_and_end_with_the_image() -> None:
    masks = [np.zeros((60, 90), bool) for _ in range(3)]
    masks[0][5:15, 0:30] = masks[1][30:60, 70:80] = True
    found = crops(masks)
    assert found[2] is None and found[0] is not None and found[0][2:] == (39, 39)
    small = np.zeros((60, 90), bool)
    small[10, 10] = True
    assert crops([small])[0] == (0, 0, SMALLEST, SMALLEST)
    assert bounds(small) == (10, 10, 1, 1) and bounds(np.zeros((2, 2), bool)) is None
