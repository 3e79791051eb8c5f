"""`inspect` on streams whose bad pixels and intervals are known, and on the optional real recording."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from small_scenes import shared_file

from spike4dgs.benchmark import UserError, open_scene
from spike4dgs.benchmark.exchange.streams import DatFile
from spike4dgs.benchmark.runs.apart.training_part import write_training_part
from spike4dgs.benchmark.scene.calibration import Recordings
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.spikes.bad_pixels import from_recordings, isolated
from spike4dgs.benchmark.spikes.stream import SpikeStream, open_stream, pack
from spike4dgs.cli import main
from spike4dgs.cli.inspect import _between_counts, examine, inspect, write_image


def steady(ticks: int = 400, height: int = 24, width: int = 40) -> np.ndarray:
    """Ideal integrate-and-fire under smooth, steady light, with two dead pixels and a hot one. [T, H, W] bool."""
    y, x = np.mgrid[:height, :width]
    rate = 0.25 + 0.1 * np.sin(x / 9) * np.cos(y / 7)
    rate[5, 7] = rate[20, 30] = 0
    rate[11, 13] = 0.95
    charge = np.random.default_rng(0).random((height, width))
    fired = np.empty((ticks, height, width), bool)
    for t in range(ticks):
        charge += rate
        fired[t] = charge >= 1
        charge -= fired[t]
    return fired


def stream_of(fired: np.ndarray) -> SpikeStream:
    return SpikeStream(pack(fired), fired.shape[2], fired.shape[1], 20_000.0)


def test_bad_pixels_are_found_and_no_others() -> None:
    fired = steady()
    report = examine("made", stream_of(fired))
    np.testing.assert_allclose(report.rate, fired.mean(axis=0), atol=1e-12)
    assert sorted(map(tuple, np.argwhere(report.bad.dead))) == [(5, 7), (20, 30)]
    assert list(map(tuple, np.argwhere(report.bad.hot))) == [(11, 13)]


@pytest.mark.parametrize(("most", "width"), [(0, 1), (60, 1), (320, 4)])
def test_bins_of_rates_lie_between_counts(most: int, width: int) -> None:
    fired = np.arange(400)[:, None, None] < np.arange(most + 1)[None, None, :]
    report = examine("made", stream_of(fired))
    pixels, edges = np.histogram(report.rate, _between_counts(report))
    assert set(pixels[:-1]) <= {width} and pixels.sum() == most + 1 and len(pixels) <= 100
    assert edges[0] == -0.5 / 400


def test_bright_lines_and_dark_ones_are_no_bad_pixels() -> None:
    rate = np.full((24, 40), 0.2)
    rate[10, :] = rate[np.arange(24), np.arange(24)] = 0.8
    rate[:, 30], rate[5, 35], rate[15, 5] = 0.0, 0.8, 0.0
    found = isolated(rate, 400)
    assert list(map(tuple, np.argwhere(found.hot))) == [(5, 35)]
    assert list(map(tuple, np.argwhere(found.dead))) == [(15, 5)]


def test_large_images_are_compared_in_parts_without_seams() -> None:
    rng = np.random.default_rng(0)
    rate = rng.uniform(0.2, 0.22, (230, 50))
    hot = [(98, 10), (99, 20), (100, 30), (199, 40), (229, 5), (229, 49)]
    for y, x in hot:
        rate[y, x] = 0.9
    assert list(map(tuple, np.argwhere(isolated(rate, 1000).hot))) == hot


def test_recordings_tell_bad_pixels_where_there_are_some() -> None:
    rng = np.random.default_rng(4)
    dark_rate = np.full((24, 40), 0.01)
    dark_rate[3, 4:6] = 0.06  # two beside each other, which isolation would miss
    light_rate = np.full((24, 40), 0.4)
    light_rate[20, 7:9] = 0

    def ideal(rate: np.ndarray) -> SpikeStream:
        phase = np.arange(2001)[:, None, None] * rate + rng.random(rate.shape)
        return stream_of(np.diff(np.floor(phase), axis=0) > 0)

    clip = ideal(np.where(np.arange(40) == 20, 0.9, 0.1) * np.ones((24, 1)))
    report = examine("made", clip, Recordings(ideal(light_rate), ideal(dark_rate), 0.7))
    assert list(map(tuple, np.argwhere(report.bad.hot))) == [(3, 4), (3, 5)]
    assert list(map(tuple, np.argwhere(report.bad.dead))) == [(20, 7), (20, 8)]
    assert report.bad.source == "recordings"
    with pytest.raises(UserError, match="expected a spike of a usual pixel, found none"):
        from_recordings(ideal(light_rate * 0), ideal(dark_rate))
    dim = from_recordings(ideal(light_rate / 200), ideal(dark_rate))
    assert not dim.dead.any() and np.array_equal(dim.hot, report.bad.hot), "too little light to say what is dead"


def test_steady_light_leaves_two_adjacent_intervals_and_random_spikes_do_not() -> None:
    assert examine("steady", stream_of(steady())).two_intervals == 1
    noise = np.random.default_rng(1).random((400, 24, 40)) < 0.25
    assert examine("random", stream_of(noise)).two_intervals < 0.05


def test_a_raw_stream_becomes_an_upright_image(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fired = np.random.default_rng(2).random((60, 24, 40)) < np.where(np.arange(24) < 12, 0.6, 0.05)[:, None]
    pack(fired).tofile(tmp_path / "top.dat")
    assert inspect(tmp_path / "top.dat", dat_file=DatFile(40, 24, 20_000), out=tmp_path / "out") == 0
    with Image.open(tmp_path / "out" / "top" / "top.png") as png:
        image = np.asarray(png.convert("L"), np.float64)
    height, width = image.shape
    tfp = image[height // 10 : height // 2, width // 10 : width * 4 // 10]  # inside the first panel
    assert tfp[: len(tfp) // 3].mean() > tfp[-len(tfp) // 3 :].mean() + 40
    assert "top" in capsys.readouterr().out


def test_images_of_a_sensor_with_dead_ticks_are_not_clipped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    charge = np.linspace(0.05, 0.9, 24 * 40).reshape(24, 40)
    phase = np.arange(401)[:, None, None] * (charge / (1 + charge))
    stream = replace(stream_of(np.diff(np.floor(phase), axis=0) > 0), dead_ticks=1.0)
    shares = list[float]()

    def encode(image: np.ndarray) -> np.ndarray:
        shares.append(float((image >= 1).mean()))
        return encode_srgb(image)

    monkeypatch.setattr("spike4dgs.cli.inspect.encode_srgb", encode)
    write_image(tmp_path / "x.png", examine("x", stream), stream)
    assert len(shares) == 2 and max(shares) < 0.3, "more than half without it; whole intervals round"


def test_the_table_is_whole_in_a_pipe_and_in_a_file(
    small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    inspect(small_scene, out=tmp_path / "out")
    line = next(line for line in capsys.readouterr().out.splitlines() if "cam_02" in line)
    with open(tmp_path / "out" / "scene" / "statistics.csv", newline="") as file:
        rows = {row["stream"]: row for row in csv.DictReader(file)}
    images = sorted(p.name for p in (tmp_path / "out" / "scene").glob("*.png"))
    assert images == [f"cam_{i:02d}.png" for i in range(4)]
    stream = open_scene(small_scene).stream("cam_02")
    rate = stream.window(0, stream.n_ticks).mean(axis=0)
    row = rows["cam_02"]
    assert sorted(rows) == [f"cam_{i:02d}" for i in range(4)]
    assert (row["ticks"], row["missing"], row["bad from"]) == ("80", "0", "isolation")
    assert float(row["mean"]) == pytest.approx(rate.mean(), abs=1e-12)
    assert float(row["p99"]) == pytest.approx(np.percentile(rate, 99), abs=1e-12)
    shown = [cell.strip() for cell in line.strip("│").split("│")]
    share = f"{float(row['two ISIs']):.1%}"
    assert len(shown) == len(row) and shown[3] == f"{rate.mean():.4f}" and shown[-1] == share


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.dat"], "no such file"),
        (["short.dat", "--width", "40", "--height", "24", "--rate-hz", "20000"], "whole ticks of 120 bytes"),
        (["short.dat", "--width", "40"], "no --height, --rate-hz"),
        (["short.dat", "--width", "40", "--height", "24", "--rate-hz", "0"], "a positive rate"),
        (["scene", "--width", "40"], "nothing for a folder"),
        (["scene", "--rows-top-down"], "--rows-top-down: expected nothing for a folder"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], message: str, small_scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(small_scene.parent)
    Path("short.dat").write_bytes(bytes(121))
    assert main(["inspect", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_the_real_recording_is_upright_and_of_the_known_rate() -> None:
    path = shared_file("data/real_spikes/car_100kmh_250x400_200f.dat")
    stream = open_stream(path, 400, 250, 40_000.0)
    report = examine("car", stream)
    assert report.rate.mean() == pytest.approx(0.366, abs=5e-4)
    # Three pixels fire at twice or three times the rate of all around them, in front of plain walls and a tyre.
    assert list(map(tuple, np.argwhere(report.bad.hot))) == [(50, 378), (111, 340), (174, 0)]
    assert not report.bad.dead.any()
    bits = np.unpackbits(np.fromfile(path, np.uint8), bitorder="little").reshape(-1, 250, 400)[:, ::-1]
    np.testing.assert_array_equal(stream.window(0, 200), bits)
    # Bits of the wrong order break up every edge: the right order is the smoother image.
    wrong = np.unpackbits(np.fromfile(path, np.uint8)).reshape(-1, 250, 400)[:, ::-1].mean(axis=0)
    assert np.abs(np.diff(report.rate, axis=1)).mean() < 0.8 * np.abs(np.diff(wrong, axis=1)).mean()


@pytest.mark.parametrize(("width", "height"), [(16384, 8), (8, 3000), (1, 1)])
@pytest.mark.filterwarnings("error")
def test_extreme_sizes_are_shown_without_warnings(tmp_path: Path, width: int, height: int) -> None:
    fired = np.random.default_rng(0).random((60, height, width)) < 0.3
    pack(fired).tofile(tmp_path / "s.dat")
    assert inspect(tmp_path / "s.dat", dat_file=DatFile(width, height, 20_000.0), out=tmp_path / "out") == 0
    assert (tmp_path / "out/s/s.png").is_file()


def test_a_training_part_shows_the_cameras_that_it_has(small_scene: Path, tmp_path: Path) -> None:
    """It has the pose of the held-out camera and not its stream."""
    part = write_training_part(open_scene(small_scene), tmp_path / "part")
    assert inspect(part.root, out=tmp_path / "out") == 0
    assert sorted(p.stem for p in (tmp_path / "out/part").glob("*.png")) == ["cam_00", "cam_01", "cam_02"]


def test_a_camera_without_a_spike_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "dark.dat").write_bytes(bytes(60 * 120))
    assert inspect(tmp_path / "dark.dat", dat_file=DatFile(40, 24, 20_000.0), out=tmp_path / "out") == 0
    assert "dark: no spike in the whole clip" in capsys.readouterr().out
