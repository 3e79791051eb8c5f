"""`record`, end to end: an emulated array into a scene folder that every other command reads."""

from __future__ import annotations

import json
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from changes import edit_json
from recorder_rig import calibrated_scene
from rig_text import RIG

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.scene.calibration import estimate
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.spikes.folder import open_stream_folder
from spike4dgs.cli import main
from spike4dgs.generators.recorder import record as command
from spike4dgs.generators.recorder import sources
from spike4dgs.generators.recorder.emulation.array import EmulatedArray
from spike4dgs.generators.recorder.emulation.camera import Fault
from spike4dgs.generators.recorder.frames.clip import CameraClip, CameraStats, Clip
from spike4dgs.generators.recorder.rig_profile import calibration_toml
from spike4dgs.generators.recorder.sync import fit_arrival


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return calibrated_scene(tmp_path_factory.mktemp("source") / "pattern", photons=5e4)


def record(*arguments):
    return main(["record", *map(str, arguments)])


def faulty(monkeypatch, *faults, **options):
    """Make emulated arrays fail with these faults."""
    monkeypatch.setattr(sources, "EmulatedArray", lambda p, s: EmulatedArray(p, s, faults=faults, **options))


def same_streams(found, expected, n_ticks=None):
    for camera in expected.cameras:
        np.testing.assert_array_equal(found.stream(camera).packed, expected.stream(camera).packed[:n_ticks])


@pytest.mark.parametrize("how", [(), ("--continuous",)], ids=["memory", "continuous"])
def test_an_emulated_capture_is_the_scene_bit_by_bit(scene, tmp_path, capsys, how):
    assert record("--emulate", scene, "--out", tmp_path / "x", *how) == 0
    source, capture = open_scene(scene), open_scene(tmp_path / "x")
    same_streams(capture, source)
    for name, camera in source.cameras.items():
        found = capture.cameras[name]
        np.testing.assert_allclose(found.w2c, camera.w2c, atol=1e-12)
        assert (found.fx, found.fy, found.cx, found.cy) == (camera.fx, camera.fy, camera.cx, camera.cy)
    assert (capture.id, capture.train, capture.test) == ("x", source.train, source.test)
    for split in source.meta["splits"]:
        assert open_scene(tmp_path / "x", split=split).targets == open_scene(scene, split=split).targets
    assert not capture.gaps and capture.meta["source"]["kind"] == "recorder"
    assert set(capture.meta["source"]["cameras"]) == set(source.cameras)
    assert main(["verify", str(tmp_path / "x")]) == 0
    out = capsys.readouterr().out
    assert out.index("armed") < out.index("triggered") < out.index("closed") < out.index("80 ticks of 4 cameras")


@pytest.mark.usefixtures("no_images")
def test_a_benchmark_on_the_capture_gives_the_scores_of_the_scene(scene, tmp_path):
    assert record("--emulate", scene, "--out", tmp_path / "pattern-0") == 0  # named as the scene is
    scores = []
    for folder in (scene, tmp_path / "pattern-0"):
        out = tmp_path / f"runs-{len(scores)}"
        method = ["--methods", "nearest-view", "--in-process", "--metrics", "psnr"]
        assert main(["run-benchmark", str(folder), *method, "--out", str(out)]) == 0
        cell = json.loads((out / "results" / "nearest-view.json").read_text())["scenes"]["pattern-0"]
        scores.append((cell["metrics"], cell["per_image"], cell["predictions_sha256"]))
    assert scores[0][0]["psnr"] > 15 and len(scores[0][1]) == 3
    assert scores[0] == scores[1]


def test_a_shorter_capture_has_the_truth_of_its_ticks(scene, tmp_path):
    assert record("--emulate", scene, "--out", tmp_path / "x", "--seconds", 45 / 20000) == 0
    capture = open_scene(tmp_path / "x")
    same_streams(capture, open_scene(scene), 45)
    assert [t.tick for t in capture.targets] == [20, 40]
    assert sorted(p.stem for p in (tmp_path / "x/images").glob("*/*.exr")) == ["000020", "000030", "000040"]
    np.testing.assert_array_equal(
        capture.ground_truth(capture.targets[1]), open_scene(scene).ground_truth(capture.targets[1])
    )


