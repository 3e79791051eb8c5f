"""Display of a capture: rates while it runs, and a sheet of images after it."""

from __future__ import annotations

import io
import math

import numpy as np
from PIL import Image
from rich.console import Console

from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.generators.recorder.emulation.array import scene_profile
from spike4dgs.generators.recorder.preview import WINDOW_TICKS, Watch, middle_image, write_sheet
from spike4dgs.generators.recorder.sync import Rate


def stream(n_ticks=400, gaps=(), seed=0):
    rng = np.random.default_rng(seed)
    light = np.linspace(0.05, 0.6, 16 * 24).reshape(16, 24)
    return SpikeStream(pack(rng.random((n_ticks, 16, 24)) < light), 24, 16, 2e4, gaps=tuple(gaps))


def test_without_live_every_state_is_a_line(small_scene):
    text = io.StringIO()
    with Watch(scene_profile(open_scene(small_scene)), live=False, console=Console(file=text, width=100)) as watch:
        for state in ("OPEN", "ARMED"):
            watch.state(state)
        watch.rates({"cam_00": Rate(1e6, 10, 0.25, 0, 0)})
    assert text.getvalue() == "open\narmed\n"


def test_live_the_table_has_the_newest_rates_of_all_cameras(small_scene):
    text = io.StringIO()
    console = Console(file=text, width=100, force_terminal=True, color_system=None)
    with Watch(scene_profile(open_scene(small_scene)), live=True, console=console) as watch:
        watch.state("TRIGGERED")
        watch.rates({"cam_00": Rate(2e6, 10, 0.1, 0, 0), "cam_01": Rate(2.5e8, 1234, 0.25, 7, 0)})
        watch.rates({"cam_00": Rate(3e6, 20, 0.5, 3, 42), "cam_02": Rate(1e6, 5, math.nan, 0, 0)})
        shown = text.getvalue().split("triggered")[-1]
    lines = [line.replace("\u2502", " ").split() for line in shown.splitlines()]
    rows = {line[0]: line[1:] for line in lines if line and line[0].startswith("cam_")}
    assert rows["cam_00"] == ["3.0", "20", "0.5000", "#" * 10, "3", "42"]
    assert rows["cam_01"] == ["250.0", "1234", "0.2500", "#" * 5, "7", "0"]
    assert rows["cam_02"] == ["1.0", "5", "-", "0", "0"]
    assert rows["cam_03"] == []


def test_the_image_is_the_mean_of_the_window_nearest_the_middle_without_a_gap():
    whole = stream()
    start, image = middle_image(whole)
    assert start == (400 - WINDOW_TICKS) // 2
    np.testing.assert_allclose(image, whole.window(start, start + WINDOW_TICKS).mean(axis=0), atol=1e-6)
    gap = Gap("cam", 190, 30, "overflow")  # [190, 220): the window before it is nearer the middle than the one after
    assert middle_image(stream(gaps=[gap]))[0] == 190 - WINDOW_TICKS
    assert middle_image(stream(gaps=[Gap("cam", 100, 110, "stall")]))[0] == 210
    assert middle_image(stream(gaps=[Gap("cam", i, 1, "torn frame") for i in range(10, 400, 30)])) is None
    assert middle_image(stream(n_ticks=20))[0] == 0


def test_the_sheet_has_an_image_of_each_camera_with_data(tmp_path):
    lost = Gap("cam_02", 0, 400, "unplugged")
    streams = {"cam_02": stream(gaps=[lost]), "cam_00": stream(), "cam_01": stream(seed=1)}
    write_sheet(tmp_path / "sheet.png", streams)
    with Image.open(tmp_path / "sheet.png") as image:
        gray = np.asarray(image.convert("L"), np.float64) / 255
    height, width = gray.shape
    corners = [(height // 6, width // 12), (height // 6, 7 * width // 12), (2 * height // 3, width // 12)]
    cells = [gray[y : y + height // 6, x : x + width // 3] for y, x in corners]
    spread = [float(np.std(cell)) for cell in cells]
    assert min(spread[:2]) > 0.05 and spread[2] < 0.01
    write_sheet(tmp_path / "dark.png", {"cam_02": stream(gaps=[lost])})  # no image at all
