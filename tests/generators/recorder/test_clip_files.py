"""A recording on disk: bits at their true ticks, gaps that every reader reports, no unfinished files."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rig_text import RIG
from small_scenes import array_cameras

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.spikes.folder import open_stream_folder
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.cli import main
from spike4dgs.cli.inspect import _plot_gaps, examine, inspect
from spike4dgs.generators.recorder.clip_files import StreamFiles
from spike4dgs.generators.recorder.clip_record import ClipRecord, gaps_of
from spike4dgs.generators.recorder.frames.gaps import Gap
from spike4dgs.generators.recorder.frames.layouts import LAYOUTS, make_layout
from spike4dgs.generators.recorder.rig_profile import CameraProfile, RigProfile

WIDTH, HEIGHT, TICKS = 24, 6, 30
SYNC = {"method": "frame tags", "worst_pair_us": 12.5}


def camera(name: str, rows: str = "bottom-up", mirrored: bool = False, **more: object) -> CameraProfile:
    return CameraProfile(name, name.upper(), 0x0403, 0x601F, 0x82, rows=rows, mirrored=mirrored, **more)  # type: ignore[arg-type]


def rig(layout: str = "plain", calibrated: bool = True, **more: object) -> RigProfile:
    poses = array_cameras(3, WIDTH, HEIGHT)
    cameras = tuple(camera(p.id, calibration=p if calibrated else None) for p in poses)
    facts = {"licence": "CC0-1.0", "radiance_gain": 0.6, "held_out": ("cam_01",) if calibrated else ()} | more
    return RigProfile("test", WIDTH, HEIGHT, layout, cameras, **facts)  # type: ignore[arg-type]


def spikes(seed: int, ticks: int = TICKS) -> np.ndarray:
    """Return upright spikes [T, H, W]."""
    return np.random.default_rng(seed).random((ticks, HEIGHT, WIDTH)) < 0.4


def streams(profile: RigProfile) -> dict[str, np.ndarray]:
    return {c.id: pack(spikes(i)) for i, c in enumerate(profile.cameras)}


def write_clip(out: Path, profile: RigProfile, packed: dict[str, np.ndarray], record: ClipRecord) -> Path:
    """Write a recording with zeros in its gaps, whatever the packed streams hold there."""
    with StreamFiles(out, profile, record.n_ticks) as files:
        for c in profile.cameras:
            at = 0
            for gap in (*gaps_of(c.id, record.gaps), Gap(c.id, record.n_ticks, 0, "")):
                files.append(c.id, at, packed[c.id][at : gap.first_tick])
                at = gap.stop_tick
        return files.finish(record)


RECORDER = """
import sys
from pathlib import Path
import numpy as np
from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.recorder.clip_files import StreamFiles
from spike4dgs.generators.recorder.clip_record import ClipRecord
from spike4dgs.generators.recorder.rig_profile import load_profile

