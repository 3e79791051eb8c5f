"""The export as pycolmap reads it: the same pixels for points, the same images, and a way back by import-dat."""

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image
from small_scenes import HEIGHT, WIDTH, lose_ticks

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark import UserError, open_scene
from spike4dgs.benchmark.exchange.dat import import_dat
from spike4dgs.benchmark.exchange.recording import Recording
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.cli.export_colmap import export_colmap

POINTS = np.random.default_rng(0).uniform(-0.8, 0.8, (50, 3))


def test_colmap_projects_points_as_the_scene_does(small_scene: Path, tmp_path: Path) -> None:
    assert export_colmap(small_scene, tmp_path / "out", every=40) == 0
    scene, model = open_scene(small_scene), pycolmap.Reconstruction(str(tmp_path / "out/sparse/0"))
    names = [f"{camera}/{tick:06d}.png" for camera in scene.train for tick in (0, 40)]
    assert sorted(i.name for i in model.images.values()) == names and model.num_cameras() == 3
    for image in model.images.values():
        expected = scene.cameras[image.name.partition("/")[0]].project(POINTS)[0]
        assert np.abs(np.array([image.project_point(p) for p in POINTS]) - expected).max() < 0.01
        with Image.open(tmp_path / "out/images" / image.name) as png:
            assert png.size == (WIDTH, HEIGHT) and png.mode == "L"


@pytest.mark.parametrize("maker", ["tfp", "tfi"])
def test_images_are_made_of_the_spikes(small_scene: Path, tmp_path: Path, maker: str) -> None:
    export_colmap(small_scene, tmp_path / "out", images=maker, ticks=(30, 50, 30))
    assert sorted(p.name for p in (tmp_path / "out/images/cam_01").iterdir()) == ["000030.png", "000050.png"]
    scene = open_scene(small_scene)
    with Image.open(tmp_path / "out/images/cam_01/000050.png") as png:
        x = np.asarray(png) / 255
    linear = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    expected = np.clip(IMAGES[maker](scene.stream("cam_01"), [50], scene.radiance_gain)[0], 0, 1)
    assert np.abs(linear - expected).max() < 0.006, "half a step of 8 bits near white"


def test_the_way_there_and_back(small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    export_colmap(small_scene, tmp_path / "out")
    assert "left out: cam_03, held out by the split center" in capsys.readouterr().out
    (tmp_path / "in").mkdir()
    for camera in ("cam_00", "cam_01", "cam_02"):
        (tmp_path / f"in/{camera}.dat").write_bytes((small_scene / f"spikes/{camera}.dat").read_bytes())
    size = {"width": WIDTH, "height": HEIGHT, "recording": Recording(20000.0)}
    import_dat(tmp_path / "in", **size, cameras=tmp_path / "out/sparse/0", out=tmp_path / "back")
    scene, back = open_scene(small_scene), open_scene(tmp_path / "back")
    for camera in back.cameras.values():
        np.testing.assert_allclose(camera.w2c, scene.cameras[camera.id].w2c, atol=1e-12)
        np.testing.assert_allclose(camera.K, scene.cameras[camera.id].K, atol=1e-12)


def test_images_at_missing_ticks_are_left_out_and_those_beside_no_darker(small_scene: Path, tmp_path: Path) -> None:
    lose_ticks(small_scene, "cam_01", 35, 10)
    with pytest.raises(UserError, match="a recording without gaps"):
        export_colmap(small_scene, tmp_path / "out")
    export_colmap(small_scene, tmp_path / "out", ticks=(20, 40), allow_gaps=True)
    assert not (tmp_path / "out/images/cam_01/000040.png").exists()
    scene = open_scene(small_scene, allow_gaps=True)
    filled = scene.training.streams[scene.train.index("cam_01")]
    expected = encode_srgb(IMAGES["tfp"](filled, [20], scene.radiance_gain)[0])
    with Image.open(tmp_path / "out/images/cam_01/000020.png") as found:
        np.testing.assert_array_equal(np.asarray(found), expected)
    assert pycolmap.Reconstruction(str(tmp_path / "out/sparse/0")).num_images() == 5


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"images": "video"}, "--images: expected one of tfp, tfi,"),
        ({"every": 0}, "--every: expected 1 tick or more, found 0"),
        ({"every": 5, "ticks": (1,)}, "--ticks and --every: expected one of them, found both"),
        ({"ticks": (40,), "allow_gaps": True}, "a tick with data among those of the images, found none"),
        ({"ticks": (80,)}, "--ticks: expected ticks of the clip, 0 to 79, found 80"),
        ({"split": "left"}, "expected a split among center, found 'left'"),
    ],
)
def test_bad_arguments_are_refused(small_scene: Path, tmp_path: Path, arguments: dict[str, Any], message: str) -> None:
    for camera in open_scene(small_scene).train if arguments.get("allow_gaps") else ():
        lose_ticks(small_scene, camera, 35, 10)
    with pytest.raises(UserError) as e:
        export_colmap(small_scene, tmp_path / "out", **arguments)
    assert message in str(e.value) and not (tmp_path / "out").exists()