def test_a_camera_that_loses_data_gives_exit_code_3_and_a_gap(scene, tmp_path, monkeypatch, capsys):
    faulty(monkeypatch, Fault("cam_01", "unplugged", tick=30))
    assert record("--emulate", scene, "--out", tmp_path / "x", "--preview") == command.LOST_DATA == 3
    assert "gap: cam_01 from tick 30, 50 ticks (unplugged)" in capsys.readouterr().out
    with pytest.raises(UserError, match="--allow-gaps"):
        open_scene(tmp_path / "x")
    capture, source = open_scene(tmp_path / "x", allow_gaps=True), open_scene(scene)
    assert [(g.camera, g.first_tick, g.ticks) for g in capture.gaps] == [("cam_01", 30, 50)]
    for camera in ("cam_00", "cam_02", "cam_03"):
        np.testing.assert_array_equal(capture.stream(camera).packed, source.stream(camera).packed)
    np.testing.assert_array_equal(capture.stream("cam_01").packed[:30], source.stream("cam_01").packed[:30])
    assert not capture.stream("cam_01").packed[30:].any()


def test_a_recording_ends_where_the_whole_array_fails(scene, tmp_path, monkeypatch, capsys):
    faulty(monkeypatch, *(Fault(f"cam_0{k}", "unplugged", tick=30) for k in range(4)))
    assert record("--emulate", scene, "--out", tmp_path / "x", "--seconds", 5, "--continuous") == command.LOST_DATA
    assert "ended early" in capsys.readouterr().out
    capture = open_scene(tmp_path / "x")
    assert capture.n_ticks == 30 and not capture.gaps
    same_streams(capture, open_scene(scene), 30)


def test_a_recording_has_the_splits_and_the_dead_ticks_of_its_scene(scene, tmp_path):
    """Poses that are a little wrong would break ties of distances in another way."""
    copy = Path(shutil.copytree(scene, tmp_path / "copy"))
    edit_json(copy / "scene.json", lambda meta: meta["splits"]["corner"]["train"].pop())
    edit_json(copy / "scene.json", lambda meta: meta["sensor"].update(dead_ticks=0.5))
    write_manifest(copy)
    assert record("--emulate", copy, "--out", tmp_path / "x") == 0
    found, source = open_scene(tmp_path / "x"), open_scene(copy)
    assert found.meta["splits"] == source.meta["splits"]
    assert found.stream("cam_00").dead_ticks == source.stream("cam_00").dead_ticks == 0.5


def test_missing_cameras_are_an_error_and_leave_no_files(scene, tmp_path, monkeypatch, capsys):
    faulty(monkeypatch, Fault("cam_02", "missing"))
    assert record("--emulate", scene, "--out", tmp_path / "x") == 2
    assert "cam_02" in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_ctrl_c_keeps_the_captured_ticks(scene, tmp_path, monkeypatch, capsys):
    class Impatient(command.Watch):
        def rates(self, rates):
            if min(r.ticks for r in rates.values()) > 100:
                signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(command, "Watch", Impatient)
    before = signal.getsignal(signal.SIGINT)
    assert record("--emulate", scene, "--out", tmp_path / "x", "--seconds", 5) == 0
    assert signal.getsignal(signal.SIGINT) is before
    capture, source = open_scene(tmp_path / "x"), open_scene(scene)
    assert 80 < capture.n_ticks < 100_000
    assert "ended early" in capsys.readouterr().out
    ticks = np.arange(capture.n_ticks) % 80  # an emulated camera repeats its stream after the last tick
    for camera in source.cameras:
        np.testing.assert_array_equal(capture.stream(camera).packed, source.stream(camera).packed[ticks])


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="no such signal")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_request_to_end_and_a_closed_terminal_end_a_recording_like_ctrl_c(name):
    number = getattr(signal, name)
    before = signal.signal(number, signal.SIG_IGN)  # the test's process must survive it
    try:
        with command._interruptible() as stop:
            signal.raise_signal(number)
            assert stop.is_set()
        assert signal.getsignal(number) is signal.SIG_IGN
    finally:
        signal.signal(number, before)


