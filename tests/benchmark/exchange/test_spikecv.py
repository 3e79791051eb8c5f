"""SpikeCV folders: round trips, the layout at sizes that are no whole bytes, and refused folders."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from changes import edit_json
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import HEIGHT, TICKS, WIDTH, array_cameras

from spike4dgs.benchmark import UserError, open_scene
from spike4dgs.benchmark.exchange.recording import Recording
from spike4dgs.benchmark.exchange.spikecv import export_spikecv, import_spikecv
from spike4dgs.benchmark.scene.cameras import to_nerfstudio
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.spikes.folder import open_stream_folder
from spike4dgs.benchmark.spikes.stream import pack
from spike4dgs.cli import main


def write_spikecv(folder: Path, spikes: np.ndarray) -> Path:
    """What SpikeCV counts on: H * W bits to a tick, no padding, bottom row first."""
    folder.mkdir(parents=True)
    np.packbits(spikes[:, ::-1].reshape(-1), bitorder="little").tofile(folder / "a.dat")
    config = {"filename": "a.dat", "spike_w": spikes.shape[2], "spike_h": spikes.shape[1], "is_labeled": False}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    return folder


def random_spikes(n: int, height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2, (n, height, width), dtype=np.uint8)


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 1100), st.integers(1, 9), st.integers(8, 21), st.integers(0, 9))
def test_any_size_imports(tmp_path_factory: pytest.TempPathFactory, n: int, height: int, width: int, seed: int) -> None:
    root = tmp_path_factory.mktemp("spikecv")
    spikes = random_spikes(n, height, width, seed)
    import_spikecv(write_spikecv(root / "cam", spikes), root / "out", Recording(40000.0))
    stream = open_stream_folder(root / "out")["cam"]
    assert (stream.rate_hz, stream.n_ticks, stream.rows_bottom_up) == (40000.0, n, True)
    np.testing.assert_array_equal(stream.window(0, n), spikes)
    if height * width % 8 == 0:
        assert (root / "out/cam.dat").read_bytes() == (root / "cam/a.dat").read_bytes()


def test_a_scene_goes_out_and_comes_back(small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export-spikecv", str(small_scene), "--out", str(tmp_path / "spikecv")]) == 0
    assert "not in SpikeCV's format: 20000 ticks per second" in capsys.readouterr().out
    config = yaml.safe_load((tmp_path / "spikecv/cam_01/config.yaml").read_text())
    assert (config["filename"], config["spike_w"], config["spike_h"]) == ("cam_01.dat", WIDTH, HEIGHT)
    # What SpikeCV's data_parameter_dict asks of the file: the task `raw`, its number 0, is one of the list.
    assert 0 in config["labeled_data_type"] and config["is_labeled"] is False
    transforms = tmp_path / "poses.json"
    transforms.write_text(json.dumps({"frames": [{"camera": c.id, **to_nerfstudio(c)} for c in array_cameras()]}))
    arguments = ["--rate-hz", "20000", "--transforms", str(transforms), "--radiance-gain", "0.6"]
    assert main(["import-spikecv", str(tmp_path / "spikecv"), "--out", str(tmp_path / "back"), *arguments]) == 0
    assert f"{tmp_path}/back/spikes/cam_00.dat: {TICKS} ticks of {WIDTH}x{HEIGHT}" in capsys.readouterr().out
    scene, back = open_scene(small_scene), open_scene(tmp_path / "back")
    assert (back.n_ticks, back.rate_hz, back.radiance_gain, back.targets) == (TICKS, 20000.0, 0.6, ())
    assert back.train == tuple(scene.cameras) and back.test == ()
    for camera in scene.cameras:
        name = f"spikes/{camera}.dat"
        assert (small_scene / name).read_bytes() == (tmp_path / "back" / name).read_bytes()
        np.testing.assert_allclose(back.cameras[camera].w2c, scene.cameras[camera].w2c, atol=1e-12)
    assert len(back.training.streams) == 4


def test_dead_ticks_are_told_of_and_can_be_stated_again(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = Path(shutil.copytree(small_scene, tmp_path / "dead"))
    edit_json(scene / "scene.json", lambda facts: facts["sensor"].update(dead_ticks=1.5))
    write_manifest(scene)
    assert main(["export-spikecv", str(scene), "--out", str(tmp_path / "cv")]) == 0
    assert "20000 ticks per second, 1.5 dead ticks, poses" in capsys.readouterr().out
    import_spikecv(tmp_path / "cv", tmp_path / "back", Recording(20000.0, dead_ticks=1.5))
    assert open_stream_folder(tmp_path / "back")["cam_00"].dead_ticks == 1.5


@settings(max_examples=12, deadline=None)
@given(st.integers(1, 1100), st.integers(1, 9), st.integers(8, 21), st.booleans(), st.integers(0, 9))
def test_a_scene_of_any_size_goes_out_and_comes_back(
    tmp_path_factory: pytest.TempPathFactory, n: int, height: int, width: int, top_down: bool, seed: int
) -> None:
    root, spikes = tmp_path_factory.mktemp("spikecv"), random_spikes(n, height, width, seed)
    top = to_nerfstudio(array_cameras(1, width, height)[0])
    pose = {"camera": "cam", "transform_matrix": top.pop("transform_matrix")}
    (root / "poses.json").write_text(json.dumps({**top, "frames": [pose]}))  # intrinsics once at the top
    known = Recording(20000.0), root / "poses.json"
    source = write_spikecv(root / "cam", spikes[:, ::-1] if top_down else spikes)
    import_spikecv(source, root / "scene", replace(known[0], rows_top_down=top_down), known[1])
    np.testing.assert_array_equal(open_scene(root / "scene").stream("cam").window(0, n), spikes)
    assert (root / "scene/spikes/cam.dat").read_bytes() == pack(spikes, rows_bottom_up=not top_down).tobytes()
    assert f"rows {'top-down' if top_down else 'bottom-up'}" in (root / "scene/README.md").read_text()
    export_spikecv(open_scene(root / "scene"), root / "out")
    no_padding = np.packbits(spikes[:, ::-1].reshape(-1), bitorder="little").tobytes()
    assert (root / "out/cam/cam.dat").read_bytes() == no_padding
    import_spikecv(root / "out", root / "back", *known)
    np.testing.assert_array_equal(open_scene(root / "back").stream("cam").window(0, n), spikes)


def write_dataset(folder: Path, *streams: str) -> np.ndarray:
    """A folder as SpikeCV publishes its own: `filename` names the dataset, the streams lie in folders below."""
    spikes = random_spikes(20, 10, 12)
    config = "filename: vidar_reconstruction2019\nspike_w: 12\nspike_h: 10\nis_labeled: false\n"
    for i, name in enumerate(streams):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        np.packbits(np.roll(spikes, i, axis=0)[:, ::-1].reshape(-1), bitorder="little").tofile(folder / name)
    (folder / "config.yaml").write_text(config + "labeled_data_type: [0]\nlabeled_data_suffix: None\n")
    return spikes


def test_a_dataset_of_spikecv_has_a_camera_for_each_stream_below(tmp_path: Path) -> None:
    spikes = write_dataset(tmp_path / "recVidarReal2019", "classA/ballon.dat", "classB/car.dat")
    import_spikecv(tmp_path / "recVidarReal2019", tmp_path / "out", Recording(40000.0))
    streams = open_stream_folder(tmp_path / "out")
    assert list(streams) == ["ballon", "car"]
    for i, stream in enumerate(streams.values()):
        np.testing.assert_array_equal(stream.window(0, 20), np.roll(spikes, i, axis=0))


def test_streams_that_would_be_one_camera_are_refused(tmp_path: Path) -> None:
    write_dataset(tmp_path / "in", "classA/ballon.dat", "classB/ballon.dat")
    with pytest.raises(UserError, match=r"different names, found .*classA/ballon.dat and .*classB/ballon.dat"):
        import_spikecv(tmp_path / "in", tmp_path / "out", Recording(40000.0))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (None, "expected a folder with config.yaml"),
        ("a: [", "config.yaml: expected a stream's description .YAML., found damaged text"),
        ("just text", "config.yaml: expected filename, spike_w and spike_h"),
        ("{filename: a.dat, spike_w: 11}", "config.yaml: expected filename, spike_w and spike_h, found no 'spike_h'"),
        ("{filename: [a.dat, b.dat], spike_w: 11, spike_h: 5}", "config.yaml: expected .* of one stream"),
        ("{filename: a.dat, spike_w: eleven, spike_h: 5}", "config.yaml: expected .* of one stream"),
        ("{filename: ../b, spike_w: 11, spike_h: 5}", "config.yaml: expected a path inside cam, found '../b'"),
        ("{filename: b.dat, spike_w: 11, spike_h: 5}", "b.dat: expected the stream that config.yaml names, found no"),
        ("{filename: a.dat, spike_w: 12, spike_h: 50}", r"a.dat: expected whole ticks of 12x50 pixels, found 62 bytes"),
    ],
)
def test_bad_folders_are_refused_before_anything_is_written(tmp_path: Path, config: str | None, message: str) -> None:
    folder = write_spikecv(tmp_path / "cam", random_spikes(9, 5, 11))
    (folder / "config.yaml").unlink() if config is None else (folder / "config.yaml").write_text(config)
    with pytest.raises(UserError, match=message) as error:
        import_spikecv(folder, tmp_path / "out", Recording(20000.0))
    assert "\n" not in str(error.value) and not (tmp_path / "out").exists()


def test_poses_must_fit_the_streams(tmp_path: Path) -> None:
    camera = array_cameras(1, 11, 5)[0]
    for name, n in (("cam_00", 9), ("cam_01", 8)):
        write_spikecv(tmp_path / "in" / name, random_spikes(n, 5, 11))

    def attempt(*frames: dict[str, object]) -> None:
        (tmp_path / "poses.json").write_text(json.dumps({"frames": frames}))
        import_spikecv(tmp_path / "in", tmp_path / "out", Recording(1.0), tmp_path / "poses.json")

    pose = to_nerfstudio(camera)
    with pytest.raises(UserError, match=r"found none for cam_01 \(it has cam_00\)"):
        attempt({"camera": "cam_00", **pose})
    with pytest.raises(UserError, match="expected 11x5 pixels for cam_00, found 12x5"):
        attempt({"camera": "cam_00", **pose, "w": 12}, {"camera": "cam_01", **pose})
    for lens in ({"camera_model": "OPENCV_FISHEYE", "k1": 0.05}, {"k4": 0.001}):
        with pytest.raises(UserError, match="expected a camera_model of OPENCV, PINHOLE"):
            attempt({"camera": "cam_00", **pose, **lens}, {"camera": "cam_01", **pose})
    moved = to_nerfstudio(array_cameras(2, 11, 5)[1])
    for other in (moved, {**pose, "fl_x": 2 * camera.fx}, {**pose, "k1": 0.01}, {**pose, "w": 12}):
        with pytest.raises(UserError, match="one camera and pose for all images of cam_00, found another in frame 2"):
            attempt({"camera": "cam_01", **pose}, {"camera": "cam_00", **pose}, {"camera": "cam_00", **other})
    again, others = {"camera": "cam_00", **pose, "time": 0.5}, ({"camera": "x"}, pose, moved)
    with pytest.raises(UserError, match="one size and length for one scene, found 11x5x8 and 11x5x9"):
        attempt({"camera": "cam_00", **pose}, {"camera": "cam_01", **pose}, again, *others)
    assert not (tmp_path / "out").exists()
    (tmp_path / "my scene").mkdir()
    with pytest.raises(UserError, match="--out: expected the id of a scene"):
        import_spikecv(tmp_path / "in", tmp_path / "my scene", Recording(1.0), tmp_path / "poses.json")
    assert not list((tmp_path / "my scene").iterdir())


def test_other_refusals(tmp_path: Path, small_scene: Path) -> None:
    folder = write_spikecv(tmp_path / "cam", random_spikes(9, 5, 11))
    with pytest.raises(UserError, match="expected positive numbers, at most 1e.09, found 0, 1"):
        import_spikecv(folder, tmp_path / "out", Recording(0))
    with pytest.raises(UserError, match="--licence: expected --transforms beside it"):
        import_spikecv(folder, tmp_path / "out", Recording(1.0, licence="CC0-1.0"))
    scene = open_scene(small_scene)
    for command in (lambda: import_spikecv(folder, folder, Recording(1.0)), lambda: export_spikecv(scene, folder)):
        with pytest.raises(UserError, match="expected a new or empty folder"):
            command()
    import_spikecv(folder, tmp_path / "out", Recording(1.0))
    with open(tmp_path / "out/cam.dat", "ab") as file:
        file.truncate(7 * 7)
    with pytest.raises(UserError, match="cam.dat: expected 9 ticks, found 7; the stream is truncated"):
        open_stream_folder(tmp_path / "out")
    (tmp_path / "out/stream.json").write_text('{"schema": "other"}')
    with pytest.raises(UserError, match="stream.json: expected schema 'spike4dgs-streams/1', found 'other'"):
        open_stream_folder(tmp_path / "out")
    (tmp_path / "out/stream.json").write_text('{"schema": "spike4dgs-streams/1", "streams": {"cam": {}}}')
    with pytest.raises(UserError, match="stream.json: expected file, width"):
        open_stream_folder(tmp_path / "out")
