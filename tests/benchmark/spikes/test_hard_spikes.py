"""Hard inputs of packed spike streams: odd sizes, extreme contents, long clips, gaps, damaged files."""

import numpy as np
import pytest
from hard_case import BYTES, REFUSAL, HardCase, described
from numpy.typing import NDArray

from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.repair import fill_gaps
from spike4dgs.benchmark.spikes.stream import SpikeStream, SpikeWriter, bytes_per_tick, open_stream, pack

_RATE_HZ = 20_000.0
_SIZES = ((1, 1), (3, 5), (8, 1), (7, 9), (13, 7), (17, 23), (400, 250))  # width, height
UInt8 = NDArray[np.uint8]
PIXELS = {"twin": "numpy.unpackbits", "unit": "pixels that differ"}


def _plain(packed: UInt8, width: int, height: int, flip: bool) -> UInt8:
    """Return the spikes [n, H, W] of packed rows by numpy alone."""
    flat = np.unpackbits(packed, axis=1, count=width * height, bitorder="little")
    return np.asarray(flat.reshape(-1, height, width)[:, :: -1 if flip else 1])


def _decoded(hard_case: HardCase, packed: UInt8, width: int, height: int, flip: bool = True) -> None:
    """Check a stream's windows and counts."""
    stream = SpikeStream(packed, width, height, _RATE_HZ, flip)
    plain = _plain(packed, width, height, flip)
    wrong = int(np.count_nonzero(stream.window(0, len(packed)) != plain))
    counts = stream.counts(0, len(packed))
    wrong += int(np.count_nonzero(counts != plain.sum(axis=0, dtype=np.int64)))
    hard_case.check(wrong, f"{len(packed):,} ticks of {width}x{height}; counts: {described(counts)}")


@pytest.mark.hard_case(asked="random bytes, padding bits too, as {width}x{height} pixels, both row orders", **PIXELS)
@pytest.mark.parametrize(("width", "height"), _SIZES)
def test_odd_sizes(hard_case: HardCase, width: int, height: int) -> None:
    packed = hard_case.rng().integers(0, 256, (40, bytes_per_tick(width, height)), dtype=np.uint8)
    for flip in (False, True):
        _decoded(hard_case, packed, width, height, flip)


@pytest.mark.hard_case(asked="65,535 ticks, the most of a count, of 13x7 pixels, all bytes {byte}", **PIXELS)
@pytest.mark.parametrize("byte", [0, 255])
def test_even(hard_case: HardCase, byte: int) -> None:
    _decoded(hard_case, np.full((65_535, bytes_per_tick(13, 7)), byte, np.uint8), 13, 7)


@pytest.mark.hard_case(asked="windows and counts of {ticks} ticks", **PIXELS)
@pytest.mark.parametrize("ticks", [0, 1, 254, 255, 256, 257, 510, 511, 4000])  # counters carry over after 255 ticks
def test_count_blocks(hard_case: HardCase, ticks: int) -> None:
    packed = hard_case.rng().integers(0, 256, (ticks, bytes_per_tick(17, 5)), dtype=np.uint8)
    _decoded(hard_case, packed, 17, 5)


@pytest.mark.hard_case(
    asked="a memory map of 1,000,000 ticks of 9x7 pixels: first and last windows, all counts", **PIXELS
)
def test_long_clip(hard_case: HardCase) -> None:
    n, width, height, step = 1_000_000, 9, 7, 65_535
    packed = hard_case.rng().integers(0, 256, (n, bytes_per_tick(width, height)), dtype=np.uint8)
    path = hard_case.folder / "long.dat"
    with SpikeWriter(path, width, height) as writer:
        writer.write(packed)
    stream = open_stream(path, width, height, _RATE_HZ)
    wrong, total, expected = 0, np.zeros((height, width), np.int64), np.zeros((height, width), np.int64)
    for start in range(0, n, step):
        total += stream.counts(start, min(start + step, n))
        expected += _plain(packed[start : start + step], width, height, True).sum(axis=0, dtype=np.int64)
    wrong += int(np.count_nonzero(total != expected))
    for a, b in ((0, 9), (n - 9, n)):
        wrong += int(np.count_nonzero(stream.window(a, b) != _plain(packed[a:b], width, height, True)))
    hard_case.check(wrong, f"counts: {described(total)}")


