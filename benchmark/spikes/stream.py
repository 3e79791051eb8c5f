"""Packed spike streams: memory-mapped reading, windows, counts, streaming writing.

Layout (SpikeCV, generation-1 camera): headerless; every tick is ceil(H * W / 8) bytes; pixels row-major, least
significant bit first (pixel p of a tick is bit p & 7 of byte p >> 3); rows are stored bottom to top. Where H * W is no
multiple of 8 the last byte of a tick is padded with zero bits. Nothing here ever unpacks a whole clip.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.arrays import UInt8
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import writing
from spike4dgs.benchmark.screen.shown import Shown
from spike4dgs.benchmark.spikes.gaps import Gap

_SHOWN_TICKS = 200  # of a thumbnail


def bytes_per_tick(width: int, height: int) -> int:
    """Return the bytes of one packed tick: ceil(width * height / 8)."""
    return (width * height + 7) // 8


@dataclass(frozen=True, eq=False, repr=False)
class SpikeStream(Shown):
    """A packed stream. `packed` is [n_ticks, bytes_per_tick] uint8, usually a read-only memory map.

    `rows_bottom_up` is the order of rows in the file; every method returns images with row 0 at the top. `gaps` are
    the ticks of a recording that were lost: they hold zeros, which are no measurement. `filled` are lost ones that hold
    what `repair.fill_gaps` found likely, which is none either but for the pixels that are set in `certain`: packed rows
    for the filled ticks, in their order. Pixels collect no light for `dead_ticks` after a spike.

    >>> SpikeStream(pack(np.tile(np.eye(8), (25, 1, 1))), 8, 8, 20_000.0)
    <SpikeStream memory: 8x8 pixels, 25 ticks at 20000 Hz (1.25 ms)>
    """

    packed: UInt8
    width: int
    height: int
    rate_hz: float
    rows_bottom_up: bool = True
    source: str = "memory"
    gaps: tuple[Gap, ...] = ()
    filled: tuple[Gap, ...] = ()
    dead_ticks: float = 0.0
    certain: UInt8 | None = None

    @property
    def n_ticks(self) -> int:
        """Number of ticks."""
        return len(self.packed)

    def window(self, start: int, stop: int) -> UInt8:
        """Return the spikes of ticks [start, stop) as [stop - start, H, W] uint8 of 0 and 1.

        Raises UserError for a window that leaves the clip.
        """
        self._check(start, stop)
        from spike4dgs.benchmark.spikes import bits

        return bits.unpack(self.packed[start:stop], self.width, self.height, self.rows_bottom_up)

    def counts(self, start: int, stop: int) -> NDArray[np.uint16]:
        """Return the spikes per pixel in ticks [start, stop) as [H, W] uint16, counted on the packed bits.

        Raises UserError for a window that leaves the clip or is longer than 65535 ticks.
        """
        self._check(start, stop)
        if stop - start > 65535:
            raise problem("window", "at most 65535 ticks", f"{stop - start}", "add up shorter windows")
        counts = count_bits(self.packed[start:stop], self.width * self.height).reshape(self.height, self.width)
        return counts[::-1] if self.rows_bottom_up else counts

    def release(self) -> None:
        """Give back the memory of a mapped file's pages; what is read again comes from the file again.

        A stream that may be written to keeps them: what was written to a private map is nowhere else.
        """
        mapped = self.packed.base
        if isinstance(mapped, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED") and not self.packed.flags.writeable:
            mapped.madvise(mmap.MADV_DONTNEED)

    def _about(self) -> str:
        lost = f", {sum(g.ticks for g in self.gaps)} ticks lost" if self.gaps else ""
        duration = f"{self.n_ticks} ticks at {self.rate_hz:.6g} Hz ({1e3 * self.n_ticks / self.rate_hz:.6g} ms)"
        return f"{Path(self.source).name[:100]}: {self.width}x{self.height} pixels, {duration}{lost}"

    def _thumbnails(self) -> Iterator[tuple[str, UInt8]]:
        """Yield the rates in the middle of the clip: the square root, so that dark pixels show too."""
        first, ticks = max(0, self.n_ticks - _SHOWN_TICKS) // 2, min(self.n_ticks, _SHOWN_TICKS)
        counts = self.counts(first, first + ticks).astype(np.float64)
        white = max(float(np.percentile(counts, 99)), 1.0)
        yield (
            f"spikes of ticks {first} to {first + ticks - 1}",
            np.rint(255 * np.sqrt(np.minimum(counts / white, 1))).astype(np.uint8),
        )

    def _check(self, start: int, stop: int) -> None:
        if not 0 <= start <= stop <= self.n_ticks:
            raise problem(self.source, f"a window within ticks [0, {self.n_ticks})", f"[{start}, {stop})", "shorten it")


class _Packed:
    """The field `packed` of a stream. Its file is looked at each time: to read behind a file's end ends the process."""

    def __get__(self, stream: SpikeStream | None, owner: type) -> Any:
        """Return the packed ticks. Raises UserError where the mapped file was cut since it was opened."""
        if stream is None:
            return self
        packed: UInt8 = stream.__dict__["packed"]
        mapped = packed.base
        if isinstance(mapped, mmap.mmap) and (size := mapped.size()) < len(mapped):
            fix = "another program cut the stream: restore it, and run again"
            raise problem(stream.source, f"{len(mapped)} bytes, as when it was opened", f"{size}", fix)
        return packed

    def __set__(self, stream: SpikeStream, packed: UInt8) -> None:
        stream.__dict__["packed"] = packed


