"""`speed tfp` and `speed tfi`: images at every tick of a clip, beside plain numpy, with the error."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from spike4dgs.baselines.images.tfi import tfi_stack
from spike4dgs.baselines.images.tfp import TfpSettings, count_stack, tfp_stack
from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.studies.speed.decode import unpack_plainly
from spike4dgs.studies.speed.streams import fired_stream
from spike4dgs.studies.speed.timing import show_table, time_ms

COLUMNS = ("images", "by", "min ms", "median ms", "times as fast", "largest error")


def tfp_plainly(stream: SpikeStream, half_window: int = TfpSettings.half_window) -> Float32:
    """Return TFP at every tick from numpy's cumulative sum of the unpacked clip."""
    sums = np.zeros((stream.n_ticks + 1, stream.height, stream.width), np.int32)
    np.cumsum(unpack_plainly(stream), axis=0, dtype=np.int32, out=sums[1:])
    t = np.arange(stream.n_ticks)
    first, last = np.maximum(t - half_window, 0), np.minimum(t + half_window, stream.n_ticks)
    return ((sums[last] - sums[first]) / (last - first)[:, None, None].astype(np.float32)).astype(np.float32)


def tfi_plainly(stream: SpikeStream) -> Float32:
    """Return TFI at every tick inside complete intervals, NaN elsewhere, by running maxima over the unpacked clip."""
    fired = unpack_plainly(stream)
    n = len(fired)
    t = np.arange(n, dtype=np.float32)[:, None, None]
    last = np.maximum.accumulate(np.where(fired, t, -np.inf), axis=0)
    before = np.concatenate([np.full_like(last[:1], -np.inf), last[:-1]])
    after = np.minimum.accumulate(np.where(fired, t, np.inf)[::-1], axis=0)[::-1]
    with np.errstate(invalid="ignore"):
        rate = (1 / (after - before)).astype(np.float32)
    return np.where(np.isfinite(after) & np.isfinite(before), rate, np.float32(np.nan))


def _arguments(name: str, description: str | None, argv: Sequence[str]) -> argparse.Namespace:
    p = argparse.ArgumentParser(f"spike4dgs speed {name}", description=description)
    p.add_argument("--ticks", type=int, default=1000)
    p.add_argument("--width", type=int, default=400)
    p.add_argument("--height", type=int, default=250)
    p.add_argument("--repeats", type=int, default=5)
    p.add_argument("--csv", type=Path, help="write the table here too")
    return p.parse_args(list(argv))


def _report(
    a: argparse.Namespace,
    title: str,
    plain: Callable[[], Float32],
    ours: Sequence[tuple[str, Callable[[], object], str]],
) -> int:
    base = time_ms(plain, 1)
    rows = [(title, "numpy", f"{base[0]:.1f}", f"{base[1]:.1f}", "1.0", "0")]
    for what, run, error in ours:
        mine = time_ms(run, a.repeats)
        rows.append((what, "spike4dgs", f"{mine[0]:.1f}", f"{mine[1]:.1f}", f"{base[1] / mine[1]:.1f}", error))
    show_table(f"{a.ticks} ticks of {a.width}x{a.height}", COLUMNS, rows, a.csv)
    return 0


def tfp(argv: Sequence[str] = ()) -> int:
    """Time TFP at every tick of a clip, ours into a given array, as counts and into new memory, beside numpy."""
    a = _arguments("tfp", tfp.__doc__, argv)
    stream = fired_stream(a.ticks, a.width, a.height)
    out = np.empty((a.ticks, a.height, a.width), np.float32)
    error = f"{np.abs(tfp_plainly(stream) - tfp_stack(stream, out=out)).max():.1e}"
    ticks, half_window = np.arange(a.ticks), TfpSettings.half_window
    lengths = np.minimum(ticks + half_window, a.ticks) - np.maximum(ticks - half_window, 0)
    off = int(np.abs(count_stack(stream) - np.rint(out * lengths[:, None, None])).max())
    ours = (
        ("counts, uint8", lambda: count_stack(stream), str(off)),
        ("rates, float32, into a given array", lambda: tfp_stack(stream, out=out), error),
        ("rates, float32, new memory", lambda: tfp_stack(stream), error),
    )
    return _report(a, "rates, float32, new memory", lambda: tfp_plainly(stream), ours)


def tfi(argv: Sequence[str] = ()) -> int:
    """Time TFI at every tick of a clip, ours into a given array and into new memory, beside numpy."""
    a = _arguments("tfi", tfi.__doc__, argv)
    stream = fired_stream(a.ticks, a.width, a.height)
    out = np.empty((a.ticks, a.height, a.width), np.float32)
    error = f"{np.nanmax(np.abs(tfi_plainly(stream) - tfi_stack(stream, out=out))):.1e}"
    ours = (
        ("rates, float32, into a given array", lambda: tfi_stack(stream, out=out), error),
        ("rates, float32, new memory", lambda: tfi_stack(stream), error),
    )
    return _report(a, "rates, float32, new memory", lambda: tfi_plainly(stream), ours)
