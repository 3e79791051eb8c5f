"""Files that grow as fast as the disk takes them: past the page cache where the system allows it (`O_DIRECT`).

A cache that is written to faster than the disk empties it makes every writer wait for long and at a time of its own
choosing. Here bytes are collected in a few aligned buffers, and a thread for each file hands whole buffers to the disk:
the processor copies each byte once, and what waits is known (`Buffers.waiting`). Where a file system does not take
unaligned files or none of this at all, buffers go through the cache and are forced out one by one, for the same reason.

Measured with 1 to 2 GiB on a virtual disk: one file took 600 to 880 MB/s past the cache, at 3 to 7 % of a core, and 300
MB/s at 49 % through it. Buffers of 16 MiB were no faster than 4 MiB, and their longest write took three times as long.
Reserving the space beforehand changed the rate little, and the longest write much: 130 ms at most, against a second.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import mmap
import os
import queue
import threading
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

UInt8 = NDArray[np.uint8]

BUFFER_BYTES = 4 << 20
PER_FILE = 4  # buffers
_BLOCK = 4096  # bytes whose multiples O_DIRECT takes: of addresses, sizes and places in the file

_Job = tuple[int, UInt8, int]  # place in the file, buffer, bytes of it


class Buffers:
    """Aligned memory for `files` files that are each of `file_bytes` at most; they share it."""

    def __init__(self, files: int, file_bytes: int) -> None:
        self.size = min(BUFFER_BYTES, _up(max(file_bytes, 1)))
        self.count = files * PER_FILE
        memory = np.frombuffer(mmap.mmap(-1, self.count * self.size), np.uint8).reshape(self.count, self.size)
        memory.fill(0)  # has the system map the pages now, not while a camera sends
        self._free: queue.SimpleQueue[UInt8] = queue.SimpleQueue()
        for buffer in memory:
            self._free.put(buffer)

    @property
    def waiting(self) -> int:
        """Bytes of the buffers that are being filled or written."""
        return (self.count - self._free.qsize()) * self.size

    def take(self) -> UInt8:
        """A buffer [size] of any content; waits for one."""
        return self._free.get()

    def give(self, buffer: UInt8) -> None:
        """Give a buffer back."""
        self._free.put(buffer)


class DiskFile:
    """A new file of `n_bytes` zeros, whose space is reserved, and which is written from its start to its end.

    Its own thread writes; an error of the system stops that for good, and is kept in `error`. Only the constructor and
    `close` raise OSError.
    """

    def __init__(self, path: Path, n_bytes: int, buffers: Buffers) -> None:
        self.direct = True  # past the page cache
        self.error: OSError | None = None
        self.written = 0  # every byte before this is on the disk, or was left zero
        self._fd = self._open(path)
        self._buffers = buffers
        self._buffer: UInt8 | None = None  # that is being filled, to be written at _at
        self._at = self._filled = 0
        self._failed = 0  # end of the buffer that could not be written
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=path.name, daemon=True)
        try:
            os.posix_fallocate(self._fd, 0, n_bytes)
        except BaseException:
            os.close(self._fd)
            path.unlink()
            raise
        self._thread.start()

    def write(self, at: int, data: UInt8) -> None:
        """Take bytes [n] for the place `at`, behind all that came before; what lies between them stays zero.

        Waits where no buffer is free. After an error there is nothing more to do, and nothing is done.
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
        """Wait until everything is on the disk, or was refused. Nothing can be written after this."""
        if self._thread.is_alive():
            self._hand_over()
            self._jobs.put(None)
            self._thread.join()

    def blank(self, start: int) -> None:
        """Zeros from `start` to the end of the buffer that could not be written, as far as the disk takes them."""
        with contextlib.suppress(OSError):
            self._cached()
            while start < self._failed:
                start += os.pwrite(self._fd, bytes(self._failed - start), start)

    def close(self, n_bytes: int | None = None) -> None:
        """Close the file; with `n_bytes` cut it to that length first, and have the disk hold it."""
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
        self.direct = False  # the file system has nothing but the cache
        return os.open(path, flags, 0o644)

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
        """Have the buffer written, with zeros up to a whole block: they are written over, or cut off in the end."""
        if self._buffer is not None:
            n = _up(self._filled)
            self._buffer[self._filled : n] = 0
            self._jobs.put((self._at, self._buffer, n))
            self._at, self._filled, self._buffer = self._at + n, 0, None

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            at, buffer, n = job
            try:
                if self.error is None:
                    self._write(at, buffer[:n])
            except OSError as e:
                self.error, self._failed = e, at + n
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
            if not self.direct:  # what the cache has taken is not on the disk yet
                os.fdatasync(self._fd)
                os.posix_fadvise(self._fd, start, at - start, os.POSIX_FADV_DONTNEED)
                self.written = at

    def _put(self, at: int, data: UInt8) -> int:
        try:
            return os.pwrite(self._fd, data.data, at)
        except OSError as e:
            if e.errno != errno.EINVAL or not self.direct:
                raise
        self._cached()  # this file system wants another alignment, or a limit cut a write in the middle of a block
        return os.pwrite(self._fd, data.data, at)

    def _cached(self) -> None:
        """Write through the cache from now on."""
        flags = fcntl.fcntl(self._fd, fcntl.F_GETFL)
        fcntl.fcntl(self._fd, fcntl.F_SETFL, flags & ~os.O_DIRECT)
        self.direct = False


def _up(n: int) -> int:
    return -(-n // _BLOCK) * _BLOCK
