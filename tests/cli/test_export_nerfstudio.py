"""The export against an independent reading of the D-NeRF layout: the same pixels, images and times."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changes import edit_json
from PIL import Image
from small_scenes import TICKS, array_cameras, lose_ticks

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark import Target, UserError, open_scene
from spike4dgs.benchmark.exchange.recording import Recording
from spike4dgs.benchmark.exchange.spikecv import export_spikecv, import_spikecv
from spike4dgs.benchmark.runs.apart.training_part import write_training_part
from spike4dgs.benchmark.scene.cameras import to_nerfstudio
from spike4dgs.benchmark.scene.images import write_exr
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.weights import WeightsError
from spike4dgs.cli.export_nerfstudio import export_nerfstudio


@dataclass
class Loaded:
    """One frame as a D-NeRF reader sees it: float32 poses, one focal length, the middle as principal point."""

    name: str
    rgb: np.ndarray  # [H, W, 3]
    pose: np.ndarray  # [3, 4] camera to world, OpenGL axes
    focal: float
    time: float

    def project(self, points: np.ndarray) -> np.ndarray:
        local = (points - self.pose[:, 3].astype(float)) @ self.pose[:, :3].astype(float)
        height, width = self.rgb.shape[:2]
        u = width / 2 - self.focal * local[:, 0] / local[:, 2]
        return np.stack([u, height / 2 + self.focal * local[:, 1] / local[:, 2]], axis=1)


def load(root: Path, part: str) -> list[Loaded]:
    meta = json.loads((root / f"transforms_{part}.json").read_text())
    found = []
    for frame in meta["frames"]:
        assert not Path(frame["file_path"]).suffix and frame["file_path"].startswith(f"./{part}/")
        path = root / (frame["file_path"] + ".png")
        with Image.open(path) as image:
            assert image.mode == "RGB"
            rgb = np.asarray(image)
        assert (meta["w"], meta["h"]) == rgb.shape[1::-1], "for readers that do not look at the image"
        pose = np.array(frame["transform_matrix"])
        assert pose.shape == (4, 4) and pose[3].tolist() == [0, 0, 0, 1]
        focal = 0.5 * rgb.shape[1] / math.tan(0.5 * meta["camera_angle_x"])
        found.append(Loaded(path.stem, rgb, pose[:3].astype(np.float32), focal, np.float32(frame["time"]).item()))
    return found


def linear(rgb: np.ndarray) -> np.ndarray:
    x = rgb / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


@pytest.fixture
def exported(small_scene: Path, tmp_path: Path) -> Path:
    assert export_nerfstudio(small_scene, tmp_path / "export", every=20) == 0
    return tmp_path / "export"


def test_known_points_fall_on_the_same_pixels(exported: Path) -> None:
    points = np.random.default_rng(0).uniform(-0.8, 0.8, (50, 3))
    cameras = {c.id: c for c in array_cameras()}
    seen = set()
    for part in ("train", "val", "test"):
        for frame in load(exported, part):
            camera = frame.name.rpartition("_")[0]
            assert np.abs(frame.project(points) - cameras[camera].project(points)[0]).max() < 0.01
            seen.add(camera)
    assert seen == set(cameras)


def test_one_file_has_the_intrinsics_of_every_image(exported: Path) -> None:
    """As nerfstudio's parser and nerfbaselines read it: paths with suffix, and parts by the lists of file names."""
    points = np.random.default_rng(0).uniform(-0.8, 0.8, (50, 3))
    cameras, data = {c.id: c for c in array_cameras()}, json.loads((exported / "transforms.json").read_text())
    frames = {frame["file_path"]: frame for frame in data["frames"]}
    for name, f in frames.items():
        with Image.open(exported / name) as image:
            assert image.size == (f["w"], f["h"]) == (40, 24)
        local = np.linalg.inv(f["transform_matrix"]) @ np.c_[points, np.ones(50)].T
        u = f["cx"] - f["fl_x"] * local[0] / local[2]
        v = f["cy"] + f["fl_y"] * local[1] / local[2]
        truth = cameras[Path(name).stem.rpartition("_")[0]].project(points)[0]
        assert np.abs(np.stack([u, v], axis=1) - truth).max() < 1e-9
    for part in ("train", "val", "test"):
        of_part = load(exported, part)
        assert data[f"{part}_filenames"] == [f"{part}/{frame.name}.png" for frame in of_part]
        assert [frames[name]["time"] for name in data[f"{part}_filenames"]] == [frame.time for frame in of_part]