SpikeStream.packed = _Packed()  # type: ignore[assignment]  # after the dataclass, to which it would be a default


def count_bits(packed: UInt8, n_pixels: int) -> NDArray[np.uint16]:
    """Sum over ticks of each of the first `n_pixels` bits of packed rows [n, bytes] -> [n_pixels] uint16."""
    from spike4dgs.benchmark.spikes import bits

    return bits.count_bits(packed, n_pixels)


def pack(spikes: NDArray[np.generic], rows_bottom_up: bool = True) -> UInt8:
    """Pack upright spikes [T, H, W] (non-zero fires) into rows [T, bytes_per_tick] of the file layout."""
    stored = spikes[:, ::-1] if rows_bottom_up else spikes
    flat = stored.reshape(len(stored), stored.shape[1] * stored.shape[2])
    return np.packbits(flat != 0, axis=1, bitorder="little")


def open_stream(
    path: Path | str,
    width: int,
    height: int,
    rate_hz: float,
    *,
    rows_bottom_up: bool = True,
    n_ticks: int | None = None,
    gaps: tuple[Gap, ...] = (),
    dead_ticks: float = 0.0,
) -> SpikeStream:
    """Memory-map a stream file. `gaps`, `dead_ticks`: what its description says of it, see `SpikeStream`.

    Raises UserError where the file is missing, empty, no whole number of ticks, or not `n_ticks` long (if given).

    >>> with SpikeWriter(Path("car.dat"), 8, 2) as w:
    ...     w.write(np.zeros((100, 2), np.uint8))
    >>> open_stream("car.dat", 8, 2, 20_000.0)
    <SpikeStream car.dat: 8x2 pixels, 100 ticks at 20000 Hz (5 ms)>
    """
    path = Path(path)
    size = bytes_per_tick(width, height)
    if width <= 0 or height <= 0:
        raise problem(path, "a positive width and height", f"{width}x{height}", "correct them")
    if not path.is_file():
        raise problem(path, "a spike stream", "no such file", "check the path")
    found = path.stat().st_size
    if found == 0 or found % size:
        fix = "the stream is truncated or the width and height are wrong"
        raise problem(path, f"whole ticks of {size} bytes ({width}x{height})", f"{found} bytes", fix)
    if n_ticks is not None and found != n_ticks * size:
        raise problem(path, f"{n_ticks} ticks", f"{found // size}", "the stream is truncated or not this scene's")
    packed = np.memmap(path, dtype=np.uint8, mode="r", shape=(found // size, size))
    return SpikeStream(packed, width, height, rate_hz, rows_bottom_up, str(path), gaps, dead_ticks=dead_ticks)


class SpikeWriter:
    """Write a stream tick by tick; the file appears under its name only when the writer closes without error.

    Raises UserError where the system cannot write it (disk full, no permission, ...); nothing stays behind then.

    >>> with SpikeWriter(Path("cam.dat"), 8, 2) as w:
    ...     w.write(np.zeros((100, 2), np.uint8))
    >>> Path("cam.dat").stat().st_size
    200
    """

    def __init__(self, path: Path, width: int, height: int) -> None:
        self.path, self._size = path, bytes_per_tick(width, height)
        self.n_ticks = 0
        self._part = path.with_name(f".{path.name}.{os.getpid()}.part")
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = open(self._part, "wb")

    def write(self, packed: UInt8) -> None:
        """Append packed ticks [n, bytes_per_tick]. Raises UserError for rows of another size."""
        if packed.ndim != 2 or packed.shape[1] != self._size or packed.dtype != np.uint8:
            expected = f"uint8 rows of {self._size} bytes"
            raise problem(self.path, expected, f"{packed.dtype} {packed.shape}", "pack the ticks with spikes.pack")
        with writing(self.path):
            self._file.write(np.ascontiguousarray(packed).data)
        self.n_ticks += len(packed)

    def __enter__(self) -> SpikeWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: object) -> None:
        try:
            with writing(self.path):
                if kind is None:
                    self._file.flush()
                    os.fsync(self._file.fileno())
                self._file.close()
                if kind is None:
                    os.replace(self._part, self.path)
        finally:
            self._part.unlink(missing_ok=True)