out, rig, value = Path(sys.argv[1]), load_profile(Path(sys.argv[2])), int(sys.argv[3])
print("ready", flush=True)
sys.stdin.readline()
try:
    with StreamFiles(out, rig, 2000) as files:
        for camera in rig.cameras:
            files.append(camera.id, 0, np.full((2000, rig.width * rig.height // 8), value, np.uint8))
        files.finish(ClipRecord(2000, (), {"method": "none"}))
    print("done")
except UserError as e:
    print(e)
"""


def test_of_recorders_that_start_into_one_folder_together_one_records(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(RIG)
    out, pipe = tmp_path / "clip", subprocess.PIPE
    commands = [[sys.executable, "-c", RECORDER, str(out), str(tmp_path / "rig.toml"), str(v)] for v in (1, 2, 3)]
    started = [subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) for command in commands]
    for process in started:
        assert process.stdout and process.stdout.readline() == "ready\n"
    for process in started:
        assert process.stdin
        process.stdin.write("\n")
        process.stdin.flush()
    said = [process.communicate(timeout=120)[0] for process in started]
    assert said.count("done\n") == 1, said
    for text in said:
        assert text.count("\n") == 1 and (text == "done\n" or "no other recording uses" in text or "a new or" in text)
    found = {int(v) for stream in open_stream_folder(out).values() for v in np.unique(stream.packed)}
    assert found == {said.index("done\n") + 1}, "no clip of two recorders"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["clip", "rig.toml"], "no lock stays behind"


def test_a_folder_is_locked_from_the_start_to_the_end_of_a_recording(tmp_path: Path) -> None:
    out = tmp_path / "clip"
    with StreamFiles(out, rig(), TICKS):
        with pytest.raises(UserError, match="expected a folder that no other recording uses, found a run in progress"):
            StreamFiles(out, rig(), TICKS)
    assert not out.exists()
    write_clip(out, rig(), streams(rig()), ClipRecord(TICKS, (), SYNC))
    with pytest.raises(UserError, match="a new or empty folder"):
        StreamFiles(out, rig(), TICKS)
    assert open_scene(out).n_ticks == TICKS and [p.name for p in tmp_path.iterdir()] == ["clip"]


GAPS = (Gap("cam_00", 4, 3, "overflow"), Gap("cam_00", 28, 2, "unplugged"), Gap("cam_02", 0, 1, "stall"))


def test_a_recording_is_a_scene_of_the_same_bits(tmp_path: Path) -> None:
    profile = rig()
    packed = streams(profile)
    cameras = {"cam_02": {"drift_ppm": 3.5}}
    record = ClipRecord(TICKS, (), SYNC, t0_ns=7, clock="CLOCK_MONOTONIC", cameras=cameras)
    root = write_clip(tmp_path / "clip", profile, packed, record)
    scene = open_scene(root)
    assert (scene.id, scene.n_ticks, scene.rate_hz, scene.radiance_gain) == ("clip", TICKS, 20000, 0.6)
    assert (scene.train, scene.test, scene.targets) == (("cam_00", "cam_02"), ("cam_01",), ())
    assert scene.meta["clock"] == {"t0_ns": 7, "source": "CLOCK_MONOTONIC"}
    assert scene.meta["sync"] == SYNC | {"max_error_us": 12.5}
    source = scene.meta["source"]
    assert (source["kind"], source["rig"]) == ("recorder", "test") and source["environment"]["libusb1"]
    assert source["cameras"]["cam_02"] == {"serial": "CAM_02", "role": "secondary", "lost_ticks": 0, "drift_ppm": 3.5}
    for i, (name, c) in enumerate(sorted(scene.cameras.items())):
        assert (root / f"spikes/{name}.dat").read_bytes() == packed[name].tobytes()
        np.testing.assert_array_equal(scene.stream(name).window(0, TICKS), spikes(i))
        np.testing.assert_allclose(c.w2c, array_cameras(3, WIDTH, HEIGHT)[i].w2c, atol=1e-12)
    assert not [p for p in root.rglob("*") if p.name.startswith(".")]
    assert main(["verify", str(root)]) == 0


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize(("rows", "mirrored"), [("bottom-up", False), ("top-down", False), ("bottom-up", True)])
def test_frames_become_upright_ticks_at_their_numbers(layout: str, rows: str, mirrored: bool, tmp_path: Path) -> None:
    pose = array_cameras(1, WIDTH, HEIGHT)[0]
    profile = RigProfile("test", WIDTH, HEIGHT, layout, (camera("cam_00", rows, mirrored, calibration=pose),))
    upright = spikes(0, 700)  # more frames than are unpacked at a time
    sent = upright[:, :, ::-1] if mirrored else upright
    frames = make_layout(layout, WIDTH, HEIGHT).pack(pack(sent, rows == "bottom-up"), 5)
    gap = Gap("cam_00", 600, 50, "overflow")
    with StreamFiles(tmp_path / "clip", profile, 700) as files:
        files.write_ticks("cam_00", np.r_[:600, 650:699], np.concatenate([frames[:600], frames[650:699]]))
        files.write("cam_00", 699, frames[699:].repeat(3, axis=0))  # frames after the end are left out
        root = files.finish(ClipRecord(690, (gap,), SYNC))
    stream = open_scene(root, allow_gaps=True).stream("cam_00")
    expected = upright[:690] & present([gap], 690)[:, None, None]
    np.testing.assert_array_equal(stream.window(0, 690), expected)
    assert stream.gaps == (gap,)


def test_gaps_hold_zeros_and_every_reader_asks_to_allow_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    profile = rig()
    root = write_clip(tmp_path / "clip", profile, streams(profile), ClipRecord(TICKS, GAPS, SYNC))
    message = r"found 3 gap\(s\), the first: cam_00 from tick 4, 3 ticks \(overflow\); pass --allow-gaps"
    with pytest.raises(UserError, match=message):
        open_scene(root)
    scene = open_scene(root, allow_gaps=True)
    assert scene.gaps == GAPS and scene.meta["source"]["cameras"]["cam_00"]["lost_ticks"] == 5
    for i, name in enumerate(sorted(scene.cameras)):
        stream = scene.stream(name)
        kept = present(stream.gaps, TICKS)
        assert kept.sum() == TICKS - (5, 0, 1)[i]
        np.testing.assert_array_equal(stream.window(0, TICKS), spikes(i) & kept[:, None, None])
    monkeypatch.chdir(tmp_path)
    for command in (
        ["inspect", "clip"],
        ["export-spikecv", "clip", "--out", "new"],
        ["score", "predictions", "clip"],
        ["run-benchmark", "clip", "--methods", "nearest-view", "--out", "run"],
        ["poses", "clip"],
    ):
        assert main(command) == 2
        assert "pass --allow-gaps" in capsys.readouterr().err
    assert main(["export-spikecv", "clip", "--out", "new", "--allow-gaps"]) == 0
    assert main(["verify", "clip"]) == 0


def test_a_rig_without_poses_records_a_folder_of_streams(tmp_path: Path) -> None:
    profile = rig(calibrated=False, dead_ticks=1.0)
    packed = streams(profile)
    root = write_clip(tmp_path / "a clip", profile, packed, ClipRecord(TICKS, GAPS, SYNC))
    with pytest.raises(UserError, match=r"stream\.json: expected a recording without gaps"):
        open_stream_folder(root)
    found = open_stream_folder(root, allow_gaps=True)
    assert {name: s.gaps for name, s in found.items()} == {"cam_00": GAPS[:2], "cam_01": (), "cam_02": GAPS[2:]}
    assert {s.dead_ticks for s in found.values()} == {1.0}
    assert (root / "cam_01.dat").read_bytes() == packed["cam_01"].tobytes()
    facts = json.loads((root / "stream.json").read_text())
    assert facts["source"]["kind"] == "recorder" and facts["sync"]["method"] == "frame tags"


def test_files_become_part_of_the_scene(tmp_path: Path) -> None:
    (tmp_path / "note").write_text("from elsewhere")
    pose = array_cameras(1, WIDTH, HEIGHT)[0]
    profile = RigProfile("r", WIDTH, HEIGHT, "plain", (camera("cam_00", calibration=pose),))
    record = ClipRecord(TICKS, (), SYNC, files={"truth/note": tmp_path / "note"})
    root = write_clip(tmp_path / "clip", profile, {"cam_00": pack(spikes(0))}, record)
    assert "truth/note" in open_scene(root).manifest.files
    assert (root / "truth/note").read_text() == "from elsewhere"


# ---------------------------------------------------------------- errors


def test_until_the_end_there_are_only_part_files_and_after_a_failure_none(tmp_path: Path) -> None:
    profile = rig()
    out = tmp_path / "clip"
    with pytest.raises(KeyboardInterrupt), StreamFiles(out, profile, TICKS) as files:
        files.append("cam_00", 0, pack(spikes(0)))
        found = {p.name: p.stat().st_size for p in out.rglob("*") if p.is_file()}
        assert found == {f".cam_0{i}.dat.part": TICKS * WIDTH * HEIGHT // 8 for i in range(3)}
        raise KeyboardInterrupt
    assert not out.exists()


def test_folders_that_a_recording_cannot_use(tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "scene.json").write_text("{}")
    with pytest.raises(UserError, match="a new or empty folder"):
        StreamFiles(tmp_path / "old", rig(), TICKS)
    for name in ("my clip", "c" * 101):
        with pytest.raises(UserError, match="expected the id of a scene"):
            StreamFiles(tmp_path / name, rig(), TICKS)
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="folders on the way"):
        StreamFiles(tmp_path / "file" / "clip", rig(), TICKS)
    assert not (tmp_path / "my clip").exists()


def test_a_full_disk_is_known_before_the_capture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reserve, calls = os.posix_fallocate, iter(range(9))

    def second_fails(fd: int, offset: int, size: int) -> None:
        if next(calls) == 1:
            raise OSError(errno.ENOSPC, "no space left on device")
        reserve(fd, offset, size)

    monkeypatch.setattr(os, "posix_fallocate", second_fails)
    with pytest.raises(UserError, match=r"cam_01\.dat: expected room for the file"):
        StreamFiles(tmp_path / "clip", rig(), TICKS)
    assert not (tmp_path / "clip").exists()


# ---------------------------------------------------------------- inspect


def test_rates_and_intervals_leave_gaps_out() -> None:
    fired = np.arange(200)[:, None, None] % 4 == np.zeros((1, 8, 16))
    fired[90:131] = 0
    gap = (Gap("c", 90, 41, "overflow"),)
    whole = examine("c", SpikeStream(pack(fired), 16, 8, 2e4, gaps=gap))
    assert (whole.missing, whole.two_intervals) == (41, 1.0)
    np.testing.assert_allclose(whole.rate, fired.sum(axis=0) / 159)
    assert examine("c", SpikeStream(pack(fired), 16, 8, 2e4)).two_intervals == 0  # the gap taken for an interval


def test_inspect_plots_each_gap_at_its_ticks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from matplotlib.figure import Figure

    profile = replace(rig(), cameras=rig().cameras[:2])
    root = write_clip(tmp_path / "clip", profile, streams(profile), ClipRecord(TICKS, GAPS[:2], SYNC))
    axis = Figure().subplots()
    _plot_gaps(axis, open_scene(root, allow_gaps=True).stream("cam_00"))
    spans = [patch.get_window_extent().transformed(axis.transData.inverted()) for patch in axis.patches[1:]]
    assert [(round(s.x0, 6), round(s.x1, 6)) for s in spans] == [(4, 7), (28, 30)]
    texts = [text.get_text() for text in axis.get_legend().get_texts()]
    assert texts == ["overflow: 1 gap(s), 3 ticks", "unplugged: 1 gap(s), 2 ticks"]
    assert inspect(root, out=tmp_path / "out", allow_gaps=True) == 0
    assert "cam_00: no data in ticks [4, 7): 3 ticks, overflow" in capsys.readouterr().out
    assert len(list((tmp_path / "out" / "clip").glob("*.png"))) == 2
