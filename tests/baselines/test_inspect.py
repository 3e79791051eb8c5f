"""`inspect` on streams whose bad pixels and intervals are known, and on the optional real recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_scenes import shared_file

from spike4dgs.baselines.inspect import examine, inspect
from spike4dgs.benchmark.cli import main
from spike4dgs.benchmark.spikes.stream import SpikeStream, SpikeWriter, open_stream, pack


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
    report = examine("made", stream_of(steady()))
    assert sorted(map(tuple, np.argwhere(report.bad.dead))) == [(5, 7), (20, 30)]
    assert list(map(tuple, np.argwhere(report.bad.hot))) == [(11, 13)]


def test_rates_equal_the_unpacked_mean() -> None:
    fired = steady()
    np.testing.assert_allclose(examine("made", stream_of(fired)).rate, fired.mean(axis=0), atol=1e-12)


def test_steady_light_leaves_two_adjacent_intervals_and_random_spikes_do_not() -> None:
    assert examine("steady", stream_of(steady())).two_intervals == 1
    noise = np.random.default_rng(1).random((400, 24, 40)) < 0.25
    assert examine("random", stream_of(noise)).two_intervals < 0.05


def test_a_raw_stream_becomes_an_upright_image(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fired = np.random.default_rng(2).random((60, 24, 40)) < np.where(np.arange(24) < 12, 0.6, 0.05)[:, None]
    with SpikeWriter(tmp_path / "top.dat", 40, 24) as writer:
        writer.write(pack(fired))
    assert inspect(tmp_path / "top.dat", width=40, height=24, fps=20_000, out=tmp_path / "out") == 0
    with Image.open(tmp_path / "out" / "top" / "top.png") as png:
        image = np.asarray(png.convert("L"), np.float64)
    height, width = image.shape
    tfp = image[height // 10 : height // 2, width // 10 : width * 4 // 10]  # inside the first panel
    assert tfp[: len(tfp) // 3].mean() > tfp[-len(tfp) // 3 :].mean() + 40
    assert "top" in capsys.readouterr().out


def test_a_scene_is_inspected_camera_by_camera(small_scene: Path, tmp_path: Path) -> None:
    assert inspect(small_scene, out=tmp_path / "out") == 0
    assert sorted(p.name for p in (tmp_path / "out" / "scene").iterdir()) == [
        *(f"cam_{i:02d}.png" for i in range(4)),
        "statistics.csv",
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["missing.dat"], "no such file"),
        (["short.dat", "--width", "40", "--height", "24", "--fps", "20000"], "whole ticks of 120 bytes"),
        (["short.dat", "--width", "40"], "no --height, --fps"),
        (["short.dat", "--width", "40", "--height", "24", "--fps", "0"], "a positive rate"),
        (["scene", "--width", "40"], "nothing for a folder"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str],
    message: str,
    small_scene: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(small_scene.parent)
    Path("short.dat").write_bytes(bytes(121))
    assert main(["inspect", *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_a_flipped_byte_is_refused_by_name(small_scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = small_scene / "spikes" / "cam_01.dat"
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(data)
    assert main(["inspect", str(small_scene)]) == 2
    assert "cam_01.dat" in capsys.readouterr().err


def test_the_real_recording_is_upright_and_of_the_known_rate() -> None:
    path = shared_file("data/real_spikes/car_100kmh_250x400_200f.dat")
    stream = open_stream(path, 400, 250, 40_000.0)
    report = examine("car", stream)
    assert report.rate.mean() == pytest.approx(0.366, abs=5e-4)
    bits = np.unpackbits(np.fromfile(path, np.uint8), bitorder="little").reshape(-1, 250, 400)[:, ::-1]
    np.testing.assert_array_equal(stream.window(0, 200), bits)
    # Bits of the wrong order break up every edge: the right order is the smoother image.
    wrong = np.unpackbits(np.fromfile(path, np.uint8)).reshape(-1, 250, 400)[:, ::-1].mean(axis=0)
    assert np.abs(np.diff(report.rate, axis=1)).mean() < 0.8 * np.abs(np.diff(wrong, axis=1)).mean()
