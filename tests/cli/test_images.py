"""`images` on a bare stream, a folder of streams and a scene: what it writes, keeps, refuses and proposes."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from small_scenes import GAIN, HEIGHT, TICKS, WIDTH, add_gap, lose_ticks, shared_file

from spike4dgs.baselines.images.published.makers import MAKERS
from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark import UserError, open_scene
from spike4dgs.benchmark.exchange.dat import import_dat
from spike4dgs.benchmark.exchange.recording import Recording
from spike4dgs.benchmark.files import read_json
from spike4dgs.benchmark.scene.images import encode_srgb, read_exr, read_png
from spike4dgs.benchmark.spikes.counted_recording import mean_rate
from spike4dgs.benchmark.spikes.sensor_model import gathered
from spike4dgs.benchmark.spikes.stream import open_stream, pack
from spike4dgs.benchmark.spikes.trains import spike_trains
from spike4dgs.cli import main
from spike4dgs.cli.options import white_of
from spike4dgs.method.images import clip_images

SIZE = ["--width", str(WIDTH), "--height", str(HEIGHT), "--rate-hz", "20000"]


@pytest.fixture
def dat(small_scene: Path, tmp_path: Path) -> Path:
    path = tmp_path / "clip.dat"
    path.write_bytes((small_scene / "spikes/cam_01.dat").read_bytes())
    return path


def frames(path: Path) -> list[np.ndarray]:
    video, found = cv2.VideoCapture(str(path)), []
    while (read := video.read())[0]:
        found.append(read[1][..., 0])
    return found


@pytest.mark.parametrize("method", [name for name in IMAGES if name not in {maker.name for maker in MAKERS}])
def test_every_maker_makes_the_images_of_a_dat_file(dat: Path, tmp_path: Path, method: str) -> None:
    out = tmp_path / "out"
    assert main(["images", str(dat), *SIZE, "--method", method, "--every", "40", "--out", str(out)]) == 0
    made = ["000000.exr", "000000.png", "000040.exr", "000040.png", "images.json"]
    assert sorted(p.name for p in (out / "clip").iterdir()) == made
    stream = open_stream(dat, WIDTH, HEIGHT, 2e4)
    white = float(np.percentile(stream.window(0, TICKS).mean(axis=0), 99))
    expected = IMAGES[method](stream, [40], white)[0]
    np.testing.assert_allclose(read_exr(out / "clip/000040.exr"), expected, rtol=1e-3, atol=1e-6)
    np.testing.assert_array_equal(read_png(out / "clip/000040.png"), encode_srgb(expected))


def test_white_is_what_makers_divide_by_also_where_ticks_are_dead(dat: Path) -> None:
    """A pixel that fires at r has gathered r / (1 - N r): without it half an image would be white."""
    dead = replace(open_stream(dat, WIDTH, HEIGHT, 2e4), dead_ticks=0.5)
    white = white_of([mean_rate(dead)], [dead])
    assert white == pytest.approx(np.percentile(gathered(dead.window(0, TICKS).mean(axis=0), 0.5), 99), rel=1e-12)
    image = np.mean([IMAGES["tfi"](dead, [tick], white)[0] for tick in (20, 40, 60)], axis=0)
    assert (image >= 1).mean() < 0.1


def test_one_cameras_spike_trains_are_held_at_a_time(
    small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, held = clip_images.write_clip_images, list[int]()

    def count(out: Path, wanted: clip_images.ClipImages) -> bool:
        held.append(spike_trains.cache_info().currsize)
        return write(out, wanted)

    monkeypatch.setattr("spike4dgs.cli.images.write_clip_images", count)
    method = ["--method", "adaptive", "--every", "40"]
    assert main(["images", str(small_scene), *method, "--out", str(tmp_path / "out")]) == 0
    assert held == [0, 0, 0] and spike_trains.cache_info().currsize == 1


def test_the_video_has_a_frame_for_each_image(dat: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [str(dat), *SIZE, "--every", "10", "--fps", "25", "--out", str(tmp_path / "out")]
    assert main(["images", *arguments]) == 0
    shown = frames(tmp_path / "out/clip.mp4")
    assert len(shown) == 8 and shown[0].shape == (HEIGHT, WIDTH)
    image = read_png(tmp_path / "out/clip/000040.png").astype(float)
    assert np.abs(shown[4] - image).mean() < 20
    printed = capsys.readouterr().out
    assert "0.32 s at 25 frames/s, 80 times slower" in printed and str(tmp_path / "out/clip") in printed


def test_an_odd_size_has_a_video_too(tmp_path: Path) -> None:
    (tmp_path / "odd.dat").write_bytes(np.random.default_rng(0).integers(0, 256, 50 * 35, np.uint8).tobytes())
    size = ["--width", "21", "--height", "13", "--rate-hz", "20000"]
    assert main(["images", str(tmp_path / "odd.dat"), *size, "--out", str(tmp_path / "out")]) == 0
    assert frames(tmp_path / "out/odd.mp4")[0].shape == (14, 22)
    assert read_png(tmp_path / "out/odd/000020.png").shape == (13, 21)


def test_a_scenes_training_cameras_or_those_that_are_named(small_scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert main(["images", str(small_scene), "--every", "40", "--out", str(out)]) == 0
    assert sorted(p.name for p in out.iterdir() if p.is_dir()) == list(open_scene(small_scene).train)
    expected = IMAGES["tfi"](open_scene(small_scene).stream("cam_01"), [40], GAIN)[0]
    np.testing.assert_allclose(read_exr(out / "cam_01/000040.exr"), expected, rtol=1e-3)
    assert main(["images", str(small_scene), "--every", "40", "--out", str(out), "--camera", "cam_03", "cam_00"]) == 0
    assert (out / "cam_03.mp4").is_file()


def test_a_folder_of_streams(dat: Path, tmp_path: Path) -> None:
    import_dat(dat, tmp_path / "in", width=WIDTH, height=HEIGHT, recording=Recording(20000.0))
    assert main(["images", str(tmp_path / "in"), "--every", "40", "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out/clip/000040.png").is_file()


def test_what_is_finished_is_kept_as_it_is(dat: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["images", str(dat), *SIZE, "--out", str(tmp_path / "out")]
    assert main(arguments) == 0
    before = {p: (p.read_bytes(), p.stat().st_mtime_ns) for p in (tmp_path / "out").rglob("*.*")}
    capsys.readouterr()
    assert main(arguments) == 0
    assert "finished before and kept" in capsys.readouterr().out
    for other, message in (
        (["--method", "tfp"], "expected images with maker tfp, found tfi"),
        (["--every", "10"], "expected images with every 10, found 20"),
        (["--rows-top-down"], "expected images with rows_bottom_up False, found True"),
    ):
        assert main([*arguments, *other]) == 2
        error = capsys.readouterr().err
        assert message in error and "choose another --out" in error and error.count("\n") == 1
    assert {p: (p.read_bytes(), p.stat().st_mtime_ns) for p in before} == before
    (tmp_path / "foreign/clip").mkdir(parents=True)
    (tmp_path / "foreign/clip/notes.txt").write_text("mine")
    assert main([*arguments[:-1], str(tmp_path / "foreign")]) == 2
    assert "found other files" in capsys.readouterr().err


@pytest.mark.parametrize(("first", "second"), [(0.0, 2.0), (2.0, 0.0)])
def test_images_of_another_sensor_are_not_kept(dat: Path, tmp_path: Path, first: float, second: float) -> None:
    """Its dead ticks alone change the images of the same spikes."""
    one, two = (replace(open_stream(dat, WIDTH, HEIGHT, 2e4), dead_ticks=ticks) for ticks in (first, second))
    wanted = clip_images.ClipImages("cam", one, IMAGES["tfp"], every=40, gain=GAIN, fps=25.0)
    assert clip_images.write_clip_images(tmp_path / "out", wanted)
    with pytest.raises(UserError, match="images with dead_ticks"):
        clip_images.write_clip_images(tmp_path / "out", replace(wanted, stream=two))


def test_a_stopped_run_goes_on(dat: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    arguments, out = ["images", str(dat), *SIZE, "--every", "10", "--out"], tmp_path / "out"
    assert main([*arguments, str(tmp_path / "whole")]) == 0
    write, done = clip_images.write_png, []

    def stop(path: Path, image: np.ndarray) -> None:
        if len(done) == 3:
            raise KeyboardInterrupt
        done.append(path)
        write(path, image)

    monkeypatch.setattr(clip_images, "write_png", stop)
    assert main([*arguments, str(out)]) == 130
    assert len(list(out.rglob("*.png"))) == 3 and not (out / "clip.mp4").exists()
    monkeypatch.setattr(clip_images, "write_png", write)
    kept = done[0].stat().st_mtime_ns
    assert main([*arguments, str(out)]) == 0
    assert done[0].stat().st_mtime_ns == kept and read_json(out / "clip/images.json", "images")["complete"] is True
    for whole in (tmp_path / "whole").rglob("*.*"):
        assert (out / whole.relative_to(tmp_path / "whole")).read_bytes() == whole.read_bytes()


def test_images_at_lost_ticks_are_absent(small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    add_gap(small_scene, "cam_01", 35, 10)
    arguments = ["images", str(small_scene), "--camera", "cam_01", "--out", str(tmp_path / "out")]
    assert main(arguments) == 2
    assert "a recording without gaps" in capsys.readouterr().err
    assert main([*arguments, "--allow-gaps"]) == 0
    assert sorted(p.stem for p in (tmp_path / "out").rglob("*.png")) == ["000000", "000020", "000060"]


def test_images_of_a_recording_whose_gaps_were_corrected_are_not_kept(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["images", str(small_scene), "--camera", "cam_01", "--out", str(tmp_path / "out"), "--allow-gaps"]
    add_gap(small_scene, "cam_01", 35, 10)
    assert main(arguments) == 0
    add_gap(small_scene, "cam_01", 45, 20)
    assert main(arguments) == 2 and "out/cam_01" in capsys.readouterr().err


def test_images_beside_missing_ticks_are_not_darker(small_scene: Path, tmp_path: Path) -> None:
    """What a recorder lost is filled, as in a fit: zeros are no darkness."""
    arguments = ["images", str(small_scene), "--camera", "cam_01", "--method", "tfp", "--every", "4", "--allow-gaps"]
    assert main([*arguments, "--out", str(tmp_path / "whole")]) == 0
    lose_ticks(small_scene, "cam_01", 35, 10)
    assert main([*arguments, "--out", str(tmp_path / "lost")]) == 0
    for tick in (32, 48):
        whole, lost = (read_exr(tmp_path / f"{of}/cam_01/{tick:06d}.exr").mean() for of in ("whole", "lost"))
        assert lost == pytest.approx(whole, rel=0.04)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no --width, --height, --rate-hz; state the camera's; its length fits 64x40"),
        ([*SIZE, "--method", "tvs"], "--method: expected one of tfp, tfi, tfstp, "),
        ([*SIZE, "--every", "0"], "--every: expected 1 tick or more, found 0"),
        ([*SIZE, "--fps", "0"], "--fps: expected 0.001 to 1000, found 0"),
        ([*SIZE, "--radiance-gain", "-1"], "--radiance-gain: expected"),
        ([*SIZE, "--camera", "cam_09"], "--camera: expected among clip, found cam_09"),
        (["--width", "41", *SIZE[2:]], "whole ticks of 123 bytes (41x24)"),
        (["--width", "0", *SIZE[2:]], "--width and --height: expected 1 to"),
    ],
)
def test_bad_arguments_are_one_line_and_write_nothing(
    dat: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    assert main(["images", str(dat), *arguments, "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and not (tmp_path / "out").exists()


def test_a_network_without_weights_says_what_it_needs(
    dat: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("SPIKE4DGS_IMAGES", str(tmp_path / "absent.safetensors"))
    assert main(["images", str(dat), *SIZE, "--method", "msdi", "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert "expected weights of the image network" in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("method", ["adaptive", "intervals", "msdi", "tfi"])
def test_a_clip_whose_spikes_do_not_fit_into_memory(
    dat: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], method: str
) -> None:
    monkeypatch.setattr("spike4dgs.cli.images.free_bytes", lambda: 10_000)
    arguments = ["images", str(dat), *SIZE, "--method", method, "--out", str(tmp_path / "out")]
    if method == "tfi":
        assert main(arguments) == 0
        return
    assert main(arguments) == 2
    assert f"--method {method}: expected 0.0 GB of free memory for the spike trains of clip" in capsys.readouterr().err


def test_import_dat_warns_of_a_swapped_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    y, x = np.mgrid[:60, :96]
    spikes = np.random.default_rng(0).random((100, 60, 96)) < 0.3 + 0.2 * np.sin(x / 9) * np.cos(y / 7)
    (tmp_path / "clip.dat").write_bytes(pack(spikes).tobytes())
    arguments = ["import-dat", str(tmp_path / "clip.dat"), "--rate-hz", "20000"]
    assert main([*arguments, "--width", "60", "--height", "96", "--out", str(tmp_path / "wrong")]) == 0
    assert capsys.readouterr().err.endswith("try --width 96 --height 60\n")
    assert main([*arguments, "--width", "96", "--height", "60", "--out", str(tmp_path / "right")]) == 0
    assert capsys.readouterr().err == ""


def test_the_real_recording_and_a_swapped_size(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(shared_file("data/real_spikes/car_100kmh_250x400_200f.dat"))
    assert main(["images", path, "--out", str(tmp_path / "none")]) == 2
    fits = "its length fits 400x250, 200x125, 1000x1000, its rows 400x250 best"
    assert fits in capsys.readouterr().err
    arguments = ["images", path, "--rate-hz", "40000", "--every", "100"]
    assert main([*arguments, "--width", "400", "--height", "250", "--out", str(tmp_path / "right")]) == 0
    assert capsys.readouterr().err == ""
    assert main([*arguments, "--width", "250", "--height", "400", "--out", str(tmp_path / "wrong")]) == 0
    warning = capsys.readouterr().err
    assert warning.endswith("try --width 400 --height 250\n") and warning.count("\n") == 1
    image = read_png(tmp_path / "right/car_100kmh_250x400_200f/000100.png").astype(float)
    assert image.shape == (250, 400) and image[180:, 200:240].mean() > image[:60].mean(), "the white car, right way up"
    json.loads((tmp_path / "right/car_100kmh_250x400_200f/images.json").read_text())