def test_training_images_are_made_of_the_training_spikes(small_scene: Path, exported: Path) -> None:
    scene, frames = open_scene(small_scene), load(exported, "train")
    assert [f.name for f in frames] == [f"{c}_{t:06d}" for c in scene.train for t in (0, 20, 40, 60)]
    assert [f.time for f in frames[:4]] == [0, 0.25, 0.5, 0.75]
    expected = IMAGES["tfp"](scene.stream("cam_01"), [40], scene.radiance_gain)[0]
    found = linear(next(f for f in frames if f.name == "cam_01_000040").rgb)
    assert np.abs(found - np.clip(expected, 0, 1)[..., None]).max() < 0.006, "half a step of 8 bits near white"


def test_images_at_missing_ticks_are_left_out_and_those_beside_no_darker(small_scene: Path, tmp_path: Path) -> None:
    lose_ticks(small_scene, "cam_01", 35, 10)
    export_nerfstudio(small_scene, tmp_path / "out", allow_gaps=True)
    frames, scene = load(tmp_path / "out", "train"), open_scene(small_scene, allow_gaps=True)
    assert [f.name for f in frames if f.name.startswith("cam_01")] == [f"cam_01_{t:06d}" for t in (0, 20, 60)]
    filled = scene.training.streams[scene.train.index("cam_01")]
    expected = IMAGES["tfp"](filled, [20], scene.radiance_gain)[0]
    found = linear(next(f for f in frames if f.name == "cam_01_000020").rgb)
    assert np.abs(found - np.clip(expected, 0, 1)[..., None]).max() < 0.006