@pytest.mark.hard_case(
    asked="write odd sizes in pieces of 0, 1, 2 and 97 ticks and open the file again", twin="numpy.packbits", **BYTES
)
def test_write(hard_case: HardCase) -> None:
    rng, wrong = hard_case.rng(), 0
    for width, height in _SIZES[:-1]:
        spikes = rng.random((100, height, width)) < 0.3
        flat = spikes[:, ::-1].reshape(100, -1)
        expected = np.packbits(flat, axis=1, bitorder="little")  # the last byte is padded with zeros
        path, packed = hard_case.folder / f"{width}x{height}.dat", pack(spikes)
        with SpikeWriter(path, width, height) as writer:
            for a, b in ((0, 0), (0, 1), (1, 3), (3, 100)):
                writer.write(packed[a:b])
        wrong += int(np.count_nonzero(np.fromfile(path, np.uint8) != expected.ravel()))
        wrong += int(np.count_nonzero(open_stream(path, width, height, _RATE_HZ).packed != expected))
    hard_case.check(wrong, f"{len(_SIZES) - 1} files of 100 ticks")


@pytest.mark.hard_case(
    asked="files that are empty, missing, cut, of size 0; windows beyond the clip or of 65,536 ticks", **REFUSAL
)
def test_refuse(hard_case: HardCase) -> None:
    empty, cut = hard_case.folder / "empty.dat", hard_case.folder / "cut.dat"
    empty.write_bytes(b"")
    cut.write_bytes(bytes(29))
    stream = SpikeStream(np.zeros((70_000, 2), np.uint8), 4, 4, _RATE_HZ)
    hard_case.refused(
        {
            "an empty file": lambda: open_stream(empty, 4, 4, _RATE_HZ),
            "a file that is not there": lambda: open_stream(hard_case.folder / "none.dat", 4, 4, _RATE_HZ),
            "29 bytes of 2-byte ticks": lambda: open_stream(cut, 4, 4, _RATE_HZ),
            "width 0": lambda: open_stream(cut, 0, 4, _RATE_HZ),
            "height -1": lambda: open_stream(cut, 4, -1, _RATE_HZ),
            "a window from tick -1": lambda: stream.window(-1, 4),
            "a window beyond the end": lambda: stream.window(69_999, 70_001),
            "a window that ends before it starts": lambda: stream.counts(5, 4),
            "counts of 65,536 ticks": lambda: stream.counts(0, 65_536),
        }
    )


@pytest.mark.hard_case(
    asked="constant light of 0.02 to 0.95 spikes per tick; one lost tick in 23, and gaps at both ends",
    twin="the stream without gaps",
    unit="spikes per gap and pixel",
    tolerance=1,
)
def test_gaps(hard_case: HardCase) -> None:
    rates = np.linspace(0.02, 0.95, 126).reshape(6, 21)
    charge = hard_case.rng().random(rates.shape) + np.arange(401)[:, None, None] * rates
    spikes = np.diff(np.floor(charge), axis=0).astype(np.uint8)
    gaps = [(0, 3), *((t, 1) for t in range(7, 390, 23)), (396, 4)]
    filled = fill_gaps(_with_gaps(spikes, gaps))
    missing = filled.counts(0, 400).astype(int) - spikes.sum(axis=0)
    text = f"{len(gaps)} gaps filled, {len(filled.gaps)} left; the sum of counts is off by {abs(missing.sum())}"
    hard_case.check(np.abs(missing).max() / len(gaps), text)


def _with_gaps(spikes: UInt8, gaps: list[tuple[int, int]]) -> SpikeStream:
    lost = spikes.copy()
    for first, ticks in gaps:
        lost[first : first + ticks] = 0
    found = tuple(Gap("cam_00", first, ticks, "overflow") for first, ticks in gaps)
    return SpikeStream(pack(lost), spikes.shape[2], spikes.shape[1], _RATE_HZ, gaps=found)


@pytest.mark.hard_case(
    asked="fill the gaps of a clip that was lost as a whole, and of one without a spike",
    twin="no spike at all",
    unit="spikes",
)
def test_nothing_left(hard_case: HardCase) -> None:
    everything = _with_gaps(np.ones((50, 3, 5), np.uint8), [(0, 50)])
    silent = _with_gaps(np.zeros((50, 3, 5), np.uint8), [(10, 2), (48, 2)])
    found = [int(fill_gaps(s).counts(0, 50).sum()) for s in (everything, silent)]
    hard_case.check(sum(found), f"{found[0]} and {found[1]} spikes")


@pytest.mark.hard_case(
    asked="unpack and count 16,384 ticks of 200x125 pixels on 1, 2 ... all cores",
    twin="one core",
    **BYTES,
    kind="threads",
)
def test_threads(hard_case: HardCase) -> None:
    packed = hard_case.rng().integers(0, 256, (16_384, bytes_per_tick(200, 125)), dtype=np.uint8)
    stream = SpikeStream(packed, 200, 125, _RATE_HZ)
    hard_case.same_on_all_cores(lambda: stream.counts(0, len(packed)).tobytes() + stream.window(100, 500).tobytes())
