"""Packed streams: layout, windows, counts, the writer's atomicity, and what damaged files say."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.spikes.stream import SpikeStream, SpikeWriter, bytes_per_tick, open_stream, pack


def random_spikes(n: int, height: int, width: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2, (n, height, width), dtype=np.uint8)


def test_layout_of_one_tick() -> None:
    """The pixel in the left of the bottom row is the lowest bit of the first byte."""
    image = np.zeros((1, 2, 6), np.uint8)
    image[0, 1, 0] = 1  # bottom left: bit 0
    image[0, 1, 2] = 1  # bit 2
    image[0, 0, 1] = 1  # top row: bit 6 + 1
    image[0, 0, 5] = 1  # bit 11
    assert pack(image).tolist() == [[0b10000101, 0b00001000]]
    assert pack(image, rows_bottom_up=False).tolist() == [[0b01100010, 0b00000001]]
    assert bytes_per_tick(6, 2) == 2 and bytes_per_tick(400, 250) == 12500


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 6), st.integers(1, 20), st.integers(1, 20), st.booleans(), st.integers(0, 99))
def test_each_pixel_is_the_bit_of_the_layout(n: int, height: int, width: int, bottom_up: bool, seed: int) -> None:
    spikes = random_spikes(n, height, width, seed)
    packed = pack(spikes, bottom_up)
    assert packed.shape == (n, bytes_per_tick(width, height)) and 8 * packed.shape[1] - height * width in range(8)
    for t in range(n):
        bits = [packed[t, p >> 3] >> (p & 7) & 1 for p in range(8 * packed.shape[1])]
        rows = [bits[r * width : (r + 1) * width] for r in range(height)]
        assert (rows[::-1] if bottom_up else rows) == spikes[t].tolist()
        assert not any(bits[height * width :]), "padding is zero"


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 40), st.integers(1, 19), st.integers(1, 19), st.booleans(), st.integers(0, 99), st.data())
def test_files_of_any_size_in_any_parts(
    tmp_path_factory: pytest.TempPathFactory, n: int, height: int, width: int, bottom_up: bool, seed: int, data: Any
) -> None:
    spikes = random_spikes(n, height, width, seed)
    path = tmp_path_factory.mktemp("streams") / "a.dat"
    cuts = sorted(data.draw(st.lists(st.integers(0, n), max_size=4)))
    with SpikeWriter(path, width, height) as writer:
        for part in np.array_split(pack(spikes, bottom_up), cuts):
            writer.write(part)
        assert not path.exists(), "not before it is whole"
    assert path.stat().st_size == n * -(-width * height // 8) and writer.n_ticks == n
    stream = open_stream(path, width, height, 20000.0, rows_bottom_up=bottom_up, n_ticks=n)
    start = data.draw(st.integers(0, n))
    stop = data.draw(st.integers(start, n))
    window, counts = stream.window(start, stop), stream.counts(start, stop)
    assert (stream.n_ticks, window.dtype, counts.dtype) == (n, np.uint8, np.uint16)
    np.testing.assert_array_equal(window, spikes[start:stop])
    np.testing.assert_array_equal(counts, spikes[start:stop].sum(0))


def test_an_error_while_writing_leaves_the_old_file_and_no_part(tmp_path: Path) -> None:
    path = tmp_path / "a.dat"
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError), SpikeWriter(path, 8, 2) as writer:
        writer.write(np.zeros((5, 2), np.uint8))
        raise RuntimeError
    assert path.read_bytes() == b"old" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("shape", [(5, 3), (5,), (5, 1)])
def test_rows_of_another_size_are_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    with pytest.raises(UserError, match="expected uint8 rows of 2 bytes"), SpikeWriter(tmp_path / "a", 8, 2) as writer:
        writer.write(np.zeros(shape, np.uint8))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("window", [(-1, 3), (3, 2), (0, 11), (11, 11)])
def test_a_window_outside_the_clip_is_refused(window: tuple[int, int]) -> None:
    stream = SpikeStream(np.zeros((10, 2), np.uint8), 8, 2, 20000.0, source="a.dat")
    for method in (stream.window, stream.counts):
        with pytest.raises(UserError, match=r"a.dat: expected a window within ticks \[0, 10\), found \[.*\); "):
            method(*window)


@pytest.mark.parametrize(
    ("content", "size", "n_ticks", "message"),
    [
        (None, (8, 2), None, "a.dat: expected a spike stream, found no such file; "),
        (b"", (8, 2), None, r"a.dat: expected whole ticks of 2 bytes \(8x2\), found 0 bytes; .*truncated"),
        (b"12345", (8, 2), None, r"a.dat: expected whole ticks of 2 bytes \(8x2\), found 5 bytes; .*truncated"),
        (b"1234", (8, 2), 3, "a.dat: expected 3 ticks, found 2; .*truncated"),
        (b"1234", (0, 2), None, "a.dat: expected a positive width and height, found 0x2; "),
        (b"1234", (8, -2), None, "a.dat: expected a positive width and height, found 8x-2; "),
    ],
)
def test_bad_files_are_refused_in_one_line(
    tmp_path: Path, content: bytes | None, size: tuple[int, int], n_ticks: int | None, message: str
) -> None:
    path = tmp_path / "a.dat"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match=message) as error:
        open_stream(path, *size, 20000.0, n_ticks=n_ticks)
    assert "\n" not in str(error.value)


def test_a_stream_that_is_cut_while_it_is_mapped_is_an_error(tmp_path: Path) -> None:
    """Where pages of the map lie behind the end of the file, the system ends the process."""
    path = tmp_path / "s.dat"
    with SpikeWriter(path, 8, 8) as writer:
        writer.write(np.ones((20_000, 8), np.uint8))
    stream = open_stream(path, 8, 8, 20_000.0)
    assert stream.counts(0, 20_000).sum() == 160_000
    os.truncate(path, 100)
    for read in (lambda: stream.counts(0, 20_000), lambda: stream.window(19_000, 19_010), lambda: stream.packed):
        with pytest.raises(UserError, match="s.dat: expected 160000 bytes, as when it was opened, found 100; another"):
            read()
