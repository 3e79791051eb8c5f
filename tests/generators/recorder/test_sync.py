"""Rates and the synchrony of a capture's cameras."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from fake_camera import HEIGHT, WIDTH, layout_of, rig
from numpy.typing import NDArray

from spike4dgs.generators.recorder.frames.clip import ARRIVAL_TIMES, CameraClip, CameraStats, Clip
from spike4dgs.generators.recorder.frames.ring import Block
from spike4dgs.generators.recorder.sync import fit_arrival, spikes_per_tick


@pytest.mark.parametrize("layout", ["plain", "tagged-rows"])
def test_spike_rates_are_counted_in_whole_frames(layout: str) -> None:
    shape = layout_of(rig(1, layout))
    pixels = np.zeros((8, shape.payload_bytes), np.uint8)
    pixels[:, 0] = 0b1011
    stream = shape.pack(pixels).reshape(-1)
    block = Block(stream[11:], 11, len(stream) - 11, 0)
    assert spikes_per_tick(shape, block) == 3 / (WIDTH * HEIGHT)
    assert math.isnan(spikes_per_tick(shape, Block(stream[11:30], 11, 19, 0)))
    assert math.isnan(spikes_per_tick(shape, None))


FPS = 20000
STATS = CameraStats(0, 0, 0, 0, 0, 0, 0.0, 0.0, 0, "ok")


def arrivals(ppm: float, offset_us: float, late_us: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return a read for every 20 ticks, each late by `late_us` [m]."""
    ticks = 20 * (1 + np.arange(len(late_us)))
    ns = 7e15 + ticks * 50e3 * (1 + ppm * 1e-6) + (offset_us + late_us) * 1e3
    return np.stack([ticks, np.round(ns).astype(np.int64)], axis=1)


def clip_of(arrival: dict[str, NDArray[np.int64]], n_ticks: int) -> Clip:
    nothing = np.empty((0, 30), np.uint8), np.empty(0, np.int64)
    cameras = tuple(CameraClip(name, *nothing, (), pairs, STATS) for name, pairs in arrival.items())
    return Clip(n_ticks, cameras, ARRIVAL_TIMES, False)


def test_clocks_are_found_exactly_where_nothing_is_late() -> None:
    on_time = np.zeros(500)
    found = fit_arrival(clip_of({"a": arrivals(0, 0, on_time), "b": arrivals(37, 120, on_time)}, 10_000), FPS)
    a, b = found.cameras
    assert a.drift_ppm == pytest.approx(0, abs=1e-3) and b.drift_ppm == pytest.approx(37, abs=1e-3)
    assert b.offset_us - a.offset_us == pytest.approx(120, abs=0.01)
    assert found.worst_pair == ("a", "b")
    assert found.worst_pair_us == pytest.approx(120 + 37e-6 * 500_000, abs=0.01), "apart the most at the end"
    assert found.t0_ns == pytest.approx(7e15 + 60e3, abs=100)
    assert a.residual_us < 0.01 and a.reads == 500 and not b.suspect


def test_a_camera_that_failed_early_is_compared_while_it_sent() -> None:
    """Its slope is that of a few reads: over the whole clip it would be half a second off."""
    delays = np.random.default_rng(0).exponential(100, (3, 500))
    whole = {name: arrivals(0, 0, delays[k]) for k, name in enumerate("ab")}
    found = fit_arrival(clip_of({**whole, "c": arrivals(0, 0, delays[2])[:5]}, 10_000), FPS)
    alone = fit_arrival(clip_of({**whole, "c": np.empty((0, 2), np.int64)}, 10_000), FPS)
    assert found.cameras[2].reads == 5 and found.worst_pair_us < 500
    assert alone.worst_pair == ("a", "b")


def test_late_reads_hardly_move_the_fit_and_are_reported() -> None:
    rng = np.random.default_rng(0)
    late = rng.exponential(40.0, 500)
    late[rng.choice(500, 100, replace=False)] += rng.exponential(20_000.0, 100)  # a fifth of them very late
    pairs = arrivals(-60, 0, late)
    camera = fit_arrival(clip_of({"a": pairs}, 10_000), FPS).cameras[0]
    assert camera.drift_ppm == pytest.approx(-60, abs=15)
    assert abs(camera.drift_ppm + 60) < 4 * camera.drift_error_ppm < 100
    assert camera.worst_us == pytest.approx(late.max(), rel=0.01)
    line = np.polyfit(pairs[:, 0], pairs[:, 1] - pairs[0, 1], 1)[0] / 50e3 - 1
    assert abs(line * 1e6 + 60) > 10 * abs(camera.drift_ppm + 60), "least squares would be far off"


