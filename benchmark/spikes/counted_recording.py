"""Counted recordings: all that a calibration reads of a recording of steady light or of darkness, in fewer bytes.

A pixel's rate needs the ticks of its first and last spike and their number; a flickering pixel shows in its counts in
windows of WINDOW_TICKS. Estimates from a counted recording equal those from the raw one to the last bit. The file is an
.npz of the arrays below. It holds no single spike: what emulates an array needs the raw recording.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import Float64, Int32, Int64, UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.spikes.bits import SMALL, in_threads, kernel, rows
from spike4dgs.benchmark.spikes.gaps import present
from spike4dgs.benchmark.spikes.stream import SpikeStream
from spike4dgs.benchmark.untrusted import read_npz

_MOST = 60_000  # ticks counted at once, whole windows: a stream's counts are 16 bits wide
WINDOW_TICKS = 50  # of a flickering pixel's counts: a state that holds for a few milliseconds shows
_AGAIN = "restore it or make the scene again"


@dataclass(frozen=True, eq=False)
class CountedRecording:
    """The spikes of a recording, counted. Images have row 0 at the top."""

    first: Int32  # [H, W] tick of a pixel's first spike; -1 where it has none
    last: Int32  # [H, W] tick of its last spike; -1 where it has none
    total: Int32  # [H, W] its spikes
    windows: UInt8  # [N, H, W] its spikes in each whole window of WINDOW_TICKS, from tick 0 on
    n_ticks: int
    source: str = "memory"  # the file, for messages
    dead_ticks: float = 0.0  # how long a pixel collects no light after a spike

    @property
    def width(self) -> int:
        """Pixels of a row."""
        return int(self.total.shape[1])

    @property
    def height(self) -> int:
        """Rows."""
        return int(self.total.shape[0])

    @property
    def arrays(self) -> dict[str, NDArray[Any]]:
        """The arrays of the file, in the types of the file."""
        ticks: NDArray[Any] = np.array(self.n_ticks, np.int64)
        return {"first": self.first, "last": self.last, "total": self.total, "windows": self.windows, "n_ticks": ticks}

    def counts(self, start: int, stop: int) -> Int64:
        """Return the spikes per pixel in ticks [start, stop) as [H, W], as `SpikeStream.counts` does.

        Raises UserError unless the ticks are whole windows, or windows and all that follows.
        """
        first, last = start // WINDOW_TICKS, stop // WINDOW_TICKS
        to_end = stop == self.n_ticks
        if not 0 <= start <= stop <= self.n_ticks or start % WINDOW_TICKS or (stop % WINDOW_TICKS and not to_end):
            expected = f"whole windows of {WINDOW_TICKS} ticks within [0, {self.n_ticks}) of a counted recording"
            raise problem(self.source, expected, f"[{start}, {stop})", "use the raw recording (.dat)")
        if to_end:
            return np.asarray(self.total - self.windows[:first].sum(axis=0, dtype=np.int64))
        return np.asarray(self.windows[first:last].sum(axis=0, dtype=np.int64))

    def release(self) -> None:
        """Do nothing, where a stream gives back its file's pages: the counts are no file's."""

    def taken(self, y: NDArray[np.intp], x: NDArray[np.intp]) -> CountedRecording:
        """Return the recording whose pixel [i, j] has the spikes of pixel (y[i, j], x[i, j])."""
        first, last, total = (image[y, x] for image in (self.first, self.last, self.total))
        return replace(self, first=first, last=last, total=total, windows=self.windows[:, y, x])


Recording: TypeAlias = SpikeStream | CountedRecording


def counted(recording: Recording) -> CountedRecording:
    """Return the counts of a raw recording; a counted one is returned as it is."""
    if isinstance(recording, CountedRecording):
        return recording
    starts = range(0, recording.n_ticks - WINDOW_TICKS + 1, WINDOW_TICKS)
    windows = np.empty((len(starts), recording.height, recording.width), np.uint8)
    for window, start in zip(windows, starts, strict=True):
        window[:] = recording.counts(start, start + WINDOW_TICKS)
    first, last, total = (image.astype(np.int32) for image in first_last_total(recording))
    return CountedRecording(first, last, total, windows, recording.n_ticks, recording.source, recording.dead_ticks)


def first_last_total(recording: Recording) -> tuple[Int64, Int64, Int64]:
    """Return the ticks of each pixel's first and last spike (-1: none), and the number of its spikes, each [H, W]."""
    if isinstance(recording, CountedRecording):
        return tuple(x.astype(np.int64) for x in (recording.first, recording.last, recording.total))  # type: ignore[return-value]
    packed = rows(recording.packed)
    first, last = (np.full(8 * packed.shape[1], -1, np.int64) for _ in range(2))
    for back, found in ((False, first), (True, last)):
        in_threads(_meet, packed.shape[1], packed, back, found, small=packed.size < SMALL)
    images = [x[: recording.width * recording.height].reshape(recording.height, recording.width) for x in (first, last)]
    first, last = (x[::-1] if recording.rows_bottom_up else x for x in images)
    return first, last, total_counts(recording)


