"""The rig profile: the example as documented, and one clear error for each mistake."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rig_text import POSE, POSED, RIG
from small_scenes import array_cameras

from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.recorder.frames.layouts import make_layout
from spike4dgs.generators.recorder.rig_profile import calibration_toml, load_profile, read_calibration

DOCS = Path(__file__).resolve().parents[3] / "docs"


def save(folder: Path, text: str) -> Path:
    path = folder / "rig.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_example_is_the_array_of_the_docs() -> None:
    rig = load_profile(DOCS / "rig_example.toml")
    assert [c.id for c in rig.cameras] == [f"cam_{i:02d}" for i in range(9)]
    assert len({c.serial for c in rig.cameras}) == 9
    assert (rig.width, rig.height, rig.fps, rig.radiance_gain, rig.held_out) == (400, 250, 20000, 0.6, ("cam_04",))
    assert [c.id for c in rig.cameras if c.role == "primary"] == ["cam_04"]
    assert make_layout(rig.layout, rig.width, rig.height).frame_bytes == 12_500
    command = rig.cameras[0].start[0]  # index, pipe, command, length: 20 bytes
    assert len(command) == 20 and command[4:6] == b"\x82\x02"
    assert int.from_bytes(command[8:12], "little") == rig.transfer_bytes
    assert rig.calibrated
    for c in rig.cameras:  # all look at the middle of the scene, one metre away
        assert c.calibration is not None
        uv, z = c.calibration.project(np.zeros((1, 3)))
        np.testing.assert_allclose(uv, [[200, 125]], atol=1e-6)
        assert 1 <= z[0] < 1.02


def test_every_key_of_a_whole_profile_is_explained() -> None:
    columns = re.findall(r"^\| (`[^|]+) \|", (DOCS / "rig_profile.md").read_text(encoding="utf-8"), re.M)
    explained = {key for column in columns for key in re.findall(r"`([a-z_]+)`", column)}
    text = (DOCS / "rig_example.toml").read_text(encoding="utf-8") + calibration_toml(array_cameras(1))
    assert set(re.findall(r"^([a-z_]+) =", text, re.M)) <= explained | {"layout"}


def test_defaults_and_own_keys(tmp_path: Path) -> None:
    rig = load_profile(save(tmp_path, RIG))
    left, right = rig.cameras
    assert (left.endpoint_in, left.endpoint_out, left.interface, left.control_interface) == (0x82, 0x01, 0, None)
    assert (left.role, right.role, left.rows, right.rows) == ("primary", "secondary", "bottom-up", "top-down")
    assert (left.start, left.stop, left.mirrored, left.calibration) == ((b"\x00\x01",), (), False, None)
    assert (rig.transfer_bytes, rig.transfers, rig.ring_seconds, rig.timeout_ms) == (1024, 2, None, 500)
    assert not rig.calibrated and rig.camera("right") is right


def test_a_pose_in_the_profile(tmp_path: Path) -> None:
    camera = load_profile(save(tmp_path, POSED)).cameras[1].calibration
    assert camera is not None and (camera.id, camera.width, camera.height) == ("right", 40, 24)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50, 50.5, 20, 12)
    np.testing.assert_array_equal(camera.R @ [0, 0, 1.0] + camera.t, [0.1, -3, 3.5])


def test_a_calibration_file_returns_every_number_exactly(tmp_path: Path) -> None:
    cameras = array_cameras(2, 40, 24)
    text = calibration_toml(cameras)
    (tmp_path / "c.toml").write_text(text)
    assert set(tomllib.loads(text)["camera"]) == {"cam_00", "cam_01"}
    for camera in cameras:
        back = read_calibration(tmp_path / "c.toml", 40, 24)[camera.id]
        assert (back.fx, back.fy, back.cx, back.cy) == (camera.fx, camera.fy, camera.cx, camera.cy)
        np.testing.assert_array_equal(back.w2c, camera.w2c)
    rig = RIG.replace("[transfer]", 'calibration = "c.toml"\n[transfer]')
    profile = load_profile(save(tmp_path, rig.replace("left", "cam_00").replace("right", "cam_01")))
    assert profile.calibrated


def test_a_calibration_file_holds_lenses(tmp_path: Path) -> None:
    pinhole, curved = array_cameras(2, 40, 24)
    text = calibration_toml([pinhole, replace(curved, distortion=(-0.15, 0.03, 0.0, 0.0, 0.0))])
    assert text.count("distortion") == 1
    (tmp_path / "c.toml").write_text(text)
    found = read_calibration(tmp_path / "c.toml", 40, 24)
    assert (found[pinhole.id].distortion, found[curved.id].distortion) == ((), (-0.15, 0.03, 0.0, 0.0, 0.0))
    (tmp_path / "c.toml").write_text(text.replace("[-0.15, 0.03, 0.0, 0.0, 0.0]", "[1, 2, 3, 4, 5, 6]"))
    with pytest.raises(UserError, match=r"distortion: expected a list of k1, k2, p1, p2, k3, or of the first"):
        read_calibration(tmp_path / "c.toml", 40, 24)


def cut(old: str, new: str = "") -> Callable[[str], str]:
    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return change


no_start = cut('start = ["00 01"]\n')


@pytest.mark.parametrize(
    ("change", "key", "message"),
    [
        (cut("rig/1", "rig/2"), "schema", "expected one of spike4dgs-rig/1, found 'spike4dgs-rig/2'"),
        (cut('name = "pair"'), "name", "found no such key; add it"),
        (cut('"pair"', '"a pair"'), "name", "expected a name of letters, digits"),
        (cut("width = 40", "width = 40.0"), "width", "expected a whole number from 1 to 16384, found 40.0"),
        (cut("width = 40", "width = true"), "width", "found True"),
        (
            cut("plain", "striped"),
            "layout",
            "plain, padded-rows, tagged-rows, line-tagged, found 'striped'",
        ),
        (cut("flight = 2", "flight = 2\nring_seconds = 1e-4"), None, None),
        (cut("24", "23"), None, None),
        (cut('"plain"', '"tagged-rows"'), None, None),
        (cut('height = 24\nlayout = "plain"', 'height = 3\nlayout = "tagged-rows"'), "layout", "4 rows or more"),
        (cut("[transfer]", "speed = 3\n[transfer]"), "speed", "expected keys among"),
        (cut("[transfer]", "radiance_gain = nan\n[transfer]"), "radiance_gain", "above 0, 1 at most, found nan"),
        (cut("[transfer]", "dead_ticks = 11\n[transfer]"), "dead_ticks", "expected a number from 0 to 10, found 11"),
        (cut("[transfer]", 'held_out = ["middle"]\n[transfer]'), "held_out", "found middle"),
        (cut("[transfer]", 'held_out = ["left", "right"]\n[transfer]'), "held_out", "not all"),
        (cut("[transfer]", 'held_out = ["left", "left"]\n[transfer]'), "held_out", "each once"),
        (cut("1024", "1000"), "transfer.bytes", "expected a multiple of 1024 bytes, 64 MiB at most, found 1000"),
        (cut("in_flight = 2", "in_flight = 0"), "transfer.in_flight", "whole number from 1 to 256, found 0"),
        (cut("in_flight = 2", "depth = 2"), "transfer.depth", "in_flight"),
        (cut("[defaults]", "[defaults]\nserial = 'A1'"), "defaults.serial", "a key of each camera"),
        (cut("endpoint_in = 0x82"), "camera[0].endpoint_in", "found no such key"),
        (cut("0x82", "0x02"), "camera[0].endpoint_in", "whole number from 129 to 143, found 2"),
        (cut("endpoint_out = 0x01\n"), "camera[0].endpoint_out", "for the start and stop sequences"),
        (cut("0x82", '0x82\nstop = ["0"]'), "camera[0].stop", "hexadecimal digits"),
        (cut('["00 01"]', '"00"'), "camera[0].start", "a list of commands"),
        (cut("00 01", " "), "camera[0].start", "a list of commands"),
        (cut('start = ["00 01"]\n'), "camera.start", "after which a frame of layout plain begins, found none of left"),
        (lambda text: no_start(text).replace('"plain"', '"tagged-rows"'), None, None),
        (
            cut("1024", "1048576"),
            "transfer.bytes",
            "reads of half of timeout_ms (500) at most, found 437 ms",
        ),
        (cut("1024", "1048576\ntimeout_ms = 1000"), None, None),
        (cut('"left"', '"../left"'), "camera[0].id", "a name of letters"),
        (cut('"left"', '"right"'), "camera.id", "found 'right' twice"),
        (cut('"A1"', '"A2"'), "camera.serial", "found 'A2' twice"),
        (cut('"A1"', '" "'), "camera[0].serial", "a text that is not empty"),
        (cut('role = "primary"'), "camera.role", "expected one primary camera, found none"),
        (cut('rows = "top-down"', 'role = "primary"'), "camera.role", "found left, right"),
        (cut('"top-down"', '"upwards"'), "camera[1].rows", "expected one of bottom-up, top-down"),
        (lambda text: text + "mirrored = 0", "camera[1].mirrored", "expected true or false, found 0"),
        (lambda text: text + POSE, "calibration", "of all cameras, or of none, found none of left"),
        (lambda text: text + POSE.replace("-1]", "1]"), "camera[1].calibration.rotation", "a rotation matrix"),
        (lambda text: text + POSE.replace("3.5]", "3.5, 1]"), "camera[1].calibration.translation", "three numbers"),
        (lambda text: text + POSE.replace("[0, 1, 0]", "[0, 1]"), "camera[1].calibration.rotation", "three rows"),
        (lambda text: text + POSE.replace("fx = 50", "fx = -1"), "camera[1].calibration.fx", "a positive number"),
        (lambda text: text + POSE.replace("fx", "f"), "camera[1].calibration.fx", "found no such key"),
        (lambda text: text.partition("[[camera]]")[0], "camera", "a table [[camera]] for each camera, found none"),
        (cut("0x82", "0x82\nspeed = 1"), "camera[0].speed", "expected keys among calibration, control_interface"),
        (lambda text: "camera = 3\n" + text.partition("[[camera]]")[0], "camera", "expected tables [[camera]]"),
        (lambda text: "transfer = 3\n" + text.replace("[transfer]", "[t]"), "transfer", "expected a table [transfer]"),
    ],
)
def test_each_mistake_is_one_line_that_names_file_and_key(
    tmp_path: Path, change: Callable[[str], str], key: str | None, message: str | None
) -> None:
    path = save(tmp_path, change(RIG))
    if key is None:  # a change that is none
        load_profile(path)
        return
    with pytest.raises(UserError) as error:
        load_profile(path)
    text = str(error.value)
    assert "\n" not in text and text.startswith(f"{path}, key {key}")
    assert message is None or message in text


def test_cameras_that_a_scene_refuses_are_refused_before_a_recording(tmp_path: Path) -> None:
    for name, message in (("Right", "ids of cameras that differ in more than case"), ("r" * 101, "100 at most")):
        with pytest.raises(UserError, match=message):
            load_profile(save(tmp_path, RIG.replace('"left"', f'"{name}"')))


def test_files_that_are_no_profiles(tmp_path: Path) -> None:
    for data, found in ((b"name = ", "damaged text"), (b"\xff", "damaged text"), (b"x = 1" * 3, "damaged text")):
        (tmp_path / "rig.toml").write_bytes(data)
        with pytest.raises(UserError, match=found):
            load_profile(tmp_path / "rig.toml")
    with pytest.raises(UserError, match="expected a rig profile, found no such file"):
        load_profile(tmp_path / "none.toml")
    with pytest.raises(UserError, match="found a folder"):
        load_profile(tmp_path)


def test_both_a_calibration_file_and_one_of_its_own_is_refused(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(calibration_toml(array_cameras(1, 40, 24)))
    text = RIG.replace("[transfer]", 'calibration = "c.toml"\n[transfer]').replace("right", "cam_00") + POSE
    with pytest.raises(UserError, match=r"key camera\[1\].calibration: expected one calibration of a camera"):
        load_profile(save(tmp_path, text))