def test_the_stated_error_is_that_of_repeated_fits() -> None:
    rng = np.random.default_rng(1)
    fits = [
        fit_arrival(clip_of({"a": arrivals(5, 0, rng.normal(0, 50, 200))}, 4000), FPS).cameras[0] for _ in range(60)
    ]
    scatter = np.std([f.drift_ppm for f in fits])
    assert scatter == pytest.approx(np.mean([f.drift_error_ppm for f in fits]), rel=0.5)
    assert not any(f.suspect for f in fits)


def test_a_rate_that_no_crystal_has_is_suspect() -> None:
    late = np.random.default_rng(2).exponential(30.0, 500)
    found = fit_arrival(clip_of({"a": arrivals(50, 0, late), "b": arrivals(250, 0, late)}, 10_000), FPS)
    assert [c.suspect for c in found.cameras] == [False, True]
    assert found.as_dict()["suspect"] == ["b"]


def test_a_camera_that_began_at_another_time_is_suspect() -> None:
    late = np.random.default_rng(5).exponential(30.0, 500)
    found = fit_arrival(clip_of({name: arrivals(0, 120_000 * (name == "c"), late) for name in "abc"}, 10_000), FPS)
    assert found.as_dict()["suspect"] == ["c"]
    assert found.cameras[2].offset_text == "+120000 (+2400) suspect" and found.cameras[2].read_us == 1000
    assert found.cameras[2].drift_text.endswith(str(round(found.cameras[2].drift_error_ppm))), "its rate is not"
    near = fit_arrival(clip_of({name: arrivals(0, 15_000 * (name == "c"), late) for name in "abc"}, 10_000), FPS)
    assert not near.as_dict()["suspect"], "as where cameras go on from the rehearsal"


def test_a_clip_too_short_to_tell_says_so_instead_of_a_number() -> None:
    rng = np.random.default_rng(3)
    for n in (20, 100):  # 20 and 100 ms at 20 kHz, read in bursts; delays grow by a millisecond on the way
        late = np.linspace(0, 1000, n) + rng.normal(0, 400, n)
        camera = fit_arrival(clip_of({"a": arrivals(0, 0, late)}, 20 * n), FPS).cameras[0]
        assert camera.drift_ppm > 3 * camera.drift_error_ppm > 300, "what standard errors alone would believe"
        assert camera.too_short and not camera.suspect and camera.drift_text == "too short to tell"
    long = fit_arrival(clip_of({"a": arrivals(30, 0, rng.normal(0, 400, 2000))}, 40_000), FPS).cameras[0]
    assert not long.too_short and long.drift_text == f"{long.drift_ppm:+.0f} +- {long.drift_error_ppm:.0f}"


def test_three_reads_have_no_scatter_that_tells() -> None:
    """The median slope of three points is that of the outer two, through which a line passes without an error."""
    rng = np.random.default_rng(5)
    for _ in range(20):
        camera = fit_arrival(clip_of({"a": arrivals(0, 0, rng.exponential(200.0, 3))}, 60), FPS).cameras[0]
        assert camera.too_short and not camera.suspect and math.isnan(camera.drift_error_ppm)


def test_a_rate_twice_the_stated_one_is_suspect_in_a_short_clip_too() -> None:
    late = np.random.default_rng(4).normal(0, 400, 100)
    camera = fit_arrival(clip_of({"a": arrivals(-5e5, 0, late)}, 2000), FPS).cameras[0]
    assert camera.too_short and camera.suspect and camera.drift_text.endswith(" suspect")


def test_a_camera_with_too_few_reads_is_not_known_and_json_says_null() -> None:
    good, few = arrivals(0, 0, np.zeros(50)), arrivals(0, 0, np.zeros(2))
    found = fit_arrival(clip_of({"a": good, "b": few}, 1000), FPS)
    assert math.isnan(found.cameras[1].drift_ppm) and found.cameras[1].reads == 2
    assert found.worst_pair is None and not found.cameras[1].suspect
    assert found.cameras[1].drift_text == "too short to tell"
    record = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert record["method"] == ARRIVAL_TIMES
    assert record["cameras"][1]["drift_ppm"] is None and record["worst_pair_us"] is None