def total_counts(stream: Recording) -> Int64:
    """Return the spikes per pixel of a whole stream [H, W]."""
    counts = np.zeros((stream.height, stream.width), np.int64)
    for start in range(0, stream.n_ticks, _MOST):
        counts += stream.counts(start, min(start + _MOST, stream.n_ticks))
    stream.release()
    return counts


def mean_rate(stream: SpikeStream) -> Float64:
    """Return the spikes per tick [H, W] of a stream, over the ticks that it does not lack."""
    return total_counts(stream) / max(int(present(stream.gaps, stream.n_ticks).sum()), 1)


@kernel
def _meet(packed: Any, back: bool, found: Any, start: int, stop: int) -> None:
    """Fill the tick of the first spike that each pixel of bytes [start, stop) has, or coming `back` from the last tick.

    `packed` has rows [T, bytes].
    """
    met, left = np.zeros(stop - start, np.uint8), stop - start
    for t in range(len(packed)):
        tick = len(packed) - 1 - t if back else t
        for byte in range(start, stop):
            new = packed[tick, byte] & ~met[byte - start]
            if new:
                met[byte - start] |= new
                left -= met[byte - start] == 255
                for k in range(8):
                    if (new >> k) & 1:
                        found[8 * byte + k] = tick
        if not left:
            return


def raw(recording: Recording) -> SpikeStream:
    """Return a raw recording as it is. Raises UserError for a counted one, which holds no single spike."""
    if isinstance(recording, CountedRecording):
        fix = "use the scene as `spike4dgs make-dataset` writes it"
        raise problem(recording.source, "a raw recording (.dat)", "a counted one", fix)
    return recording


def encode_recording(recording: Recording) -> bytes:
    """Return the bytes of a counted recording's file. Equal recordings give equal bytes."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **counted(recording).arrays)
    return buffer.getvalue()


def open_counted(path: Path, width: int, height: int, n_ticks: int) -> CountedRecording:
    """Read a counted recording. Raises UserError where it is missing, damaged, or not of this size and length."""
    what = f"the counts of {n_ticks} ticks, {width}x{height} pixels"
    arrays = read_npz(path, what)
    _check(path, what, arrays, (height, width), n_ticks)
    return CountedRecording(arrays["first"], arrays["last"], arrays["total"], arrays["windows"], n_ticks, str(path))


def _check(path: Path, what: str, arrays: Mapping[str, NDArray[Any]], shape: tuple[int, int], n_ticks: int) -> None:
    """Raise UserError unless the arrays can be counts of one recording of this shape and length."""
    shapes = {name: (shape, np.int32) for name in ("first", "last", "total")}
    expected = {**shapes, "windows": ((n_ticks // WINDOW_TICKS, *shape), np.uint8), "n_ticks": ((), np.int64)}
    if set(arrays) != set(expected):
        raise problem(path, what, f"the arrays {', '.join(sorted(arrays)) or '(none)'}", _AGAIN)
    for name, (size, kind) in expected.items():
        if arrays[name].shape != size or arrays[name].dtype != kind:
            raise problem(path, what, f"{name} of {arrays[name].dtype} {arrays[name].shape}", _AGAIN)
    if (length := int(arrays["n_ticks"])) != n_ticks:
        raise problem(path, what, f"{length} ticks", _AGAIN)
    first, last, total, windows = (arrays[name] for name in ("first", "last", "total", "windows"))
    inside = (first >= 0) & (first <= last) & (last < n_ticks) & (total >= 1) & (total <= last - first + 1)
    silent = (first == -1) & (last == -1) & (total == 0)
    rest = total - windows.sum(axis=0, dtype=np.int64)
    if not (inside | silent).all() or windows.max(initial=0) > WINDOW_TICKS or rest.min(initial=0) < 0:
        raise problem(path, what, "counts that contradict each other", _AGAIN)
