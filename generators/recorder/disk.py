"""Files that grow as fast as the disk allows: past the page cache where the system supports it (`O_DIRECT`).

A cache that is filled faster than the disk empties it blocks every writer for long, at unpredictable times. Here bytes
are collected in a few aligned buffers, and a thread for each file writes whole buffers to the disk: the processor
copies each byte once, and the amount of waiting data is known (`Buffers.waiting`). Where a file system does not support
unaligned files or O_DIRECT at all, buffers go through the cache and are forced out one by one, for the same reason.

Measured with 1 to 2 GiB on a virtual disk: one file took 600 to 880 MB/s past the cache, at 3 to 7 % of a core, and 300
MB/s at 49 % through it. Buffers of 16 MiB were no faster than 4 MiB, and their longest write took three times as long.
Reserving the space beforehand changed the rate little, and the longest write much: 130 ms at most, against a second.
"""

from __future__ import annotations

import contextlib
import errno
import mmap
import os
import queue
import threading
import time
from pathlib import Path

import numpy as np

from spike4dgs.benchmark.arrays import UInt8

BUFFER_BYTES = 4 << 20
PER_FILE = 4  # buffers
_BLOCK = 4096  # bytes: O_DIRECT needs addresses, sizes and offsets in multiples of it

_Job = tuple[int, UInt8, int]  # offset in the file, buffer, number of its bytes


class Buffers:
    """Aligned memory, shared by `files` files of at most `file_bytes` each."""

    def __init__(self, files: int, file_bytes: int) -> None:
        self.size = min(BUFFER_BYTES, _up(max(file_bytes, 1)))
        self.count = files * PER_FILE
        memory = np.frombuffer(mmap.mmap(-1, self.count * self.size), np.uint8).reshape(self.count, self.size)
        memory.fill(0)  # makes the system map the pages now, not while a camera sends
        self.waited_s = 0.0  # by `take`, in all
        self._free: queue.SimpleQueue[UInt8] = queue.SimpleQueue()
        for buffer in memory:
            self._free.put(buffer)

    @property
    def waiting(self) -> int:
        """Number of bytes in buffers that are being filled or written."""
        return (self.count - self._free.qsize()) * self.size

    def take(self) -> UInt8:
        """Return a free buffer [size] of any content; wait for one. To be called by one thread."""
        begun = time.monotonic()
        buffer = self._free.get()
        self.waited_s += time.monotonic() - begun
        return buffer

    def give(self, buffer: UInt8) -> None:
        """Return a buffer to the free ones."""
        self._free.put(buffer)


