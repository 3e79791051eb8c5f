"""Hard cases of packed spike streams: odd sizes, extreme contents, long clips, gaps, damaged files."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.hard_cases.case import Case, Outcome, Setting, described, refused
from spike4dgs.benchmark.hard_cases.cores import bytes_by_cores
from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.benchmark.spikes.repair import fill_gaps
from spike4dgs.benchmark.spikes.stream import SpikeStream, SpikeWriter, bytes_per_tick, open_stream, pack

_RATE_HZ = 20_000.0
_NUMPY = "numpy.unpackbits"
_SIZES = ((1, 1), (3, 5), (8, 1), (7, 9), (13, 7), (17, 23), (400, 250))  # width, height


def cases() -> list[Case]:
    """Return the cases of packed spikes."""
    return [
        _bits(
            "odd-sizes", f"random bytes, padding bits too, as {_list_of_sizes()} pixels, both row orders", _odd_sizes
        ),
        _bits("all-zeros", "65,535 ticks of 13x7 pixels without a spike: windows and counts", lambda s: _even(0)),
        _bits(
            "all-ones",
            "65,535 ticks of 13x7 pixels that all fire: windows, counts at the 16-bit limit",
            lambda s: _even(255),
        ),
        _bits("no-ticks", "a window of no ticks", lambda s: _decoded(np.zeros((0, 12), np.uint8), 13, 7)),
        _bits("count-blocks", "counts of 1, 254 ... 257, 510, 511 and 4,000 ticks", _count_blocks),
        _bits(
            "long-clip",
            "a memory map of 1,000,000 ticks of 9x7 pixels: first and last windows, all counts",
            _long_clip,
            1.0,
        ),
        Case(
            id="benchmark/spikes/write",
            asked="write odd sizes in pieces of 0, 1, 2 and 97 ticks and open the file again",
            twin="numpy.packbits",
            unit="bytes that differ",
            tolerance=0,
            run=_written,
        ),
        Case(
            id="benchmark/spikes/refuse",
            asked="files that are empty, missing, cut, of size 0; windows beyond the clip or of 65,536 ticks",
            twin="the contract: one clear error each",
            unit="inputs taken",
            tolerance=0,
            run=_refused,
        ),
        Case(
            id="benchmark/spikes/gaps",
            asked="constant light of 0.02 to 0.95 spikes per tick; one lost tick in 23, and gaps at both ends",
            twin="the stream without gaps",
            unit="spikes per gap and pixel",
            tolerance=1,
            run=_gaps,
        ),
        Case(
            id="benchmark/spikes/nothing-left",
            asked="fill the gaps of a clip that was lost as a whole, and of one without a spike",
            twin="no spike at all",
            unit="spikes",
            tolerance=0,
            run=_nothing_left,
        ),
        Case(
            id="benchmark/spikes/threads",
            asked="unpack and count 16,384 ticks of 200x125 pixels on 1, 2 ... all cores",
            twin="one core",
            unit="bytes that differ",
            tolerance=0,
            run=_threads,
            kind="threads",
            seconds=1,
        ),
    ]


def _bits(name: str, asked: str, run: Callable[[Setting], Outcome], seconds: float = 0.1) -> Case:
    return Case(
        id=f"benchmark/spikes/{name}",
        asked=asked,
        twin=_NUMPY,
        unit="pixels that differ",
        tolerance=0,
        run=run,
        seconds=seconds,
    )


def _list_of_sizes() -> str:
    return ", ".join(f"{w}x{h}" for w, h in _SIZES)


def _plain(packed: UInt8, width: int, height: int, flip: bool) -> UInt8:
    """Return the spikes [n, H, W] of packed rows by numpy alone."""
    flat = np.unpackbits(packed, axis=1, count=width * height, bitorder="little")
    return np.asarray(flat.reshape(-1, height, width)[:, :: -1 if flip else 1])


def _decoded(packed: UInt8, width: int, height: int, flip: bool = True) -> Outcome:
    """Compare a stream's windows and counts with numpy's."""
    stream = SpikeStream(packed, width, height, _RATE_HZ, flip)
    plain = _plain(packed, width, height, flip)
    wrong = int(np.count_nonzero(stream.window(0, len(packed)) != plain))
    counts = stream.counts(0, len(packed))
    wrong += int(np.count_nonzero(counts != plain.sum(axis=0, dtype=np.int64)))
    return Outcome(f"{len(packed):,} ticks of {width}x{height}; counts: {described(counts)}", float(wrong))


def _odd_sizes(setting: Setting) -> Outcome:
    rng, wrong = setting.rng(), 0.0
    for width, height in _SIZES:
        packed = rng.integers(0, 256, (40, bytes_per_tick(width, height)), dtype=np.uint8)
        wrong += sum(_decoded(packed, width, height, flip).error for flip in (False, True))
    return Outcome(f"{2 * len(_SIZES)} streams of 40 ticks", wrong)


def _even(byte: int) -> Outcome:
    return _decoded(np.full((65_535, bytes_per_tick(13, 7)), byte, np.uint8), 13, 7)


def _count_blocks(setting: Setting) -> Outcome:
    rng = setting.rng()
    lengths = (1, 254, 255, 256, 257, 510, 511, 4000)  # counters carry over after 255 ticks
    streams = (rng.integers(0, 256, (n, bytes_per_tick(17, 5)), dtype=np.uint8) for n in lengths)
    return Outcome(f"{len(lengths)} streams of 17x5", sum(_decoded(s, 17, 5).error for s in streams))


def _long_clip(setting: Setting) -> Outcome:
    n, width, height, step = 1_000_000, 9, 7, 65_535
    packed = setting.rng().integers(0, 256, (n, bytes_per_tick(width, height)), dtype=np.uint8)
    path = setting.folder / "long.dat"
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
    return Outcome(f"counts: {described(total)}", float(wrong))


def _written(setting: Setting) -> Outcome:
    rng, wrong = setting.rng(), 0
    for width, height in _SIZES[:-1]:
        spikes = rng.random((100, height, width)) < 0.3
        flat = spikes[:, ::-1].reshape(100, -1)
        expected = np.packbits(flat, axis=1, bitorder="little")  # the last byte is padded with zeros
        path, packed = setting.folder / f"{width}x{height}.dat", pack(spikes)
        with SpikeWriter(path, width, height) as writer:
            for a, b in ((0, 0), (0, 1), (1, 3), (3, 100)):
                writer.write(packed[a:b])
        wrong += int(np.count_nonzero(np.fromfile(path, np.uint8) != expected.ravel()))
        wrong += int(np.count_nonzero(open_stream(path, width, height, _RATE_HZ).packed != expected))
    return Outcome(f"{len(_SIZES) - 1} files of 100 ticks", float(wrong))


def _refused(setting: Setting) -> Outcome:
    empty, cut = setting.folder / "empty.dat", setting.folder / "cut.dat"
    empty.write_bytes(b"")
    cut.write_bytes(bytes(29))
    stream = SpikeStream(np.zeros((70_000, 2), np.uint8), 4, 4, _RATE_HZ)
    return refused(
        {
            "an empty file": lambda: open_stream(empty, 4, 4, _RATE_HZ),
            "a file that is not there": lambda: open_stream(setting.folder / "none.dat", 4, 4, _RATE_HZ),
            "29 bytes of 2-byte ticks": lambda: open_stream(cut, 4, 4, _RATE_HZ),
            "width 0": lambda: open_stream(cut, 0, 4, _RATE_HZ),
            "height -1": lambda: open_stream(cut, 4, -1, _RATE_HZ),
            "a window from tick -1": lambda: stream.window(-1, 4),
            "a window beyond the end": lambda: stream.window(69_999, 70_001),
            "a window that ends before it starts": lambda: stream.counts(5, 4),
            "counts of 65,536 ticks": lambda: stream.counts(0, 65_536),
        }
    )


def _gaps(setting: Setting) -> Outcome:
    rates = np.linspace(0.02, 0.95, 126).reshape(6, 21)
    charge = setting.rng().random(rates.shape) + np.arange(401)[:, None, None] * rates
    spikes = np.diff(np.floor(charge), axis=0).astype(np.uint8)
    gaps = [(0, 3), *((t, 1) for t in range(7, 390, 23)), (396, 4)]
    filled = fill_gaps(_with_gaps(spikes, gaps))
    missing = filled.counts(0, 400).astype(int) - spikes.sum(axis=0)
    text = f"{len(gaps)} gaps filled, {len(filled.gaps)} left; the sum of counts is off by {abs(missing.sum())}"
    return Outcome(text, float(np.abs(missing).max()) / len(gaps))


def _with_gaps(spikes: UInt8, gaps: list[tuple[int, int]]) -> SpikeStream:
    lost = spikes.copy()
    for first, ticks in gaps:
        lost[first : first + ticks] = 0
    found = tuple(Gap("cam_00", first, ticks, "overflow") for first, ticks in gaps)
    return SpikeStream(pack(lost), spikes.shape[2], spikes.shape[1], _RATE_HZ, gaps=found)


def _nothing_left(setting: Setting) -> Outcome:
    everything = _with_gaps(np.ones((50, 3, 5), np.uint8), [(0, 50)])
    silent = _with_gaps(np.zeros((50, 3, 5), np.uint8), [(10, 2), (48, 2)])
    found = [int(fill_gaps(s).counts(0, 50).sum()) for s in (everything, silent)]
    return Outcome(f"{found[0]} and {found[1]} spikes", float(sum(found)))


def _threads(setting: Setting) -> Outcome:
    packed = setting.rng().integers(0, 256, (16_384, bytes_per_tick(200, 125)), dtype=np.uint8)
    stream = SpikeStream(packed, 200, 125, _RATE_HZ)
    return bytes_by_cores(lambda: stream.counts(0, len(packed)).tobytes() + stream.window(100, 500).tobytes())
