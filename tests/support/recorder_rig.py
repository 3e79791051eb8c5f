"""A small source scene, and a whole recording of it, for the tests of emulated and mocked cameras."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from small_scenes import array_cameras, write_small_scene

from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.benchmark.scene.splits import standard_splits
from spike4dgs.benchmark.scene.writer import SceneDescription, finish_scene, stream_name
from spike4dgs.benchmark.spikes.stream import SpikeWriter, pack
from spike4dgs.generators.recorder.capture import capture
from spike4dgs.generators.recorder.clip_files import StreamFiles
from spike4dgs.generators.recorder.clip_record import ClipRecord
from spike4dgs.generators.recorder.frames.clip import CameraClip, Clip
from spike4dgs.generators.recorder.frames.gaps import Gap
from spike4dgs.generators.recorder.record import open_links
from spike4dgs.generators.recorder.rig_profile import RigProfile
from spike4dgs.generators.recorder.usb.ports import Port
from spike4dgs.generators.sensor import calibration
from spike4dgs.generators.sensor.model import Sensor

WIDTH, HEIGHT, TICKS = 40, 24, 64
FRAME = WIDTH * HEIGHT // 8


def source_scene(root: Path, cameras: int = 9, ticks: int = TICKS) -> Scene:
    """Write a scene whose cameras see noise, so that no tick is like another; the middle one is held out."""
    poses, rng = array_cameras(cameras, WIDTH, HEIGHT), np.random.default_rng(cameras)
    for camera in poses:
        with SpikeWriter(root / stream_name(camera.id), WIDTH, HEIGHT) as writer:
            writer.write(pack(rng.random((ticks, HEIGHT, WIDTH)) < 0.4))
    names, held_out = [c.id for c in poses], poses[cameras // 2].id
    about = {"id": "noise", "title": "Noise", "licence": "CC0-1.0", "source": {"kind": "test"}, "targets": ()}
    sensor = {"model": "noise/1", "rows_bottom_up": True}
    clock = {"rate_hz": 20000.0, "n_ticks": ticks, "radiance_gain": 0.6, "sensor": sensor}
    array = {"cameras": poses, "train": tuple(n for n in names if n != held_out), "test": (held_out,)}
    finish_scene(root, SceneDescription(**about, **clock, **array, splits=standard_splits(poses, held_out)))
    return open_scene(root)


def calibrated_scene(root: Path, **sensor: float) -> Path:
    """Write four cameras, 80 ticks, the standard splits, ground truth of two cameras, and calibration recordings."""
    for i, camera in enumerate(array_cameras()):
        calibration.write_calibration(root / "calibration", camera, Sensor(noise_seed=(i,), **sensor), [i])
    facts = {"flat_radiance": 0.7, "flat_ticks": calibration.FLAT_TICKS, "dark_ticks": calibration.DARK_TICKS}
    return write_small_scene(root, splits=True, extras={"calibration": facts})


def record(out: Path, profile: RigProfile, ports: Sequence[Port], ticks: int) -> Clip:
    """Find the cameras, capture, write the scene folder."""
    links = open_links(profile, ports)
    with StreamFiles(out, profile, ticks) as files:
        clip = capture(profile, links, ticks / profile.fps)
        for camera in clip.cameras:
            files.write_ticks(camera.camera, camera.ticks, camera.frames)
        finish(files, clip)
    return clip


def finish(files: StreamFiles, clip: Clip) -> None:
    """Describe a recording from its capture."""
    files.finish(ClipRecord(clip.n_ticks, gaps_of(clip.cameras), {"method": clip.sync}))


def gaps_of(cameras: Sequence[CameraClip]) -> tuple[Gap, ...]:
    """Return the gaps of all cameras."""
    return tuple(gap for camera in cameras for gap in camera.gaps)


def check_recording(out: Path, scene: Scene, clip: Clip) -> None:
    """Check that the folder holds the source's bits at every tick, except zeros in the gaps, which it lists."""
    recording = open_scene(out, allow_gaps=True)
    assert recording.n_ticks == clip.n_ticks
    assert [g["camera"] for g in recording.meta["gaps"]] == [g.camera for g in gaps_of(clip.cameras)]
    for camera in scene.cameras:
        expected = np.resize(scene.stream(camera).packed, (clip.n_ticks, FRAME)).copy()
        for gap in recording.meta["gaps"]:
            if gap["camera"] == camera:
                expected[gap["first_tick"] : gap["first_tick"] + gap["ticks"]] = 0
        found = (out / stream_name(camera)).read_bytes()
        assert found == expected.tobytes(), f"{camera} differs from its source"


def check_identical(out: Path, scene: Scene) -> None:
    """Check that the folder is the source's: streams byte for byte, cameras, splits, clock and gain."""
    for camera in scene.cameras:
        assert (out / stream_name(camera)).read_bytes() == (scene.root / stream_name(camera)).read_bytes()
    recording = open_scene(out)
    for camera, source in scene.cameras.items():
        found = recording.cameras[camera]
        np.testing.assert_array_equal(found.K, source.K)
        np.testing.assert_allclose(found.w2c, source.w2c, rtol=0, atol=1e-14)  # the file has the inverse
    facts = "n_ticks rate_hz radiance_gain splits default_split streams gaps licence sensor width height"
    for key in facts.split():
        assert recording.meta[key] == scene.meta[key], key
