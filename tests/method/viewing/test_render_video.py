"""Camera paths, videos, and the speed of saved models."""

import csv
import itertools
import resource
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from saved_models import DURATION_US, WORLD, model, provenance

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.reports.video import video_writer
from spike4dgs.benchmark.scene.cameras import Camera, look_at
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.cli import main
from spike4dgs.method.viewing.camera_paths import PathName, fixed, focus, make_path, orbit, resized, rig
from spike4dgs.method.viewing.render_video import frame_times, png_writer

S = np.linspace(0, 1, 33)
UP = np.array([0.0, 0.0, 1.0])


def parallel(n: int = 3) -> tuple[Camera, ...]:
    """Return cameras side by side with parallel axes, 0.2 m apart."""
    one = look_at("a", np.zeros(3), np.array([0.0, 1.0, 0.0]), UP, focal=30, width=40, height=24)
    return tuple(replace(one, id=f"c{i}", t=-one.R @ np.array([0.2 * i, 0, 0])) for i in range(n))


def test_the_focus_is_the_target_of_the_cameras_or_in_front_of_parallel_ones() -> None:
    np.testing.assert_allclose(focus(WORLD.cameras), [0.0, 0.3, 0.7], atol=1e-9)
    np.testing.assert_allclose(focus(parallel()), [0.2, 1.0, 0.0], atol=1e-9)  # five radii of 0.2 m
    np.testing.assert_allclose(focus(parallel(1)), [0.0, 5.0, 0.0], atol=1e-9)


def around(n: int) -> tuple[Camera, ...]:
    """Return cameras on a circle of 2 m around a point, which all face it from a little above."""
    angles = np.arange(n) * 2 * np.pi / n
    at = [np.array([2 * np.cos(a), 2 * np.sin(a), 0.6]) for a in angles]
    aims = {"target": np.array([0.0, 0.0, 0.5]), "up": UP, "focal": 30, "width": 40, "height": 24}
    return tuple(look_at(f"c{i}", center, **aims) for i, center in enumerate(at))


def test_cameras_whose_axes_cancel_have_the_middle_ones_orbit() -> None:
    for n in (3, 6):
        np.testing.assert_allclose(focus(around(n)), [0, 0, 0.5], atol=1e-9)
        path = orbit(around(n))
        for s in S:
            assert path(s).R[1] @ UP < -0.9 and path(s).R[2] @ (focus(around(n)) - path(s).center) > 1.9
    a, b = parallel(2)
    half_turn = np.diag([-1.0, -1.0, 1.0])
    path = orbit((a, replace(b, R=half_turn @ b.R, t=half_turn @ b.t)))
    assert all(path(s).R[1] @ UP < -0.9 for s in S), "the image is upright as the first camera's"


@pytest.mark.parametrize("cameras", [WORLD.cameras, parallel(), parallel(1)], ids=["grid", "row", "one"])
def test_an_orbit_is_closed_stays_within_the_array_and_faces_the_focus(cameras: tuple[Camera, ...]) -> None:
    path, target = orbit(cameras), focus(cameras)
    centers = np.stack([path(s).center for s in S])
    np.testing.assert_allclose(centers[0], centers[-1], atol=1e-12)
    trained = np.stack([c.center for c in cameras])
    middle = trained.mean(0)
    reach = np.linalg.norm(trained - middle, axis=1).max() or 0.05 * np.linalg.norm(target - middle)
    away = np.linalg.norm(centers - middle, axis=1)
    assert away.max() <= reach * (1 + 1e-9) and away.max() > 0.6 * reach
    for s in S:
        uv, z = path(s).project(target[None])
        np.testing.assert_allclose(uv[0], [20, 12], atol=1e-6)
        assert z[0] > 0 and path(s).R[1] @ UP < -0.5, "the image is upright"


