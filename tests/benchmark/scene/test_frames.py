"""Frames of a conventional camera: a scene's files come back as images with their times."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_scenes import HEIGHT, WIDTH, write_small_scene

from spike4dgs.benchmark import UserError, open_scene
from spike4dgs.benchmark.scene.images import encode_srgb, write_png
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.generators.other_sensors import EXPOSURE_S, FPS, exposures
from spike4dgs.generators.profiles import PROFILES, Job
from spike4dgs.generators.streams import extras

FACTS = {"conventional": extras(Job("car", 0, 0, "tiny", PROFILES["tiny"], 0.004))["conventional"]}


def radiance(camera: int, tick: float) -> np.ndarray:
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    return (0.5 + 0.4 * np.sin((x - 0.02 * tick - 2 * camera) / 4) * np.cos(y / 5)).astype(np.float32)


@pytest.fixture
def filmed(tmp_path: Path) -> Path:
    """A small scene with the frames that the simulator's conventional camera takes in 700 ticks."""
    root = write_small_scene(tmp_path / "scene", extras=FACTS)
    for camera in range(4):
        keys = [radiance(camera, tick) for tick in range(0, 701, 20)]
        for tick, image in exposures(keys, range(0, 701, 20), 700, 20_000):
            write_png(root / f"conventional/cam_{camera:02d}/{tick:06d}.png", encode_srgb(image))
    write_manifest(root)
    return root


def test_frames_are_what_the_simulator_wrote(filmed: Path) -> None:
    frames = open_scene(filmed).frames("cam_01")
    expected = dict(exposures([radiance(1, t) for t in range(0, 701, 20)], range(0, 701, 20), 700, 20_000))
    assert frames.ticks == tuple(expected) == (0, 333) and len(frames) == 2
    assert (frames.fps, frames.exposure_us) == (FPS, EXPOSURE_S * 1e6)
    for frame, (tick, image) in zip(frames, expected.items(), strict=True):
        assert (frame.tick, frame.t_us, frame.exposure_us) == (tick, tick * 50.0, frames.exposure_us)
        assert np.array_equal(frame.srgb, encode_srgb(image))
        assert frame.radiance.dtype == np.float32
        assert np.abs(frame.radiance - image).max() < 0.5 / 255 * 2.4, "half a step of the encoding"
    assert frames[-1].tick == 333 and [f.tick for f in frames[:1]] == [0]


def test_colour_frames_are_read_as_rgb(filmed: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    write_png(filmed / "conventional/cam_00/000000.png", image)
    write_manifest(filmed)
    frame = open_scene(filmed).frames("cam_00")[0]
    assert np.array_equal(frame.srgb, image) and frame.radiance.shape == (HEIGHT, WIDTH, 3)


def test_methods_get_frames_of_training_cameras_only(filmed: Path) -> None:
    scene = open_scene(filmed)
    training = scene.training
    assert np.array_equal(training.frames("cam_00")[1].srgb, scene.frames("cam_00")[1].srgb)
    assert len(scene.frames("cam_03")) == 2
    with pytest.raises(UserError, match="expected frames of a conventional camera at cam_03, found those of cam_00"):
        training.frames("cam_03")
    files = [name for frames in training.found_frames.values() for name in frames.files.files]
    assert files and not any("cam_03" in name for name in files)
    assert replace(training, cameras=training.cameras[:1]).frames("cam_00").ticks == (0, 333)


def test_a_scene_without_frames_says_so(tmp_path: Path) -> None:
    without = open_scene(write_small_scene(tmp_path / "none"))
    too_short = open_scene(write_small_scene(tmp_path / "short", extras=FACTS))
    for scene in (without, too_short):
        for frames in (scene.frames, scene.training.frames):
            with pytest.raises(UserError, match="frames of a conventional camera at cam_00, found none; use a scene"):
                frames("cam_00")


def test_damaged_frames_are_refused_when_they_are_read(filmed: Path) -> None:
    path = filmed / "conventional/cam_00/000333.png"
    path.write_bytes(path.read_bytes()[:-1] + b"\0")
    frames = open_scene(filmed).training.frames("cam_00")
    assert frames[0].tick == 0
    with pytest.raises(UserError, match=r"cam_00/000333\.png: expected sha256"):
        frames[1]
