"""Reprojection errors of marked points: exact cameras, wrong ones, and lenses."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from small_scenes import array_cameras

from spike4dgs.benchmark.exchange.marked_points import MarkedPoints
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.self_calibration.reprojection import reprojection

POINTS = np.random.default_rng(0).uniform(-0.4, 0.4, (30, 3))
CAMERAS = array_cameras(4, 400, 240)  # narrow: the triangulation's weight at infinity moves projections by 0.001 px


def marks(cameras: Sequence[Camera], unseen: set[tuple[str, int]] = frozenset()) -> MarkedPoints:  # type: ignore[assignment]
    seen = [(c.id, p, uv) for c in cameras for p, uv in enumerate(c.project(POINTS)[0]) if (c.id, p) not in unseen]
    return MarkedPoints(
        tuple(s[0] for s in seen), tuple(("0", str(s[1])) for s in seen), np.array([s[2] for s in seen])
    )


@pytest.mark.parametrize("lens", [(), (-0.3, 0.1, 0.001, -0.002, 0.0)])
def test_exact_cameras_have_no_errors(lens: tuple[float, ...]) -> None:
    cameras = [replace(c, distortion=lens) for c in CAMERAS]
    for errors in reprojection(cameras, marks(cameras)).values():
        assert len(errors.together) == len(errors.left_out) == len(POINTS)
        assert errors.together.max() < 2e-3 and errors.left_out.max() < 2e-3


def test_a_camera_that_is_off_shows_most_where_it_is_left_out() -> None:
    marked = marks(CAMERAS)
    moved = [replace(c, cy=c.cy + 5) if c.id == "cam_01" else c for c in CAMERAS]
    found = reprojection(moved, marked)
    np.testing.assert_allclose(found["cam_01"].left_out, 5, atol=2e-3)  # the other three are right
    assert found["cam_01"].together.mean() < 5
    assert all(found[c.id].left_out.max() < found["cam_01"].left_out.min() for c in CAMERAS if c.id != "cam_01")


def test_points_of_one_camera_and_marks_of_strangers_count_not() -> None:
    unseen = {(c.id, 0) for c in CAMERAS[1:]} | {(c.id, 1) for c in CAMERAS[2:]}
    found = reprojection(CAMERAS[:3], marks(CAMERAS, unseen))
    assert [len(found[c.id].together) for c in CAMERAS[:3]] == [29, 29, 28]  # point 0 is seen once
    assert [len(found[c.id].left_out) for c in CAMERAS[:3]] == [28, 28, 28]  # point 1 twice
    assert set(found) == {c.id for c in CAMERAS[:3]}


def test_no_marks_are_no_errors() -> None:
    found = reprojection(CAMERAS, MarkedPoints((), (), np.zeros((0, 2))))
    assert all(len(e.together) == len(e.left_out) == 0 for e in found.values())
