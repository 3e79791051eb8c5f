"""Counted recordings: every estimate equals that from the raw recording to the last bit."""

import io
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from memory import STATUS, resident_bytes

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics.held_out_spikes import response_of
from spike4dgs.benchmark.scene.calibration import Recordings, estimate
from spike4dgs.benchmark.spikes.bad_pixels import deviation, find_bad
from spike4dgs.benchmark.spikes.counted_recording import (
    CountedRecording,
    counted,
    encode_recording,
    first_last_total,
    open_counted,
    raw,
    total_counts,
)
from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.repair import fill_pixels
from spike4dgs.benchmark.spikes.stream import SpikeStream, open_stream, pack

WIDTH, HEIGHT = 11, 6  # 66 pixels: rows do not begin on whole bytes


def recorded(seed: int, ticks: int, rate: float, bottom_up: bool = True, gap: tuple[int, int] = (0, 0)) -> SpikeStream:
    """Random spikes with a dead, a hot and a flickering pixel; the ticks of a gap hold none."""
    rng = np.random.default_rng(seed)
    spikes = rng.random((ticks, HEIGHT, WIDTH)) < rate * rng.uniform(0.8, 1.2, (HEIGHT, WIDTH))
    spikes[:, 1, 2], spikes[:, 3, 4] = False, rng.random(ticks) < 0.9
    spikes[:, 5, 5] = rng.random(ticks) < np.where(np.arange(ticks) // 60 % 2, 0.9, 0.1)
    spikes[gap[0] : gap[1]] = False
    gaps = (Gap("cam", gap[0], gap[1] - gap[0], "lost"),) if gap[1] > gap[0] else ()
    return SpikeStream(pack(spikes, bottom_up), WIDTH, HEIGHT, 20000.0, bottom_up, "flat.dat", gaps)


def assert_equal_bits(a: Any, b: Any) -> None:
    assert a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    ticks=st.tuples(st.integers(1, 333), st.integers(1, 333)),
    rates=st.tuples(st.floats(0.3, 0.9), st.floats(0.0, 0.05)),
    bottom_up=st.booleans(),
    gap=st.tuples(st.integers(0, 300), st.integers(0, 60)),
)
@example(seed=0, ticks=(200, 250), rates=(0.4, 0.0), bottom_up=True, gap=(0, 0))
@example(seed=0, ticks=(49, 50), rates=(0.4, 0.01), bottom_up=False, gap=(10, 5))
def test_estimates_are_equal_to_the_bit(
    seed: int, ticks: tuple[int, int], rates: tuple[float, float], bottom_up: bool, gap: tuple[int, int]
) -> None:
    window = min(gap[0], ticks[0]), min(gap[0] + gap[1], ticks[0])
    flat = recorded(seed, ticks[0], rates[0], bottom_up, window)
    dark = recorded(seed + 1, ticks[1], rates[1], bottom_up)
    full, counts = Recordings(flat, dark, 0.7), Recordings(counted(flat), counted(dark), 0.7)
    outcomes = []
    for pair in (full, counts):
        try:
            maps = estimate(pair)
            bad = find_bad(flat, pair.flat, pair.dark)
            response = response_of(pair, (HEIGHT, WIDTH), 0.6)
            outcomes.append([maps.gain, maps.dark, np.float64(maps.radiance_gain), *bad.kinds.values()])
            outcomes[-1] += [deviation(pair.flat), response.white, response.dark, response.good]
        except UserError as e:  # too few spikes
            outcomes.append([np.array(str(e))])
    assert len(outcomes[0]) == len(outcomes[1])
    for a, b in zip(*outcomes, strict=True):
        assert_equal_bits(a, b)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32), ticks=st.integers(1, 333), bottom_up=st.booleans())
def test_counts_are_those_of_plain_arrays(seed: int, ticks: int, bottom_up: bool) -> None:
    stream = recorded(seed, ticks, 0.1, bottom_up)
    spikes, found = stream.window(0, ticks), counted(stream)
    for y, x in ((0, 0), (1, 2), (3, 4), (5, 10)):
        own = np.flatnonzero(spikes[:, y, x])
        expected = (own[0], own[-1], len(own)) if len(own) else (-1, -1, 0)
        assert tuple(int(image[y, x]) for image in first_last_total(found)) == expected
    assert (found.n_ticks, found.width, found.height) == (ticks, WIDTH, HEIGHT)
    for start in range(0, ticks, 50):
        for stop in {*range(start, ticks, 50), ticks}:
            np.testing.assert_array_equal(found.counts(start, stop), spikes[start:stop].sum(axis=0))
    np.testing.assert_array_equal(total_counts(found), spikes.sum(axis=0))


def test_first_and_last_spikes_of_a_long_recording_are_those_of_plain_arrays() -> None:
    """Long enough for several threads; some pixels never fire."""
    rng = np.random.default_rng(5)
    spikes = rng.random((2048, 8800), np.float32) < rng.choice([0.0, 0.0005, 0.01, 0.4], 8800)
    first, last, total = first_last_total(SpikeStream(pack(spikes.reshape(2048, 80, 110)), 110, 80, 20_000.0))
    fires = spikes.any(axis=0)
    assert 0 < fires.sum() < len(fires)
    np.testing.assert_array_equal(first.ravel(), np.where(fires, spikes.argmax(axis=0), -1))
    np.testing.assert_array_equal(last.ravel(), np.where(fires, 2047 - spikes[::-1].argmax(axis=0), -1))
    np.testing.assert_array_equal(total.ravel(), spikes.sum(axis=0))


