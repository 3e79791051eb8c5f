"""`calibrate-rig` and `board-clip` on simulated spikes."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
from board_array import BOARD, CAMERAS, HEIGHT, WIDTH

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics.pose_error import pose_errors
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.cli import main
from spike4dgs.generators.recorder.rig_calibration.board_clip import DISTANCE_M, write_board_clip
from spike4dgs.generators.recorder.rig_calibration.board_views import (
    BoardRecording,
    View,
    choose_views,
    common_cameras,
    make_image,
)
from spike4dgs.generators.recorder.rig_profile import read_calibration


def stream(n_ticks=50, width=16, gaps=()):
    return SpikeStream(pack(np.ones((n_ticks, 8, width))), width, 8, 2e4, gaps=gaps)


def test_views_are_spread_over_the_clips_and_images_with_lost_ticks_are_none():
    gap = Gap("b", 30, 5, "overflow")
    recordings = [
        BoardRecording("one", {"a": stream(), "b": stream(gaps=(gap,))}, {}),
        BoardRecording("two", {"a": stream(20)}, {}),
    ]
    views = choose_views(recordings, 6, 10)
    assert views == [View(0, 0, 10), View(0, 20, 30), View(0, 40, 50), View(1, 0, 10), View(1, 5, 15), View(1, 10, 20)]
    assert make_image(recordings[0], "b", View(0, 20, 30)).min() == 1.0
    assert make_image(recordings[0], "b", View(0, 21, 31)) is None
    assert make_image(recordings[0], "b", View(0, 34, 44)) is None
    assert make_image(recordings[0], "a", View(0, 34, 44)) is not None
    with pytest.raises(UserError, match="two: expected a window of 1 to 20 ticks"):
        choose_views(recordings, 6, 30)


def test_clips_of_different_arrays_are_refused():
    one = BoardRecording("one", {"b": stream(), "a": stream()}, {})
    assert common_cameras([one, one]) == (("a", "b"), (16, 8))
    for other in ({"a": stream()}, {"a": stream(), "b": stream(width=24)}):
        with pytest.raises(UserError, match="the same cameras of one size"):
            common_cameras([one, BoardRecording("two", other, {})])


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Four of the nine cameras, 0.3 s: the board is so fast that its image blurs over a pixel."""
    return write_board_clip(
        tmp_path_factory.mktemp("board") / "clip", CAMERAS[::2][:4], BOARD, DISTANCE_M, 6000, seed=1
    )


def test_the_command_finds_the_array_from_spikes(clip, tmp_path, capsys):
    arguments = ["calibrate-rig", str(clip), "--out", str(tmp_path), "--views", "8", "--window-ticks", "40"]
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    report = json.loads((tmp_path / "report.json").read_text())
    truth = open_scene(clip).cameras
    found = read_calibration(tmp_path / "calibration.toml", WIDTH, HEIGHT)
    assert list(found) == list(truth)
    errors = pose_errors(list(found.values()), list(truth.values()))
    assert report["reprojection_px"] < 0.2
    assert errors.rotation_deg.max() < 0.3 and errors.translation_m.max() < 0.003
    against = report["against_clip"]
    assert against["translation_max_m"] == pytest.approx(errors.translation_m.max())
    assert against["scale"] < 0.01 and against["focal_max"] < 0.01 and against["principal_point_max_px"] < 2
    assert "against the cameras that the clip states" in printed and "cam_06" in printed
    assert "text in front of a camera must be readable" in printed  # mirrored images calibrate as well
    assert report["views"] == {"looked_at": 8, "with_board": 8, "window_ticks": 40}
    assert (tmp_path / "corners.png").stat().st_size > 20_000


def test_the_command_estimates_what_is_asked_of_it(clip, tmp_path):
    arguments = ["calibrate-rig", str(clip), "--out", str(tmp_path), "--views", "12", "--window-ticks", "40"]
    assert main([*arguments, "--shared-focal", "--centered", "--distortion"]) == 0
    found = read_calibration(tmp_path / "calibration.toml", WIDTH, HEIGHT).values()
    assert len({(c.fx, c.cx, c.cy) for c in found}) == 1
    assert all((c.cx, c.cy) == (WIDTH / 2, HEIGHT / 2) and c.distortion for c in found)


def test_the_command_states_a_fix(clip, tmp_path, capsys):
    assert main(["calibrate-rig", "--out", str(tmp_path)]) == 2
    assert "record the board" in capsys.readouterr().err
    assert main(["calibrate-rig", str(clip), "--out", str(tmp_path), "--views", "2"]) == 2
    assert "raise --views" in capsys.readouterr().err
    assert main(["calibrate-rig", str(clip), "--out", str(tmp_path), "--views", "1", "--columns", "14"]) == 2
    assert "check --columns and --rows (inner corners)" in capsys.readouterr().err


def test_a_board_clip_is_a_scene_and_overwrites_no_other(tmp_path, capsys):
    arguments = ["board-clip", "--out", str(tmp_path / "b"), "--seconds", "0.002", "--width", "32", "--height", "20"]
    assert main(arguments) == 0
    scene = open_scene(tmp_path / "b")
    assert (scene.n_ticks, len(scene.cameras), scene.meta["source"]["square_m"]) == (40, 9, 0.04)
    assert main(arguments) == 2
    assert main([*arguments[:2], str(tmp_path / "c"), "--seconds", "0.00001"]) == 2
    assert "from 5e-05, one tick" in capsys.readouterr().err


def test_a_lens_is_refused_before_anything_is_written(tmp_path):
    cameras = (*CAMERAS[:2], replace(CAMERAS[2], distortion=(-0.2, 0.0, 0.0, 0.0, 0.0)))
    with pytest.raises(UserError, match="camera cam_02: expected a pinhole"):
        write_board_clip(tmp_path / "b", cameras, BOARD, DISTANCE_M, 40)
    assert not (tmp_path / "b").exists()


def test_any_array_films_the_board(small_scene, tmp_path, capsys):
    out = tmp_path / "b"
    assert main(["board-clip", "--out", str(out), "--seconds", "0.001", "--like", str(small_scene)]) == 0
    square = open_scene(out).meta["source"]["square_m"]
    assert f"calibrate-rig needs --columns 8 --rows 5 --square-m {square:g}" in capsys.readouterr().out
    found, like = open_scene(out).cameras, open_scene(small_scene).cameras
    assert list(found) == list(like)
    for first, second in itertools.combinations(like, 2):
        a, b, x, y = found[first], found[second], like[first], like[second]
        np.testing.assert_allclose(a.w2c @ np.linalg.inv(b.w2c), x.w2c @ np.linalg.inv(y.w2c), atol=1e-9)
    for c in found.values():
        (uv,), z = c.project(np.zeros((1, 3)))  # the board's middle
        assert z[0] > 0.3 and 0 < uv[0] < c.width and 0 < uv[1] < c.height
