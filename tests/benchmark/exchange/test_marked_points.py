"""CSV files of points marked in images."""

from pathlib import Path

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.exchange.marked_points import read_marked_points

HEAD = "camera,frame,point,x,y\n"


def test_pixel_centres_move_from_whole_numbers_to_a_half(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text(HEAD + "cam_0,0,knee,10,20.5\ncam_1,0,knee,-1,3\n")
    found = read_marked_points(tmp_path / "points.csv")
    assert found.camera == ("cam_0", "cam_1")
    assert found.of == (("0", "knee"),) * 2
    np.testing.assert_array_equal(found.uv, [[10.5, 21], [-0.5, 3.5]])


def test_files_of_spreadsheets(tmp_path: Path) -> None:
    """A byte order mark, empty lines, and cells of several lines."""
    rows = 'cam_0,0,"left\nknee",10,20.5\r\n\r\ncam_1,0,\u2028,-1,3\r\n\r\n'
    (tmp_path / "points.csv").write_bytes(("\ufeff" + HEAD + rows).encode())
    assert read_marked_points(tmp_path / "points.csv").of == (("0", "left\nknee"), ("0", "\u2028"))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (None, "no such file"),
        ("", "a head line"),
        ("x,y\n1,2\n", "a head line"),
        (HEAD + "cam_0,0,knee,1\n", "line 2: expected camera, frame, point and two finite numbers"),
        (HEAD + "cam_0,0,knee,1,nan\n", "line 2"),
        (HEAD + "cam_0,0,knee,1,1e12\n", "line 2"),
        (HEAD + "cam_0,0,knee,1,2\ncam_0,0,knee,1,3\n", "line 3: expected a point once in a frame"),
        (HEAD + "cam_0,0,\0,1,x\n", "line 2"),
        (HEAD + '\ncam_0,0,"a\nb",1,x\n', "line 4"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str | None, expected: str) -> None:
    if text is not None:
        (tmp_path / "points.csv").write_text(text)
    with pytest.raises(UserError, match=expected):
        read_marked_points(tmp_path / "points.csv")