def test_cameras_without_a_trigger_are_told_of(capsys):
    ticks = 20 * (1 + np.arange(100))
    arrival = [np.stack([ticks, ticks * 50_000 + late], axis=1) for late in (0, 0, 120_000_000)]
    stats = CameraStats(0, 0, 0, 0, 1, 0, 0.0, 0.0, 0, "ok")
    nothing = np.empty((0, 1), np.uint8), np.empty(0, np.int64), ()
    cameras = tuple(CameraClip(f"cam_{i}", *nothing, a, stats) for i, a in enumerate(arrival))
    for sync in ("frame tags", "arrival times"):
        clip = Clip(2000, cameras, sync, False)
        command._print(clip, fit_arrival(clip, 20000), False)
        said = capsys.readouterr().out
        assert "tick 0 of cam_2 arrived far from the others'" in said and "check the trigger cable" in said
        assert ("which the frame tags contradict" in said) == (sync == "frame tags")


def test_only_the_third_ctrl_c_breaks_off_the_writing():
    with pytest.raises(KeyboardInterrupt), command._interruptible() as stop:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        assert stop.is_set()
        signal.raise_signal(signal.SIGINT)
        pytest.fail("the third one had no effect")


# ------------------------------------------------------------ light and darkness


def rig_of(scene, folder: Path) -> Path:
    """Write a profile of the scene's cameras, as an owner of them would write it."""
    cameras = open_scene(scene).cameras
    folder.mkdir()
    (folder / "calibration.toml").write_text(calibration_toml(cameras.values()))
    text = RIG.partition("[[camera]]")[0].replace('"plain"', '"tagged-rows"').replace("bytes = 1024", "bytes = 4096")
    facts = 'radiance_gain = 0.6\nheld_out = ["cam_03"]\ncalibration = "calibration.toml"\n[transfer]'
    text = text.replace("[transfer]", facts)
    text += 'stop = ["02"]\nmirrored = true\n'
    for i, name in enumerate(cameras):
        text += f'[[camera]]\nid = "{name}"\nserial = "S{i}"\nrole = "{"secondary" if i else "primary"}"\n'
    (folder / "rig.toml").write_text(text)
    return folder / "rig.toml"


def test_flat_and_dark_recordings_go_into_a_clip_and_calibrate_it(scene, tmp_path):
    rig, source = rig_of(scene, tmp_path / "rig"), open_scene(scene)
    for mode in ("flat", "dark"):
        assert record(rig, "--emulate", scene, "--mode", mode, "--out", tmp_path / mode, "--preview") == 0
        streams = open_stream_folder(tmp_path / mode)
        for name in source.cameras:
            np.testing.assert_array_equal(streams[name].packed, getattr(source.recordings(name), mode).packed)
        assert (tmp_path / mode / "sheet.png").stat().st_size > 10_000
    light = ("--flat", tmp_path / "flat", "--dark", tmp_path / "dark", "--flat-radiance", "0.7")
    assert record(rig, "--emulate", scene, "--out", tmp_path / "clip", *light) == 0
    same_streams(open_scene(tmp_path / "clip"), source)
    assert not open_scene(tmp_path / "clip").targets  # a recording of a real rig has no truth
    for camera in source.cameras:
        ours, theirs = (estimate(s.recordings(camera)) for s in (open_scene(tmp_path / "clip"), source))
        np.testing.assert_array_equal(ours.gain, theirs.gain)
        np.testing.assert_array_equal(ours.dark, theirs.dark)
        assert ours.radiance_gain == theirs.radiance_gain


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rate_hz": 1562.5}, "a whole number of ticks per second, as a rig has, found 1562.5"),
        ({"rate_hz": 0.4}, "a whole number of ticks per second, as a rig has, found 0.4"),
        ({"sensor": {"model": "x/1", "rows_bottom_up": False}}, "calibration recordings with the bottom row first"),
    ],
)
def test_a_scene_that_cannot_be_recorded_as_it_is_is_refused(scene, tmp_path, change, message):
    shutil.copytree(scene, tmp_path / "other")
    edit_json(tmp_path / "other/scene.json", lambda meta: meta.update(change))
    write_manifest(tmp_path / "other")
    with pytest.raises(UserError, match=message):
        sources.emulated_source(tmp_path / "other", None, "clip")
    if "sensor" in change:  # turned over
        assert sources.emulated_source(tmp_path / "other", None, "flat").scene is None


