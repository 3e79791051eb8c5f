"""Events of an event camera: files come back, and what lies outside the clip or the image is refused."""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import HEIGHT, TICKS, WIDTH, write_small_scene

from spike4dgs.benchmark import UserError, open_scene
from spike4dgs.benchmark.scene import other_sensors
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.other_sensors import Events, EventStream, read_events, write_events
from spike4dgs.generators.other_sensors import THRESHOLD, events
from spike4dgs.generators.profiles import PROFILES, Job
from spike4dgs.generators.streams import extras

FACTS = {"events": extras(Job("car", 0, 0, "tiny", PROFILES["tiny"], 0.004))["events"]}
RATE = 20_000


def simulated(seed: int) -> Events:
    """The simulator's events of random light, in the small scene's clip and image."""
    keys = np.exp(np.random.default_rng(seed).normal(-1, 0.5, (5, HEIGHT, WIDTH))).astype(np.float32)
    return events(keys, [0, 20, 40, 60, TICKS], TICKS, RATE)


@pytest.fixture(scope="module")
def one_recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small scene with events at every camera."""
    root = write_small_scene(tmp_path_factory.mktemp("events") / "scene", extras=FACTS)
    for camera in range(4):
        write_events(root / f"events/cam_{camera:02d}.npz", simulated(camera))
    write_manifest(root)
    return root


@pytest.fixture
def recorded(one_recorded: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(one_recorded, tmp_path / "scene"))


def same(a: Events, b: Events) -> bool:
    return all(np.array_equal(x, y) and x.dtype == y.dtype for x, y in zip(a, b, strict=True))


def test_events_are_what_the_simulator_wrote(recorded: Path) -> None:
    scene = open_scene(recorded)
    stream, expected = scene.events("cam_02"), simulated(2)
    assert same(stream.events, expected) and len(stream) == len(expected.t) > 1000
    assert (stream.threshold, stream.rate_hz) == (THRESHOLD, RATE)
    assert same(scene.training.events("cam_02").events, expected)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31), st.floats(0, 4000), st.floats(0, 4000))
def test_events_are_in_order_within_clip_and_image(seed: int, a: float, b: float) -> None:
    with TemporaryDirectory() as folder:
        write_events(Path(folder) / "events/cam.npz", simulated(seed))
        stream = EventStream("cam", WIDTH, HEIGHT, RATE, TICKS, THRESHOLD, write_manifest(Path(folder)))
        found = stream.events  # checked as it is read
    assert (np.diff(found.t) >= 0).all() and ((found.t >= 0) & (found.t < TICKS * 50)).all()
    assert (found.x < WIDTH).all() and (found.y < HEIGHT).all() and set(np.unique(found.p)) <= {0, 1}
    start, stop = min(a, b), max(a, b)
    part = stream.between(start, stop)
    inside = (found.t >= start) & (found.t < stop)
    assert same(part, Events(*(column[inside] for column in found)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t": np.array([5, 1])}, "events in order of time"),
        ({"t": np.array([500, 3], np.uint32)}, "events in order of time"),
        ({"t": np.array([500, 3], np.uint64)}, "events in order of time"),
        ({"t": np.array([1, 4000])}, r"t of every event in \[0, 4000\)"),
        ({"t": np.array([-1, 5])}, "t of every event"),
        ({"x": np.array([3, WIDTH], np.uint16)}, "x of every event in"),
        ({"y": np.array([HEIGHT, 0], np.uint16)}, "y of every event in"),
        ({"p": np.array([1, 2], np.uint8)}, "p of every event in"),
        ({"x": np.array([3], np.uint16)}, "x of every event in"),
    ],
)
def test_events_outside_clip_or_image_are_refused(recorded: Path, change: dict[str, Any], message: str) -> None:
    write_events(recorded / "events/cam_00.npz", pair()._replace(**change))
    write_manifest(recorded)
    stream = open_scene(recorded).events("cam_00")
    with pytest.raises(UserError, match=message):
        _ = stream.events


def pair() -> Events:
    x, y, p = np.array([3, 4], np.uint16), np.array([0, 1], np.uint16), np.array([1, 0], np.uint8)
    return Events(np.array([1, 5]), x, y, p)


def test_methods_get_events_of_training_cameras_only(recorded: Path) -> None:
    scene = open_scene(recorded)
    assert len(scene.events("cam_03")) > 0
    with pytest.raises(UserError, match="expected events of an event camera at cam_03, found those of cam_00, cam_01"):
        scene.training.events("cam_03")
    files = [name for stream in scene.training.found_events.values() for name in stream.files.files]
    assert sorted(files) == [f"events/cam_0{i}.npz" for i in range(3)]


def test_a_scene_without_events_says_so(small_scene: Path) -> None:
    scene = open_scene(small_scene)
    for found in (scene.events, scene.training.events):
        with pytest.raises(UserError, match="events of an event camera at cam_00, found none; use a scene that has"):
            found("cam_00")


def test_more_events_than_can_be_read_are_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, there = tmp_path / "cam.npz", sum(column.nbytes for column in pair())
    monkeypatch.setattr(other_sensors, "_MOST_EVENT_BYTES", there)
    write_events(path, pair())
    assert same(read_events(path), pair())
    monkeypatch.setattr(other_sensors, "_MOST_EVENT_BYTES", there - 1)
    for use in (lambda: read_events(path), lambda: write_events(path, pair())):
        with pytest.raises(UserError, match=f"{there - 1} bytes at most, found {there}"):
            use()


def test_files_come_back_and_damage_is_named(tmp_path: Path) -> None:
    path = tmp_path / "events/cam.npz"
    write_events(path, pair())
    assert same(read_events(path), pair())
    first = path.read_bytes()
    write_events(path, pair())
    assert path.read_bytes() == first
    path.write_bytes(first[: len(first) // 2])
    with pytest.raises(UserError, match="damaged data"):
        read_events(path)
    with pytest.raises(UserError, match="no such file"):
        read_events(tmp_path / "none.npz")
