"""Scenes of footage: light, cameras, truth and spikes against what the frames say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image
from small_scenes import array_cameras

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.exchange.camera_files import read_camera_files
from spike4dgs.benchmark.scene.calibration import estimate
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.cli import main
from spike4dgs.generators.held_frames.footage import find_footage
from spike4dgs.generators.held_frames.scene import Holding, moving_regions, write_held_frames

WIDTH, HEIGHT, FRAMES = 80, 48, 5
CAMERAS = array_cameras(3, WIDTH, HEIGHT)
HOLDING = Holding(held_out="cam_01", width=40, hold_ticks=200, every=2)


def frame(camera: int, k: int, colour: bool = False) -> np.ndarray:
    """A bright square on a ramp; it moves with k."""
    image = np.tile(np.linspace(40, 180, WIDTH), (HEIGHT, 1))
    image[10:26, 8 + 8 * k : 24 + 8 * k] = 230
    image = image + 5 * camera
    return np.stack([image, image / 2, image / 4], -1).astype(np.uint8) if colour else image.astype(np.uint8)


def write_footage(folder: Path, colour: bool = False) -> Path:
    for i, camera in enumerate(CAMERAS):
        (folder / camera.id).mkdir(parents=True)
        for k in range(FRAMES):
            Image.fromarray(frame(i, k, colour)).save(folder / camera.id / f"{k}.png")
    return folder


def write_scene(folder: Path, colour: bool = False, cameras: tuple[Camera, ...] = CAMERAS, **changes: Any) -> Scene:
    """Write footage and hold its frames."""
    footage = find_footage(write_footage(folder / "footage", colour))
    write_held_frames(folder / "scene", footage, cameras, replace(HOLDING, **changes))
    return open_scene(folder / "scene")


def light_of(image: np.ndarray, linear: bool) -> np.ndarray:
    """Radiance of half-size pixels, by the definition of sRGB and by hand."""
    x = image / 255
    if not linear:
        x = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    return x.reshape(HEIGHT // 2, 2, WIDTH // 2, 2, *x.shape[2:]).mean((1, 3))


@pytest.mark.parametrize("linear", [False, True])
def test_truth_and_spikes_are_the_light_of_the_frames(tmp_path: Path, linear: bool) -> None:
    scene = write_scene(tmp_path, linear=linear)
    assert (scene.n_ticks, scene.train, scene.test) == (600, ("cam_00", "cam_02"), ("cam_01",))
    assert [t.tick for t in scene.targets] == [100, 300, 500]
    for k, target in enumerate(scene.targets):
        np.testing.assert_allclose(scene.ground_truth(target), light_of(frame(1, 2 * k), linear), atol=5e-4)
    for i, camera in enumerate(CAMERAS):
        maps = np.load(tmp_path / f"scene/truth/{camera.id}.npz")
        for k in range(3):  # all ticks of an instant see one image: counts are the light's to a spike and shot noise
            counts = scene.stream(camera.id).counts(200 * k, 200 * (k + 1))
            rate = scene.radiance_gain * light_of(frame(i, 2 * k), linear) * maps["gain"] + maps["dark"]
            assert np.abs(counts - 200 * np.minimum(rate, 1)).max() < 1.5


def test_a_damaged_frame_leaves_nothing_and_the_mended_footage_is_taken(tmp_path: Path) -> None:
    footage = find_footage(write_footage(tmp_path / "footage"))
    image = tmp_path / "footage/cam_02/2.png"
    whole = image.read_bytes()
    image.write_bytes(whole[:60])
    with pytest.raises(UserError, match="cam_02/2.png: expected an image, found damaged data"):
        write_held_frames(tmp_path / "scene", footage, CAMERAS, HOLDING)
    assert not (tmp_path / "scene").exists()
    image.write_bytes(whole)
    write_held_frames(tmp_path / "scene", footage, CAMERAS, HOLDING)
    assert open_scene(tmp_path / "scene").test == ("cam_01",)


def test_colour_is_kept_in_the_truth_and_gray_is_what_the_sensors_see(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, colour=True)
    light = light_of(frame(1, 0, colour=True), linear=False)
    np.testing.assert_allclose(scene.ground_truth_rgb(scene.targets[0]), light, atol=5e-4)
    weights = np.array([0.2127, 0.7152, 0.0722])  # of CIE Y
    np.testing.assert_allclose(scene.ground_truth(scene.targets[0]), light @ weights, atol=5e-4)


def test_the_shrunk_camera_sees_points_where_the_shrunk_frames_show_them(tmp_path: Path) -> None:
    bent = tuple(replace(c, distortion=(-0.2, 0.05, 0.001, 0.0, 0.0)) for c in CAMERAS)
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 3))
    small = write_scene(tmp_path, cameras=bent).cameras
    for camera in bent:
        np.testing.assert_allclose(small[camera.id].project(points)[0], camera.project(points)[0] / 2, atol=1e-9)


def test_its_calibration_is_that_of_the_sensors(tmp_path: Path) -> None:
    found = estimate(write_scene(tmp_path).recordings("cam_00"))
    true = np.load(tmp_path / "scene/truth/cam_00.npz")
    assert np.abs(found.gain / true["gain"] - 1).mean() < 0.01


def test_the_same_footage_gives_the_same_scene_and_another_seed_another(tmp_path: Path) -> None:
    first, again, other = (write_scene(tmp_path / f"{k}", seed=seed).revision for k, seed in enumerate((0, 0, 1)))
    assert first == again != other


def test_what_moves_is_found_and_nothing_else() -> None:
    rng = np.random.default_rng(0)
    images = np.full((7, 30, 40), 0.3, np.float32) + rng.normal(0, 0.004, (7, 30, 40)).astype(np.float32)
    for k in range(7):
        images[k, 10:16, 5 * k : 5 * k + 6] = 0.6
    images[3, 25, 35] = 0.9  # one pixel: a speck
    masks = moving_regions(images)
    for k in range(7):
        expected = np.zeros((30, 40), bool)
        expected[8:18, max(5 * k - 2, 0) : 5 * k + 8] = True
        assert (masks[k] == expected).all()
    assert not moving_regions(images[:1]).any()


@pytest.mark.parametrize(
    ("change", "option"),
    [
        ({"held_out": "cam_09"}, "--held-out"),
        ({"width": WIDTH + 1}, "--width"),
        ({"hold_ticks": 1}, "--hold-ticks"),
        ({"every": 0}, "--every"),
        ({"instants": 4}, "--instants"),
        ({"instants": 0}, "--instants"),
        ({"width": 0}, "--width"),
    ],
)
def test_settings_that_do_not_fit_are_refused_before_anything_is_written(
    tmp_path: Path, change: dict[str, object], option: str
) -> None:
    with pytest.raises(UserError, match=f"^{option}: expected"):
        write_scene(tmp_path, **change)
    assert not (tmp_path / "scene").exists()


def test_a_folder_that_names_no_scene_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    footage = find_footage(write_footage(tmp_path / "footage"))
    with pytest.raises(UserError, match=r"^--out: expected the id of a scene"):
        write_held_frames(tmp_path / "my fly", footage, CAMERAS, HOLDING)
    assert not (tmp_path / "my fly").exists()


def test_the_command_prints_errors_of_cameras_and_writes_the_scene(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = cv2.FileStorage(str(tmp_path / "cameras.yml"), cv2.FILE_STORAGE_WRITE)
    marks = ["camera,frame,point,x,y"]
    for c in CAMERAS:
        file.startWriteStruct(c.id, cv2.FILE_NODE_MAP)
        file.write("camera_matrix", c.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]))
        file.write("R", c.R)
        file.write("T", c.t.reshape(3, 1))
        file.endWriteStruct()
        for p, (x, y) in enumerate(c.project(np.eye(3) * 0.3)[0] - 0.5):
            marks.append(f"{c.id},0,{p},{x + 2 * (c.id == 'cam_02')},{y}")  # the last camera is off by 2 px
    file.release()
    (tmp_path / "points.csv").write_text("\n".join(marks) + "\n")
    arguments = ["import-frames", str(write_footage(tmp_path / "footage")), "--cameras", str(tmp_path / "cameras.yml")]
    arguments += ["--points", str(tmp_path / "points.csv"), "--out", str(tmp_path / "scene")]
    assert main([*arguments, "--held-out", "cam_01", "--width", "40"]) == 0
    printed = capsys.readouterr().out
    assert "cam_02      3" in printed and "5 instants, 500 ticks, 25 ms" in printed
    assert main(["verify", str(tmp_path / "scene")]) == 0
    assert open_scene(tmp_path / "scene").meta["source"]["kind"] == "frames"
    assert [c.id for c in read_camera_files(tmp_path / "cameras.yml", ["cam_00"], (WIDTH, HEIGHT))] == ["cam_00"]