def test_the_rig_path_visits_every_training_camera_in_short_steps() -> None:
    lens = (-0.1, 0.02, 0.0, 0.0, 0.0)
    cameras = tuple(
        replace(c, fx=c.fx + i, cy=c.cy + i, distortion=tuple(i * k for k in lens) if i else ())
        for i, c in enumerate(WORLD.cameras)
    )
    path = rig(cameras)
    stops = [path(s) for s in np.linspace(0, 1, len(cameras))]
    for camera in cameras:
        near = min(stops, key=lambda c: np.linalg.norm(c.center - camera.center))
        np.testing.assert_allclose(near.w2c, camera.w2c, atol=1e-9)
        np.testing.assert_allclose(near.K, camera.K, atol=1e-9)
        np.testing.assert_allclose(near.distortion or np.zeros(5), camera.distortion or np.zeros(5), atol=1e-9)
    steps = [np.linalg.norm(b.center - a.center) for a, b in itertools.pairwise(stops)]
    assert max(steps) < 0.81, "never across the array"
    between = path(0.5 / (len(cameras) - 1))
    np.testing.assert_allclose(between.center, (stops[0].center + stops[1].center) / 2, atol=1e-9)
    np.testing.assert_allclose(between.R @ between.R.T, np.eye(3), atol=1e-9)


def test_the_fixed_path_is_one_training_camera() -> None:
    nine = parallel(3)
    assert fixed(nine)(0.3).id == "c1" and fixed(nine, "c2")(0.9) is nine[2]
    with pytest.raises(UserError, match="--camera: expected one of c0, c1, c2, found 'c7'"):
        fixed(nine, "c7")
    with pytest.raises(UserError, match="--path still beside it, found --path orbit"):
        make_path("orbit", nine, "c1")


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0, 3.3])
def test_a_resized_camera_has_the_same_view_in_even_sizes(scale: float) -> None:
    small = replace(WORLD.cameras[0], height=25)
    large = resized(small, scale)
    assert large.width % 2 == large.height % 2 == 0
    assert abs(large.width - scale * small.width) <= 1 and abs(large.height - scale * small.height) <= 1
    point = np.array([[0.3, 0.2, 0.9]])
    share = [c.project(point)[0][0] / [c.width, c.height] for c in (small, large)]
    np.testing.assert_allclose(*share, atol=1e-9)


def test_slow_motion_spaces_the_frames_evenly_over_the_clip() -> None:
    times = frame_times(20_000.0, slow_motion=1000, fps=30)
    assert len(times) == 600 and times[0] == 0.0 and max(times) < 20_000.0
    np.testing.assert_allclose(np.diff(times), 1e6 / 30_000)
    assert frame_times(20_000.0, 1, 30) == [0.0], "a clip shorter than a frame"


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "m.safetensors"
    model("spacetime-lite").save(path, provenance())
    return path


def shown(path: Path) -> list[np.ndarray]:
    """Return the frames of a video, gray."""
    video, frames = cv2.VideoCapture(str(path)), []
    while (read := video.read())[0]:
        frames.append(cv2.cvtColor(read[1], cv2.COLOR_BGR2GRAY))
    return frames


@pytest.mark.parametrize(("path", "suffix"), [("orbit", ".mp4"), ("still", ".avi")])
def test_a_video_has_the_frames_of_the_model(saved: Path, tmp_path: Path, path: PathName, suffix: str, capsys) -> None:
    out, frames = tmp_path / f"v{suffix}", tmp_path / "frames"
    options = ["--path", path, "--slow-motion", "48", "--fps", "25", "--out", str(out), "--frames", str(frames)]
    assert main(["render", str(saved), *options]) == 0
    times, cameras = frame_times(DURATION_US, 48, 25), make_path(path, WORLD.cameras)
    assert len(times) == 6
    expected = [
        encode_srgb(model("spacetime-lite").render(resized(cameras(i / 5), 2.0), t)) for i, t in enumerate(times)
    ]
    assert np.abs(expected[0].astype(int) - expected[-1]).mean() > 2, "the model must move"
    written = [np.asarray(Image.open(p)) for p in sorted(frames.iterdir())]
    # Provenance keeps poses to the last bit but one: a rounding may fall the other way.
    assert np.abs(np.array(written, int) - np.array(expected, int)).max() <= 1
    found = shown(out)
    assert len(found) == 6 and found[0].shape == (48, 80)
    for image, wanted in zip(found, expected, strict=True):
        assert np.abs(image.astype(int) - wanted).mean() < 6
    assert {p.name for p in tmp_path.iterdir()} == {"m.safetensors", out.name, "frames"}, "nothing half written"
    assert "replaced" not in capsys.readouterr().out
    assert main(["render", str(saved), "--slow-motion", "1", "--out", str(out)]) == 0
    assert capsys.readouterr().out.endswith("frames/s; an earlier video was replaced\n")


@pytest.mark.parametrize(("count", "first"), [(3, "00000.png"), (100_001, "000000.png")])
def test_frames_sort_by_name(tmp_path: Path, count: int, first: str) -> None:
    png_writer(tmp_path, count)(np.zeros((2, 2), np.uint8))
    assert [path.name for path in tmp_path.iterdir()] == [first]