class DiskFile:
    """A new file of `n_bytes` zeros with reserved space, written from its start to its end.

    Its own thread writes; an error of the system ends the writing for good, and is kept in `error`. Only the
    constructor and `close` raise OSError.
    """

    def __init__(self, path: Path, n_bytes: int, buffers: Buffers) -> None:
        self.direct = True  # past the page cache
        self.error: OSError | None = None
        self.written = 0  # every byte before this is on the disk, or was left zero
        self.longest_s = 0.0  # that the disk took for one buffer
        self._fd = self._open(path)
        self._buffers = buffers
        self._buffer: UInt8 | None = None  # being filled, to be written at _at
        self._at = self._filled = 0
        self._failed = 0  # end of the buffer that could not be written
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=path.name, daemon=True)
        try:
            self._reserve(n_bytes)
        except BaseException:
            os.close(self._fd)
            path.unlink()
            raise
        self._thread.start()

    def write(self, at: int, data: UInt8) -> None:
        """Accept bytes [n] for offset `at`, after all earlier ones; bytes between them stay zero.

        Waits while no buffer is free. Does nothing after an error.
        """
        if at < self._at + self._filled:
            raise ValueError(f"byte {at} is to be written after byte {self._at + self._filled}")
        if self.error is None:
            self._skip(at)
        while len(data) and self.error is None:
            if self._buffer is None:
                self._buffer = self._buffers.take()
            n = min(len(data), self._buffers.size - self._filled)
            self._buffer[self._filled : self._filled + n] = data[:n]
            self._filled += n
            data = data[n:]
            if self._filled == self._buffers.size:
                self._hand_over()

    def flush(self) -> None:
        """Wait until all bytes are on the disk or have failed. Nothing can be written after this."""
        if self._thread.is_alive():
            self._hand_over()
            self._jobs.put(None)
            self._thread.join()

    def blank(self, start: int) -> None:
        """Write zeros from `start` to the end of the buffer that could not be written, as far as the disk allows."""
        with contextlib.suppress(OSError):
            self._cached()
            while start < self._failed:
                start += os.pwrite(self._fd, bytes(self._failed - start), start)

    def close(self, n_bytes: int | None = None) -> None:
        """Close the file; with `n_bytes`, cut it to that length first and force it to the disk."""
        self.flush()
        fd, self._fd = self._fd, -1
        if fd >= 0:
            try:
                if n_bytes is not None:
                    os.truncate(fd, n_bytes)
                    os.fsync(fd)
            finally:
                os.close(fd)

    def _open(self, path: Path) -> int:
        flags = os.O_RDWR | os.O_CREAT | os.O_TRUNC
        try:
            return os.open(path, flags | os.O_DIRECT, 0o644)
        except OSError as e:
            if e.errno != errno.EINVAL:
                raise
        self.direct = False  # the file system supports the cache only
        return os.open(path, flags, 0o644)

    def _reserve(self, n_bytes: int) -> None:
        try:
            return os.posix_fallocate(self._fd, 0, n_bytes)
        except OSError as e:
            if e.errno not in (errno.EINVAL, errno.EOPNOTSUPP) or not self.direct:
                raise
        self._cached()  # a system without fallocate has the C library write a byte of each block, which is not aligned
        os.posix_fallocate(self._fd, 0, n_bytes)

    def _skip(self, at: int) -> None:
        """Leave zeros up to `at`."""
        if self._buffer is not None and at < self._at + self._buffers.size:
            self._buffer[self._filled : at - self._at] = 0
            self._filled = at - self._at
        elif at > self._at + self._filled:
            self._hand_over()
            self._at = at // _BLOCK * _BLOCK
            self._buffer, self._filled = self._buffers.take(), at - self._at
            self._buffer[: self._filled] = 0

    def _hand_over(self) -> None:
        """Have the buffer written, zero-padded to a whole block; the padding is overwritten, or cut off at the end."""
        if self._buffer is not None:
            n = _up(self._filled)
            self._buffer[self._filled : n] = 0
            self._jobs.put((self._at, self._buffer, n))
            self._at, self._filled, self._buffer = self._at + n, 0, None

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            at, buffer, n = job
            begun = time.monotonic()
            try:
                if self.error is None:
                    self._write(at, buffer[:n])
            except OSError as e:
                self.error, self._failed = e, at + n
            self.longest_s = max(self.longest_s, time.monotonic() - begun)
            self._buffers.give(buffer)

    def _write(self, at: int, data: UInt8) -> None:
        start = self.written = at
        try:
            while len(data):
                done = self._put(at, data)
                data, at = data[done:], at + done
                if self.direct:
                    self.written = at
        finally:
            if not self.direct:  # data in the cache are not on the disk yet
                os.fdatasync(self._fd)
                os.posix_fadvise(self._fd, start, at - start, os.POSIX_FADV_DONTNEED)
                self.written = at

    def _put(self, at: int, data: UInt8) -> int:
        try:
            return os.pwrite(self._fd, data.data, at)
        except OSError as e:
            if e.errno != errno.EINVAL or not self.direct:
                raise
        self._cached()  # this file system needs another alignment, or a limit cut a write in the middle of a block
        return os.pwrite(self._fd, data.data, at)

    def _cached(self) -> None:
        """Write through the cache from now on."""
        import fcntl  # of Linux alone, like O_DIRECT

        flags = fcntl.fcntl(self._fd, fcntl.F_GETFL)
        fcntl.fcntl(self._fd, fcntl.F_SETFL, flags & ~os.O_DIRECT)
        self.direct = False


def _up(n: int) -> int:
    return -(-n // _BLOCK) * _BLOCK