def test_a_profile_of_another_rate_than_the_scenes_is_refused(scene, tmp_path):
    rig = rig_of(scene, tmp_path / "rig")
    rig.write_text(rig.read_text().replace("[transfer]", "fps = 10000\n[transfer]"))
    with pytest.raises(UserError, match="rig pair: expected the scene's 20000 ticks per second, found 10000"):
        sources.emulated_source(scene, rig, "clip")


def test_light_that_does_not_fit_is_refused(scene, tmp_path):
    profile = sources.emulated_source(scene, None, "clip").profile
    assert record("--emulate", scene, "--mode", "dark", "--out", tmp_path / "dark", "--seconds", "0.001") == 0
    light = sources.Light(tmp_path / "dark", tmp_path / "dark", 0.7)
    sources.light_truth(light, profile)
    for other in ({"width": 32}, {"fps": 40000}, {"dead_ticks": 1.0}):
        with pytest.raises(UserError, match="of emulated-pattern.*, found .*, 40x24 at 20000 Hz, 0 dead ticks;"):
            sources.light_truth(light, replace(profile, **other))
    with pytest.raises(UserError, match="a positive radiance"):
        sources.light_truth(replace(light, flat_radiance=0.0), profile)
    with pytest.raises(UserError, match="calibrate-rig"):
        sources.light_truth(light, command._without_poses(profile))
    edit_json(
        tmp_path / "dark/stream.json", lambda facts: [s.update(rows_bottom_up=False) for s in facts["streams"].values()]
    )
    with pytest.raises(UserError, match="expected the bottom row first, as in a scene"):
        sources.light_truth(light, profile)


# ------------------------------------------------------------ arguments


def test_wrong_arguments_give_a_fix(scene, small_scene, tmp_path, capsys):
    out = ("--out", tmp_path / "x")
    for arguments, message in (
        ((), "--emulate SCENE"),
        ((tmp_path / "none.toml",), "none.toml"),
        (("--emulate", scene, "--seconds", "0.00001"), "from 5e-05, one tick"),
        (("--emulate", scene, "--flat", tmp_path), "no --dark, --flat-radiance"),
        (("--emulate", small_scene, "--mode", "flat"), "none of cam_0"),
        (("--emulate", scene, "--out", scene), "a new or empty folder"),
    ):
        assert record(*arguments, *(() if "--out" in arguments else out)) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_all_that_the_machine_lacks_is_reported_at_once(scene, tmp_path, monkeypatch, capsys):
    lacks = [problem("disk", "room", "none", "free some"), problem("memory", "more", "less", "buy some")]
    monkeypatch.setattr(command, "check_machine", lambda *a, **k: lacks)
    assert record("--emulate", scene, "--out", tmp_path / "x") == 2
    assert "free some; memory: expected more, found less; buy some" in capsys.readouterr().err


def test_the_disk_has_room_for_the_truth_beside_the_streams(scene, tmp_path, monkeypatch, capsys):
    source = open_scene(scene)
    streams = sum((scene / name).stat().st_size for name in source.manifest.files if name.startswith("spikes/"))
    free = SimpleNamespace(free=streams + (16 << 20))  # the margin is not for the truth
    monkeypatch.setattr(shutil, "disk_usage", lambda _: free)
    assert record("--emulate", scene, "--out", tmp_path / "x") == 2
    assert "GB of free disk space" in capsys.readouterr().err and not (tmp_path / "x").exists()
    assert record("--emulate", scene, "--out", tmp_path / "dark", "--mode", "dark", "--seconds", "0.004") == 0