def test_colours_survive_the_video(tmp_path: Path) -> None:
    frame = np.zeros((32, 48, 3), np.uint8)
    frame[..., 0] = 200  # red
    with video_writer(tmp_path / "v.avi", (48, 32), 10, gray=False) as write:
        write(frame)
    ok, found = cv2.VideoCapture(str(tmp_path / "v.avi")).read()
    assert ok and np.abs(found[:, :, ::-1].astype(int) - frame).mean() < 4


@pytest.mark.parametrize("suffix", [".mp4", ".avi"])
@pytest.mark.parametrize("gray", [True, False])
def test_a_gray_comes_back_as_it_went_in(tmp_path: Path, suffix: str, gray: bool) -> None:
    ramp = np.arange(1, 250, 8, np.uint8).repeat(16)[None].repeat(32, 0)
    path = tmp_path / f"v{suffix}"
    with video_writer(path, (ramp.shape[1], 32), 10, gray=gray) as write:
        write(ramp if gray else ramp[:, :, None].repeat(3, 2))
    found = cv2.VideoCapture(str(path)).read()[1][16, 8::16].astype(int)
    assert np.ptp(found, axis=1).max() <= 1, "no tint"
    assert np.abs(found - ramp[0, 8::16, None]).max() <= 2


@pytest.mark.parametrize("suffix", [".mp4", ".avi"])
def test_a_video_that_a_disk_has_no_room_for_is_an_error(tmp_path: Path, suffix: str) -> None:
    """OpenCV writes on as if nothing were wrong."""
    images = np.random.default_rng(0).integers(0, 256, (30, 96, 128), np.uint8)
    path, old = tmp_path / f"v{suffix}", resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, old[1]))
    try:
        with pytest.raises(UserError, match="a video with its last frame, found a broken one after 30 frames"):
            with video_writer(path, (128, 96), 30.0, gray=True) as write:
                for image in images:
                    write(image)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
    assert not list(tmp_path.iterdir())


def test_a_failure_leaves_no_video(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"expected frames of 48x32, found 48x30"):
        with video_writer(tmp_path / "v.avi", (48, 32), 10, gray=True) as write:
            write(np.zeros((32, 48), np.uint8))
            write(np.zeros((30, 48), np.uint8))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--out", "v.gif"], "v.gif: expected a video's name, .mp4 or .avi, found '.gif'"),
        (["--slow-motion", "0"], "--slow-motion: expected a positive number, found 0"),
        (["--fps", "nan"], "--fps: expected a number from -1e+12 to 1e+12, found nan"),
        (["--path", "still", "--camera", "x"], "--camera: expected one of cam_00"),
        (["--frames", "."], ".: expected a new or empty folder"),
    ],
)
def test_bad_options_are_one_line(saved: Path, options: list[str], message: str, monkeypatch, capsys) -> None:
    monkeypatch.chdir(saved.parent)
    assert main(["render", str(saved), *options]) == 2
    err = capsys.readouterr().err
    assert message in err and err.count("\n") == 1


def test_speed_render_puts_models_side_by_side(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = ("static", "tracking", "radiance-field")
    for name in names:
        model(name).save(tmp_path / name, provenance(method={**provenance().method, "name": name}))
    files = [str(tmp_path / name) for name in names]
    assert main(["speed", "render", *files, "--times", "2", "--csv", str(tmp_path / "t.csv")]) == 0
    rows = list(csv.DictReader((tmp_path / "t.csv").read_text().splitlines()))
    assert [r["model"] for r in rows] == [f"{name} on toy" for name in names]
    assert all(r["pixels"] == "40x24" and float(r["frames/s"]) > 0 for r in rows)
    assert [r["Gaussians"] for r in rows] == ["120", "120", ""], "a radiance field has none"
    for row in rows[:2]:
        assert float(row["min ms"]) <= float(row["median ms"])
        assert float(row["frames/s"]) == pytest.approx(1e3 / float(row["median ms"]), rel=0.05)


def test_where_no_video_can_be_written_the_system_says_why() -> None:
    with pytest.raises(UserError) as told, video_writer(Path("/proc/v.avi"), (48, 32), 10, gray=True):
        pass
    assert "/proc/v.avi" in str(told.value) and "encoder" not in str(told.value)
