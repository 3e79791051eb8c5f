"""Bare streams with cameras of COLMAP, OpenCV and Kalibr, which are compared with those programs' own projections."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import yaml
from small_scenes import HEIGHT, TICKS, WIDTH, array_cameras, shared_file

from spike4dgs.benchmark import Camera, UserError, open_scene
from spike4dgs.benchmark.exchange.dat import import_dat
from spike4dgs.benchmark.exchange.recording import Recording
from spike4dgs.benchmark.spikes.folder import open_stream_folder
from spike4dgs.benchmark.spikes.stream import pack
from spike4dgs.cli import main

CAMERAS = array_cameras(3)
POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
SIZE: Any = {"width": WIDTH, "height": HEIGHT}
STATED: Any = SIZE | {"recording": Recording(20000.0)}
BENT = np.array([0.2, 0, 0, 0, 0])  # moves the corners by pixels
SLIGHT = BENT * 1e-3


def write_streams(folder: Path, names: Sequence[str], ticks: int = TICKS) -> dict[str, np.ndarray]:
    rng, made = np.random.default_rng(1), {}
    folder.mkdir(parents=True)
    for name in names:
        made[name] = rng.random((ticks, HEIGHT, WIDTH)) < 0.3
        pack(made[name]).tofile(folder / f"{name}.dat")
    return made


def write_colmap(folder: Path, lens: str = "PINHOLE", more: Sequence[float] = (), names: Sequence[str] = ()) -> Path:
    model = pycolmap.Reconstruction()
    for i, c in enumerate(CAMERAS, start=1):
        params = [*([c.fx] if "RADIAL" in lens else [c.fx, c.fy]), c.cx, c.cy, *more]
        camera = pycolmap.Camera(camera_id=i, model=lens, width=c.width, height=c.height, params=params)
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(image_id=i, camera_id=i, name=(names or [f"{c.id}.png" for c in CAMERAS])[i - 1])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(c.R), c.t))
    folder.mkdir(parents=True)
    model.write_text(str(folder)) if "text" in folder.name else model.write_binary(str(folder))
    return folder


def opencv_matrix(c: Camera) -> np.ndarray:
    """The same camera where pixel centres are at whole numbers."""
    return c.K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


def write_opencv(
    path: Path, distortion: np.ndarray | None = None, leave_out: str = "", vector: bool = False, **more: Any
) -> Path:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for c in CAMERAS:
        R = cv2.Rodrigues(c.R)[0] if vector else c.R
        values = {"camera_matrix": opencv_matrix(c), "R": R, "T": c.t.reshape(3, 1), "image_width": c.width}
        values |= {"image_height": c.height} | ({} if distortion is None else {"distortion_coefficients": distortion})
        values |= more
        file.startWriteStruct(c.id, cv2.FILE_NODE_MAP)
        for key, value in values.items():
            if key != leave_out:
                file.write(key, value)
        file.endWriteStruct()
    file.release()
    return path


def write_kalibr(
    path: Path,
    lens: str = "radtan",
    coefficients: Sequence[float] = (0, 0, 0, 0),
    names: Sequence[str] = tuple(c.id for c in CAMERAS),
    sort_keys: bool = True,
    **more: Any,
) -> Path:
    chain: dict[str, Any] = {}
    for i, (name, c) in enumerate(zip(names, CAMERAS, strict=True)):
        K = opencv_matrix(c)
        chain[name] = {
            "camera_model": "pinhole",
            "intrinsics": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]],
            "distortion_model": lens,
            "distortion_coeffs": list(coefficients),
            "resolution": [c.width, c.height],
            "rostopic": f"/{name}/image_raw",
        } | more
        if i:
            chain[name]["T_cn_cnm1"] = (c.w2c @ CAMERAS[i - 1].c2w).tolist()
    path.write_text(yaml.safe_dump(json.loads(json.dumps(chain, default=float)), sort_keys=sort_keys))
    return path


def test_a_file_without_cameras_becomes_a_folder_of_streams(tmp_path: Path) -> None:
    spikes = write_streams(tmp_path / "in", ["left"])["left"]
    assert set(import_dat(tmp_path / "in" / "left.dat", **STATED, out=tmp_path / "out")) == {"left"}
    (stream,) = open_stream_folder(tmp_path / "out").values()
    assert (stream.rate_hz, stream.n_ticks) == (20000.0, TICKS)
    np.testing.assert_array_equal(stream.window(0, TICKS), spikes)
    import_dat(tmp_path / "in", **SIZE, recording=Recording(20000.0, rows_top_down=True), out=tmp_path / "top")
    np.testing.assert_array_equal(open_stream_folder(tmp_path / "top")["left"].window(0, TICKS), spikes[:, ::-1])


def test_colmap_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spikes = write_streams(tmp_path / "in", ["cam_00", "cam_02"])
    for kind in ("text", "binary"):
        model = write_colmap(tmp_path / kind)
        known = {**SIZE, "recording": Recording(20000.0, 0.5), "cameras": model}
        import_dat(tmp_path / "in", **known, out=tmp_path / f"{kind}-out")
        assert "no stream of cam_01: left out" in capsys.readouterr().out
        scene = open_scene(tmp_path / f"{kind}-out")
        assert scene.train == ("cam_00", "cam_02") and scene.test == () and scene.radiance_gain == 0.5
        np.testing.assert_array_equal(scene.stream("cam_02").window(0, TICKS), spikes["cam_02"])
        read = pycolmap.Reconstruction(str(model))
        for image in (i for i in read.images.values() if i.name != "cam_01.png"):
            expected = np.array([image.project_point(p) for p in POINTS])
            found = scene.cameras[image.name.removesuffix(".png")].project(POINTS)[0]
            assert np.abs(found - expected).max() < 1e-6


def test_an_images_folder_names_its_stream_where_its_own_name_is_another_stream(tmp_path: Path) -> None:
    write_streams(tmp_path / "in", ["0", "1", "2"])
    for kind in ("binary", "text"):
        model = write_colmap(tmp_path / kind, names=["0/1.png", "1/2.png", "2/0.png"])
        import_dat(tmp_path / "in", **STATED, cameras=model, out=tmp_path / f"out-{kind}")
        for name, camera in open_scene(tmp_path / f"out-{kind}").cameras.items():
            np.testing.assert_allclose(camera.w2c, CAMERAS[int(name)].w2c, atol=1e-9)


def test_blank_lines_and_comments_of_a_text_model_are_left_out(tmp_path: Path) -> None:
    write_streams(tmp_path / "in", [c.id for c in CAMERAS])
    images = write_colmap(tmp_path / "text") / "images.txt"
    first, *others = [line for line in images.read_text().splitlines() if line and not line.startswith("#")]
    head, between = ["# list", "", f"  {first}", "1 2 -1"], [" # of the others", ""]
    images.write_text("\n".join([*head, *between, *(text for line in others for text in (line, "")), ""]))
    expected = {image.name for image in pycolmap.Reconstruction(str(tmp_path / "text")).images.values()}
    assert expected == {f"{c.id}.png" for c in CAMERAS}, "COLMAP reads them so"
    import_dat(tmp_path / "in", **STATED, cameras=tmp_path / "text", out=tmp_path / "out")
    for name, camera in open_scene(tmp_path / "out").cameras.items():
        np.testing.assert_allclose(camera.w2c, next(c for c in CAMERAS if c.id == name).w2c, atol=1e-9)


def test_a_recording_with_its_description_does_not_lose_it(tmp_path: Path) -> None:
    write_streams(tmp_path / "in", ["cam_00"])
    import_dat(tmp_path / "in", **STATED, out=tmp_path / "recording")
    with pytest.raises(UserError, match=r"recording: expected bare \.dat files, found a recording that stream\.json"):
        import_dat(tmp_path / "recording", **STATED, cameras=write_colmap(tmp_path / "model"), out=tmp_path / "out")


def test_images_of_a_colmap_camera_agree(tmp_path: Path) -> None:
    write_streams(tmp_path / "in", ["cam_00"])
    model = write_colmap(tmp_path / "binary", names=["cam_00/000001.png", "cam_00/000002.png", "cam_01/000001.png"])
    with pytest.raises(UserError, match="one camera and pose for all images of cam_00, found another in cam_00/000002"):
        import_dat(tmp_path / "in", **STATED, cameras=model, out=tmp_path / "out")


@pytest.mark.parametrize("suffix", ["yml", "yaml", "xml"])
def test_opencv_cameras(tmp_path: Path, suffix: str) -> None:
    write_streams(tmp_path / "in", [c.id for c in CAMERAS])
    path = write_opencv(tmp_path / f"cameras.{suffix}", SLIGHT * 0, vector=suffix == "xml", fisheye_model=0)
    import_dat(tmp_path / "in", **STATED, cameras=path, out=tmp_path / "out")
    cameras = open_scene(tmp_path / "out").cameras
    for c in CAMERAS:
        uv = cv2.projectPoints(POINTS, cv2.Rodrigues(c.R)[0], c.t, opencv_matrix(c), np.zeros(5))[0].reshape(-1, 2)
        assert np.abs(cameras[c.id].project(POINTS)[0] - (uv + 0.5)).max() < 1e-5


def test_a_folder_of_opencv_files_has_one_camera_each(tmp_path: Path) -> None:
    c = CAMERAS[1]
    write_streams(tmp_path / "in", [c.id])
    (tmp_path / "calibration").mkdir()
    file = cv2.FileStorage(str(tmp_path / f"calibration/{c.id}.yml"), cv2.FILE_STORAGE_WRITE)
    for key, value in {"K": opencv_matrix(c), "D": np.zeros((1, 5)), "rvec": cv2.Rodrigues(c.R)[0], "t": c.t}.items():
        file.write(key, value)
    file.release()
    import_dat(tmp_path / "in", **STATED, cameras=tmp_path / "calibration", out=tmp_path / "out")
    found = open_scene(tmp_path / "out").cameras[c.id]
    np.testing.assert_allclose(found.w2c, c.w2c, atol=1e-12)
    np.testing.assert_allclose(found.K, c.K, atol=1e-9)


@pytest.mark.parametrize(
    ("names", "sort_keys"), [(("cam0", "cam2", "cam10"), True), (("left", "right-far", "right"), False)]
)
def test_kalibr_cameras_are_seen_from_the_first(tmp_path: Path, names: tuple[str, ...], sort_keys: bool) -> None:
    """Names of one text and a number are in order; of others the file's order is the chain's."""
    write_streams(tmp_path / "in", names)
    chain = write_kalibr(tmp_path / "camchain.yaml", names=names, sort_keys=sort_keys)
    import_dat(tmp_path / "in", **STATED, cameras=chain, out=tmp_path / "out")
    cameras = open_scene(tmp_path / "out").cameras
    np.testing.assert_allclose(cameras[names[0]].w2c, np.eye(4), atol=1e-12)
    first = POINTS @ CAMERAS[0].R.T + CAMERAS[0].t  # the points in the first camera's coordinates
    for name, c in zip(names, CAMERAS, strict=True):
        assert np.abs(cameras[name].project(first)[0] - c.project(POINTS)[0]).max() < 1e-6
    unordered = write_kalibr(tmp_path / "other.yaml", names=("right", "left", "up"))
    with pytest.raises(UserError, match="after left, the first, a 4x4 T_cn_cnm1 of right, found no 'T_cn_cnm1'; put"):
        import_dat(tmp_path / "in", **STATED, cameras=unordered, out=tmp_path / "other")


@pytest.mark.parametrize("kind", ["colmap", "opencv", "kalibr"])
def test_lens_distortion_is_kept(tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    write_streams(tmp_path / "in", [c.id for c in CAMERAS])

    def written(name: str, coefficients: np.ndarray) -> Path:
        if kind == "colmap":
            return write_colmap(tmp_path / name, "OPENCV", coefficients[:4])
        if kind == "opencv":
            return write_opencv(tmp_path / f"{name}.yml", coefficients)
        return write_kalibr(tmp_path / f"{name}.yml", "radtan", coefficients[:4].tolist())

    # A corner is at (w / 2 / f, h / 2 / f) of a pinhole; r (1 + k1 r^2) of it is seen.
    c = CAMERAS[0]
    radius = np.hypot(c.width / 2, c.height / 2)
    expected = BENT[0] * (radius / c.fx) ** 2 * radius
    import_dat(tmp_path / "in", **STATED, cameras=written("bent", BENT), out=tmp_path / "out")
    assert f"cam_00: its lens moves pixels by up to {expected:.2f} px" in capsys.readouterr().out
    scene = open_scene(tmp_path / "out")
    first = CAMERAS[0].w2c if kind == "kalibr" else np.eye(4)  # Kalibr's world is the first camera's
    points = POINTS @ first[:3, :3].T + first[:3, 3]
    for c in CAMERAS:
        uv = cv2.projectPoints(POINTS, cv2.Rodrigues(c.R)[0], c.t, opencv_matrix(c), BENT)[0].reshape(-1, 2)
        assert np.abs(scene.cameras[c.id].project(points)[0] - (uv + 0.5)).max() < 1e-5
    import_dat(tmp_path / "in", **STATED, cameras=written("slight", SLIGHT), out=tmp_path / "slight-out")
    assert f"cam_02: lens distortion of at most {expected / 1000:.3f} px is left out" in capsys.readouterr().out
    assert not open_scene(tmp_path / "slight-out").cameras["cam_02"].distortion


@pytest.mark.parametrize(("model", "lens"), [("SIMPLE_RADIAL", [0.05]), ("RADIAL", [0.05, -0.01])])
def test_radial_colmap_cameras(tmp_path: Path, model: str, lens: list[float]) -> None:
    write_streams(tmp_path / "in", ["cam_00"])
    cameras = write_colmap(tmp_path / "model", model, lens)
    import_dat(tmp_path / "in", **STATED, cameras=cameras, out=tmp_path / "out")
    expected = np.array([pycolmap.Reconstruction(str(cameras)).image(1).project_point(p) for p in POINTS])
    assert np.abs(open_scene(tmp_path / "out").cameras["cam_00"].project(POINTS)[0] - expected).max() < 1e-6


def test_other_lenses_are_refused(tmp_path: Path) -> None:
    write_streams(tmp_path / "in", [c.id for c in CAMERAS])
    c, radius = CAMERAS[0], np.hypot(WIDTH / 2, HEIGHT / 2)
    expected = radius - c.fx * np.arctan(radius / c.fx)
    fisheye = write_kalibr(tmp_path / "camchain.yaml", "equidistant")
    with pytest.raises(UserError, match=f"found another one, with {expected:.2f} px, in cam_00"):
        import_dat(tmp_path / "in", **STATED, cameras=fisheye, out=tmp_path / "out")
    for facts in ({"fisheye_model": 1}, {"distortion_model": "equidistant"}, {"fisheye_model": 1, "D": np.zeros(4)}):
        for suffix in ("yml", "xml"):
            fisheye = write_opencv(tmp_path / f"fisheye.{suffix}", **facts)
            with pytest.raises(UserError, match=f"found another one, with {expected:.2f} px, in cam_00"):
                import_dat(tmp_path / "in", **STATED, cameras=fisheye, out=tmp_path / "out")
    named = write_opencv(tmp_path / "named.yml", np.zeros(4), distortion_model="kannala_brandt4")
    with pytest.raises(UserError, match="a distortion_model of cam_00 among plumb_bob, radtan, .*kannala_brandt4"):
        import_dat(tmp_path / "in", **STATED, cameras=named, out=tmp_path / "out")
    five = write_opencv(tmp_path / "five.yml", np.zeros(5), fisheye_model=1)
    with pytest.raises(UserError, match="expected 4 distortion_coefficients of cam_00, found 5"):
        import_dat(tmp_path / "in", **STATED, cameras=five, out=tmp_path / "out")
    rational = write_opencv(tmp_path / "rational.yml", np.array([0.1, 0, 0, 0, 0, 0.3, 0, 0]))
    with pytest.raises(UserError, match=r"expected OpenCV's lens model \(k1, k2, p1, p2, k3\)"):
        import_dat(tmp_path / "in", **STATED, cameras=rational, out=tmp_path / "out")
    folded = write_opencv(tmp_path / "folded.yml", np.array([-3.0, 0, 0, 0]))
    with pytest.raises(UserError, match="a lens of cam_00 whose model holds up to the image's corners"):
        import_dat(tmp_path / "in", **STATED, cameras=folded, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("model", ["OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"])
def test_a_colmap_fisheye_without_coefficients_is_no_pinhole(tmp_path: Path, model: str) -> None:
    write_streams(tmp_path / "in", ["cam_00"])
    zeros = [0.0] * (
        len(pycolmap.Camera.create_from_model_name(1, model, 1.0, 1, 1).params) - (3 + ("OPENCV" in model))
    )
    cameras = write_colmap(tmp_path / "model", model, zeros)
    radius = np.hypot(WIDTH / 2, HEIGHT / 2)
    off = radius - CAMERAS[0].fx * np.arctan(radius / CAMERAS[0].fx)
    with pytest.raises(UserError, match=f"found another one, with {off:.2f} px, in cam_00"):
        import_dat(tmp_path / "in", **STATED, cameras=cameras, out=tmp_path / "out")


def test_fisheye_coefficients_are_opencvs() -> None:
    from spike4dgs.benchmark.exchange.foreign_camera import fisheye_distortion

    k, xy = np.array([0.1, -0.02, 0.003, -0.001]), np.random.default_rng(3).uniform(-1, 1, (50, 2))
    expected = cv2.fisheye.distortPoints(xy[:, None], np.eye(3), k)[:, 0]
    np.testing.assert_allclose(fisheye_distortion(k)(xy), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--width", "41"], "expected whole ticks of 123 bytes (41x24)"),
        (["--rate-hz", "0"], "--rate-hz and --radiance-gain: expected positive numbers"),
        (["--cameras", "missing.yaml"], "missing.yaml: expected a COLMAP model, or OpenCV's or Kalibr's cameras"),
        (["--licence", "CC0-1.0"], "--licence: expected --cameras beside it"),
        (["--radiance-gain", "0.5"], "--radiance-gain: expected --cameras beside it"),
        (["--cameras", "in"], "in: expected a COLMAP model (cameras.bin or cameras.txt, ...), found none"),
        (["--cameras", "in/cam_00.dat"], "or a file of OpenCV or Kalibr"),
        (["--cameras", "damaged.yml"], "damaged.yml: expected cameras written by OpenCV's FileStorage"),
        (["--cameras", "empty.yml"], "empty.yml: expected camera_matrix, or a map with it for each camera, found none"),
        (["--cameras", "no_pose.yml"], "no_pose.yml: expected R or rvec of cam_00, found none"),
        (["--cameras", "omni.yaml"], "omni.yaml: expected camera_model pinhole of cam_00, found 'omni'"),
        (["--cameras", "fov.yaml"], "expected a distortion_model of cam_00 among none, radtan, equidistant"),
        (["--cameras", "large.yaml"], "large.yaml: expected 40x24 pixels for cam_00, as the streams have, found 8x8"),
        (["--cameras", "part.yaml"], "expected camera_model, intrinsics, distortion_model, distortion_coeffs"),
        (["--cameras", "cut"], "cut: expected a whole COLMAP model, found a damaged one"),
        (["--cameras", "greedy"], "greedy: expected a whole COLMAP model, found a damaged one (images.bin ends"),
        (["--cameras", "camchain.yaml", "--out", "my scene"], "--out: expected the id of a scene"),
        (["--cameras", "others"], "others: expected a camera for each stream, found none for cam_00 (it has a, b, c)"),
    ],
)
def test_bad_input_is_one_line(
    tmp_path: Path, change: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_streams(Path("in"), ["cam_00"])
    Path("damaged.yml").write_text("a: [")
    Path("empty.yml").write_text("%YAML:1.0\n---\na: 1\n")
    write_opencv(Path("no_pose.yml"), leave_out="R")
    write_kalibr(Path("camchain.yaml"))
    write_kalibr(Path("omni.yaml"), camera_model="omni")
    write_kalibr(Path("fov.yaml"), "fov", [1.0])
    write_kalibr(Path("large.yaml"), resolution=[8, 8])
    Path("part.yaml").write_text("cam_00: {camera_model: pinhole}\n")
    cut = write_colmap(Path("cut")) / "cameras.bin"
    cut.write_bytes(cut.read_bytes()[:20])
    (write_colmap(Path("greedy")) / "images.bin").write_bytes(b"\xff" * 200)
    write_colmap(Path("others"), names=["a.png", "b.png", "c.png"])
    given = {"--width": "40", "--height": "24", "--rate-hz": "20000", "--out": "out"}
    given |= dict(zip(change[::2], change[1::2], strict=True))
    assert main(["import-dat", "in", *(text for item in given.items() for text in item)]) == 2
    error = capfd.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("error: ") and message in error
    assert not Path(given["--out"]).exists()


def test_streams_of_other_lengths_are_no_scene(tmp_path: Path) -> None:
    write_streams(tmp_path / "in", ["cam_00"])
    pack(np.zeros((3, HEIGHT, WIDTH), bool)).tofile(tmp_path / "in" / "cam_01.dat")
    with pytest.raises(UserError, match="one size and length for one scene, found 40x24x3 and 40x24x80"):
        import_dat(tmp_path / "in", **STATED, cameras=write_colmap(tmp_path / "m"), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert import_dat(tmp_path / "in", **STATED, out=tmp_path / "out"), "without poses each has its length"
    with pytest.raises(UserError, match="a folder with .dat files"):
        import_dat(tmp_path, **STATED, out=tmp_path / "other")


def test_the_real_recording_comes_in_unchanged(tmp_path: Path) -> None:
    path = shared_file("data/real_spikes/car_100kmh_250x400_200f.dat")
    import_dat(path, width=400, height=250, recording=Recording(40000.0), out=tmp_path / "out")
    assert (tmp_path / "out" / path.name).read_bytes() == path.read_bytes()
    (stream,) = open_stream_folder(tmp_path / "out").values()
    assert stream.counts(0, 200).mean() / 200 == pytest.approx(0.366, abs=5e-4)


def test_the_tail_of_stored_rows_is_dropped(tmp_path: Path) -> None:
    spikes = np.random.default_rng(2).random((5, 6, 24)) < 0.4
    stored = np.concatenate([spikes[:, ::-1], np.ones((5, 6, 16), bool)], axis=2)
    np.packbits(stored, bitorder="little").tofile(tmp_path / "raw.dat")
    main_of = ["import-dat", str(tmp_path / "raw.dat"), "--width", "24", "--height", "6", "--rate-hz", "20000"]
    assert main([*main_of, "--row-columns", "40", "--out", str(tmp_path / "out")]) == 0
    stream = open_stream_folder(tmp_path / "out")["raw"]
    assert (stream.width, stream.n_ticks) == (24, 5)
    np.testing.assert_array_equal(stream.window(0, 5), spikes)
    for wrong in (16, 41):
        known = {"width": 24, "height": 6, "recording": Recording(2e4), "row_columns": wrong}
        with pytest.raises(UserError, match="--row-columns: expected a multiple of 8 from --width"):
            import_dat(tmp_path / "raw.dat", tmp_path / "other", **known)


def test_mirrored_rows_and_dead_ticks_are_stated(tmp_path: Path) -> None:
    spikes = write_streams(tmp_path / "in", [c.id for c in CAMERAS])["cam_00"]
    known = Recording(20000.0, mirrored=True, dead_ticks=1.5)
    import_dat(tmp_path / "in", **SIZE, recording=known, out=tmp_path / "streams")
    import_dat(tmp_path / "in", **SIZE, recording=known, cameras=write_colmap(tmp_path / "m"), out=tmp_path / "scene")
    for stream in (open_stream_folder(tmp_path / "streams")["cam_00"], open_scene(tmp_path / "scene").stream("cam_00")):
        assert stream.dead_ticks == 1.5
        np.testing.assert_array_equal(stream.window(0, TICKS), spikes[:, :, ::-1])
    with pytest.raises(UserError, match="--dead-ticks: expected 0 to 10, found nan"):
        import_dat(tmp_path / "in", **SIZE, recording=Recording(2e4, dead_ticks=float("nan")), out=tmp_path / "o")


def test_a_models_points_rigs_and_frames_are_not_read(tmp_path: Path) -> None:
    """A count of 2^64 frames would keep pycolmap busy for years."""
    write_streams(tmp_path / "in", ["cam_00", "cam_02"])
    model = write_colmap(tmp_path / "binary")
    for name in ("points3D.bin", "rigs.bin", "frames.bin"):
        (model / name).write_bytes(b"\xff" * 200)
    import_dat(tmp_path / "in", **STATED, cameras=model, out=tmp_path / "out")
    for name, camera in open_scene(tmp_path / "out").cameras.items():
        expected = next(c for c in CAMERAS if c.id == name)
        np.testing.assert_allclose(camera.w2c, expected.w2c, atol=1e-12)
        np.testing.assert_allclose(camera.K, expected.K, atol=1e-12)


def test_images_with_points_are_read_without_them(tmp_path: Path) -> None:
    write_streams(tmp_path / "in", ["cam_00"])
    for kind in ("binary", "text"):
        model = pycolmap.Reconstruction(write_colmap(tmp_path / f"bare-{kind}"))
        for image in model.images.values():
            image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([3.0 + i, 5.0])) for i in range(7)])
        folder = tmp_path / kind
        folder.mkdir()
        model.write_text(str(folder)) if kind == "text" else model.write_binary(str(folder))
        import_dat(tmp_path / "in", **STATED, cameras=folder, out=tmp_path / f"{kind}-out")
        found = open_scene(tmp_path / f"{kind}-out").cameras["cam_00"]
        np.testing.assert_allclose(found.w2c, CAMERAS[0].w2c, atol=1e-9)


@pytest.mark.parametrize("wrong", [opencv_matrix(CAMERAS[0]).T.copy(), 2 * opencv_matrix(CAMERAS[0])])
def test_camera_matrices_of_other_conventions_are_refused(tmp_path: Path, wrong: np.ndarray) -> None:
    write_streams(tmp_path / "in", ["cam_00"])
    path = write_opencv(tmp_path / "cameras.yml", camera_matrix=wrong)
    with pytest.raises(UserError, match=r"expected a 3x3 matrix \(fx, 0, cx; 0, fy, cy; 0, 0, 1\) .* for cam_00"):
        import_dat(tmp_path / "in", **STATED, cameras=path, out=tmp_path / "out")


def test_a_matrix_of_ros_states_no_type(tmp_path: Path) -> None:
    values = {"camera_matrix": CAMERAS[0].K, "distortion_coefficients": np.zeros((1, 5)), "R": np.eye(3)}
    node: dict[str, Any] = {
        name: {"rows": m.shape[0], "cols": m.shape[1], "data": m.ravel().tolist()} for name, m in values.items()
    }
    (tmp_path / "left.yaml").write_text(yaml.safe_dump(node | {"T": [0.0, 0.0, 0.0], "distortion_model": "plumb_bob"}))
    write_streams(tmp_path / "in", ["left"])
    import_dat(tmp_path / "in", **STATED, cameras=tmp_path / "left.yaml", out=tmp_path / "out")
    assert open_scene(tmp_path / "out").cameras["left"].fx == CAMERAS[0].fx


@pytest.mark.parametrize("facts", ["rows: 3, dt: d", "rows: 3, cols: 900000000, dt: d", "rows: 3, cols: 3, dt: 3d"])
def test_matrices_that_contradict_themselves(tmp_path: Path, facts: str) -> None:
    """OpenCV's own parser writes beyond its memory for some of them."""
    one = "[ 1., 0., 0., 0., 1., 0., 0., 0., 1. ]"
    text = f"%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix {{ {facts}, data: {one} }}\nR: {one}\nT: [ 0., 0., 0. ]\n"
    (tmp_path / "left.yml").write_text(text)
    write_streams(tmp_path / "in", ["left"])
    with pytest.raises(UserError, match="expected a matrix camera_matrix of left"):
        import_dat(tmp_path / "in", **STATED, cameras=tmp_path / "left.yml", out=tmp_path / "out")