def test_a_maker_that_lacks_its_weights_writes_nothing(
    small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.delenv("SPIKE4DGS_WEIGHTS", raising=False)
    with pytest.raises(WeightsError):
        export_nerfstudio(small_scene, tmp_path / "out", images="ssml")
    assert not (tmp_path / "out").exists()


def test_a_recording_without_a_training_image_is_refused(small_scene: Path, tmp_path: Path) -> None:
    for camera in open_scene(small_scene).train:
        lose_ticks(small_scene, camera, 0, 10)
    with pytest.raises(UserError, match="a tick with data among those of the training images, found none"):
        export_nerfstudio(small_scene, tmp_path / "out", every=80, allow_gaps=True)
    assert not (tmp_path / "out").exists()


def test_a_training_part_has_no_test_images(small_scene: Path, tmp_path: Path) -> None:
    part = write_training_part(open_scene(small_scene), tmp_path / "part")
    assert export_nerfstudio(part.root, tmp_path / "out") == 0
    assert len(load(tmp_path / "out", "train")) == 4 * len(part.train)
    assert not (tmp_path / "out/transforms_test.json").exists()


def test_validation_images_lie_between_the_training_times(exported: Path) -> None:
    train, val = ({f.time for f in load(exported, part)} for part in ("train", "val"))
    assert val == {10 / TICKS} and not val & train
    assert {f.name.rpartition("_")[0] for f in load(exported, "val")} == {"cam_00", "cam_01", "cam_02"}


def test_test_images_are_the_ground_truth(small_scene: Path, exported: Path) -> None:
    scene, frames = open_scene(small_scene), load(exported, "test")
    assert [f.name for f in frames] == [f"{t.camera}_{t.tick:06d}" for t in scene.targets]
    for frame, target in zip(frames, scene.targets, strict=True):
        truth = np.clip(scene.ground_truth(target), 0, 1)
        assert np.abs(linear(frame.rgb) - truth[..., None]).max() < 0.006
        assert frame.time == pytest.approx(target.tick / TICKS)


def test_test_images_in_colour(small_scene: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="expected a colour image"):
        export_nerfstudio(small_scene, tmp_path / "gray", colour=True)
    assert not (tmp_path / "gray").exists()
    rgb = np.random.default_rng(0).random((24, 40, 3)).astype(np.float32)
    for tick in (20, 40, 60):
        write_exr(small_scene / f"images/{Target('cam_03', tick).name}.exr", rgb, tick * 50.0)
    write_manifest(small_scene)
    export_nerfstudio(small_scene, tmp_path / "export", colour=True)
    assert np.abs(linear(load(tmp_path / "export", "test")[0].rgb) - rgb).max() < 0.006


def test_other_images_and_steps(small_scene: Path, tmp_path: Path) -> None:
    export_nerfstudio(small_scene, tmp_path / "export", images="tfi", every=30, split="center")
    frames, scene = load(tmp_path / "export", "train"), open_scene(small_scene)
    assert len(frames) == 9
    expected = IMAGES["tfi"](scene.stream("cam_00"), [30], scene.radiance_gain)[0]
    assert np.abs(linear(frames[1].rgb) - np.clip(expected, 0, 1)[..., None]).max() < 0.006


def test_the_losses_are_printed(small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    export_nerfstudio(small_scene, tmp_path / "export", every=40)
    text = capsys.readouterr().out
    assert "transforms_train.json: 6 images" in text and "transforms_test.json: 3 images" in text
    for loss in ("8-bit", "clipped at white", "principal point", "window of spikes", "masks"):
        assert loss in text


def test_recordings_have_no_test_images(small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses = {"frames": [{"camera": c.id, **to_nerfstudio(c)} for c in array_cameras()]}
    (tmp_path / "poses.json").write_text(json.dumps(poses))
    export_spikecv(open_scene(small_scene), tmp_path / "spikecv")
    import_spikecv(tmp_path / "spikecv", tmp_path / "back", Recording(20000.0), tmp_path / "poses.json")
    export_nerfstudio(tmp_path / "back", tmp_path / "export")
    assert len(load(tmp_path / "export", "train")) == 16 and not (tmp_path / "export/transforms_test.json").exists()
    assert "test_filenames" not in json.loads((tmp_path / "export/transforms.json").read_text())
    assert "no transforms_test.json: the scene has no such images" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("cx", 0.5, "found cx of cam_01 off by 0.5 px"),
        ("cy", -0.25, "found cy of cam_01 off by 0.25 px"),
        ("fl_y", 1.0, "found fl_y of cam_01 off by"),
        ("fl_x", 1.0, "found fl_x of cam_01 off by"),
    ],
)
def test_other_cameras_are_refused(small_scene: Path, tmp_path: Path, key: str, change: float, message: str) -> None:
    def move(data: Any) -> None:
        for frame in data["frames"]:
            frame[key] += change * (frame["camera"] == "cam_01")

    edit_json(small_scene / "transforms_train.json", move)
    write_manifest(small_scene)
    with pytest.raises(UserError) as e:
        export_nerfstudio(small_scene, tmp_path / "export")
    assert message in str(e.value) and "\n" not in str(e.value) and not (tmp_path / "export").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"images": "video"}, f"--images: expected one of {', '.join(IMAGES)}, found 'video'"),
        ({"every": 1}, "--every: expected 2 ticks or more, found 1"),
        ({"split": "left"}, "expected a split among center, found 'left'"),
    ],
)
def test_bad_arguments_are_refused(small_scene: Path, tmp_path: Path, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError) as e:
        export_nerfstudio(small_scene, tmp_path / "export", **arguments)
    assert message in str(e.value) and not (tmp_path / "export").exists()
    with pytest.raises(UserError, match="expected a new or empty folder"):
        export_nerfstudio(small_scene, small_scene)
