"""`speed decode`: windows and counts of packed spikes, beside np.unpackbits, with the error."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.spikes.stream import SpikeStream, bytes_per_tick
from spike4dgs.studies.speed.timing import show_table, time_ms

COLUMNS = ("operation", "by", "min ms", "median ms", "times as fast", "largest error")


def random_stream(ticks: int, width: int, height: int, seed: int = 0) -> SpikeStream:
    """Return a stream of random bits: no layout or sparsity to profit from."""
    rng = np.random.default_rng(seed)
    packed = rng.integers(0, 256, (ticks, bytes_per_tick(width, height)), dtype=np.uint8)
    return SpikeStream(packed, width, height, 20_000.0)


def unpack_plainly(stream: SpikeStream) -> np.ndarray:
    """Return the window of all ticks, [T, H, W] uint8 upright, by np.unpackbits and a flip of the rows."""
    bits = np.unpackbits(stream.packed, axis=1, count=stream.width * stream.height, bitorder="little")
    return np.ascontiguousarray(bits.reshape(-1, stream.height, stream.width)[:, ::-1])


def decode(argv: Sequence[str] = ()) -> int:
    """Time the decoding of a whole clip and its count image, ours and plain numpy, in one run."""
    p = argparse.ArgumentParser("spike4dgs speed decode", description=decode.__doc__)
    p.add_argument("--ticks", type=int, default=1000)
    p.add_argument("--width", type=int, default=400)
    p.add_argument("--height", type=int, default=250)
    p.add_argument("--repeats", type=int, default=7)
    p.add_argument("--csv", type=Path, help="write the table here too")
    a = p.parse_args(list(argv))
    stream = random_stream(a.ticks, a.width, a.height)
    n = stream.n_ticks
    plain, ours = unpack_plainly(stream), stream.window(0, n)
    window_error = int(np.abs(plain.astype(np.int8) - ours.astype(np.int8)).max())
    exact = plain.sum(axis=0, dtype=np.int64)
    count_error = int(np.abs(exact - stream.counts(0, n)).max())
    rows = []
    for operation, plainly, fast, error in (
        ("window", lambda: unpack_plainly(stream), lambda: stream.window(0, n), window_error),
        ("count image", lambda: unpack_plainly(stream).sum(0, np.uint16), lambda: stream.counts(0, n), count_error),
    ):
        base = time_ms(plainly, a.repeats)
        mine = time_ms(fast, a.repeats)
        rows.append((operation, "numpy unpackbits", f"{base[0]:.2f}", f"{base[1]:.2f}", "1.0", "0"))
        ratio = f"{base[1] / mine[1]:.1f}"
        rows.append((operation, "spike4dgs", f"{mine[0]:.2f}", f"{mine[1]:.2f}", ratio, str(error)))
    show_table(f"{a.ticks} ticks of {a.width}x{a.height}", COLUMNS, rows, a.csv)
    return 0