def test_other_windows_need_the_raw_recording() -> None:
    found = counted(recorded(0, 130, 0.4))
    for start, stop in ((0, 49), (10, 50), (-50, 0), (100, 180), (50, 0)):
        with pytest.raises(UserError, match=r"whole windows of 50 ticks .* of a counted recording"):
            found.counts(start, stop)
    with pytest.raises(UserError, match=r"flat.dat: expected a raw recording \(.dat\), found a counted one"):
        raw(found)
    stream = recorded(0, 60, 0.4)
    assert raw(stream) is stream and counted(found) is found


def test_bad_pixels_are_filled_alike() -> None:
    stream, bad = replace(recorded(3, 260, 0.4), dead_ticks=0.5), np.zeros((HEIGHT, WIDTH), np.bool_)
    bad[1, 2] = bad[3, 4] = bad[5, 5] = bad[5, 6] = True
    filled, expected = fill_pixels(counted(stream), bad), counted(fill_pixels(stream, bad))
    for name, values in expected.arrays.items():
        assert_equal_bits(filled.arrays[name], values)
    assert isinstance(filled, CountedRecording) and filled.dead_ticks == expected.dead_ticks == 0.5
    none = counted(stream)
    assert fill_pixels(none, None) is none


def test_a_file_is_read_back_and_equal_counts_give_equal_bytes(tmp_path: Path) -> None:
    stream = recorded(5, 260, 0.4)
    data, path = encode_recording(stream), tmp_path / "cam_00.npz"
    assert encode_recording(counted(stream)) == data
    assert {entry.date_time for entry in zipfile.ZipFile(io.BytesIO(data)).infolist()} == {(1980, 1, 1, 0, 0, 0)}
    path.write_bytes(data)
    found = open_counted(path, WIDTH, HEIGHT, 260)
    for name, values in counted(stream).arrays.items():
        assert_equal_bits(found.arrays[name], values)


def _edited(found: CountedRecording, name: str, index: tuple[int, ...], value: int) -> CountedRecording:
    image = np.array(getattr(found, name))
    image[index] = value
    return replace(found, **{name: image})


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [
        ("last", (0, 0), 260),
        ("first", (0, 0), 255),
        ("first", (0, 0), -1),
        ("total", (0, 0), 0),
        ("total", (0, 0), 261),
        ("total", (1, 2), 1),
        ("windows", (0, 0, 0), 51),
        ("windows", (4, 1, 2), 1),
    ],
)
def test_counts_of_no_recording_are_refused(tmp_path: Path, name: str, index: tuple[int, ...], value: int) -> None:
    path = tmp_path / "cam_00.npz"
    path.write_bytes(encode_recording(_edited(counted(recorded(5, 260, 0.4)), name, index, value)))
    with pytest.raises(UserError, match="counts that contradict each other"):
        open_counted(path, WIDTH, HEIGHT, 260)


def test_a_foreign_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "cam_00.npz"
    with pytest.raises(UserError, match="the counts of 260 ticks, 11x6 pixels, found no such file"):
        open_counted(path, WIDTH, HEIGHT, 260)
    data = encode_recording(recorded(5, 260, 0.4))
    for damaged in (b"", data[:1000], b"no archive"):
        path.write_bytes(damaged)
        with pytest.raises(UserError, match="cam_00.npz: expected the counts .*damaged data"):
            open_counted(path, WIDTH, HEIGHT, 260)
    path.write_bytes(data)
    for size in ((HEIGHT, WIDTH, 260), (WIDTH, HEIGHT, 300), (WIDTH, HEIGHT, 259)):
        with pytest.raises(UserError, match="cam_00.npz"):
            open_counted(path, *size)
    np.savez(path, first=np.zeros(3))
    with pytest.raises(UserError, match="found the arrays first"):
        open_counted(path, WIDTH, HEIGHT, 260)


@pytest.mark.skipif(not STATUS.is_file(), reason="Linux says how much of a file is in memory")
def test_a_calibration_leaves_no_pages_of_its_recordings_in_memory(tmp_path: Path) -> None:
    width, height, ticks = 256, 128, 4000  # 16 MB each
    paths = tmp_path / "flat.dat", tmp_path / "dark.dat"
    size = ticks * width * height // 8
    paths[0].write_bytes(np.random.default_rng(0).bytes(size))
    paths[1].write_bytes(bytes(size))
    flat, dark = (open_stream(path, width, height, 20000.0) for path in paths)
    first = estimate(Recordings(flat, dark, 0.5))  # compiles, too
    before = resident_bytes("RssFile")
    again = estimate(Recordings(flat, dark, 0.5))
    assert resident_bytes("RssFile") - before < 4_000_000
    assert np.array_equal(first.gain, again.gain) and np.array_equal(first.dark, again.dark)
    assert int(flat.packed.sum(dtype=np.int64)), "what is read counts"
    assert resident_bytes("RssFile") - before > 12_000_000