@pytest.mark.parametrize("other", ["b.png", "", ".", "/", ".."])
def test_colmap_images_without_a_stream_refuse_nothing(tmp_path: Path, other: str) -> None:
    """Neither their names nor their cameras, here one whose focal length is 0."""
    model = write_colmap(tmp_path / "binary", names=["cam_00.png", "OTHER_NAME", "c.png"])
    for name, old, new in (
        ("images.bin", b"OTHER_NAME", other.encode()),
        ("cameras.bin", np.float64([CAMERAS[1].fx] * 2).tobytes(), bytes(16)),
    ):
        head, found, tail = (model / name).read_bytes().rpartition(old)
        (model / name).write_bytes(head + new + tail)
        assert found
    write_streams(tmp_path / "in", ["cam_00"])
    import_dat(tmp_path / "in", **STATED, cameras=model, out=tmp_path / "out")
    np.testing.assert_allclose(open_scene(tmp_path / "out").cameras["cam_00"].w2c, CAMERAS[0].w2c, atol=1e-12)


@pytest.mark.parametrize("kind", ["binary", "text"])
def test_an_images_name_that_is_no_text(tmp_path: Path, kind: str) -> None:
    model = write_colmap(tmp_path / kind)
    path = next(model.glob("images.*"))
    path.write_bytes(path.read_bytes().replace(b"cam_01.png", b"cam_\x9e1.png"))
    write_streams(tmp_path / "in", ["cam_00"])
    with pytest.raises(UserError, match="found a damaged one .*can't decode byte 0x9e"):
        import_dat(tmp_path / "in", **STATED, cameras=model, out=tmp_path / "out")
