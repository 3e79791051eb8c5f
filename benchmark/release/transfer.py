"""Fetch files from shards: few range requests, every block verified as it arrives, nothing fetched twice.

A file grows as `.NAME.part` and gets its name when all its blocks are there. Blocks have their hashes in the index, so
the part of a killed download says itself which of its blocks are good: no journal has to agree with it.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import write_bytes, writing
from spike4dgs.benchmark.release.index import BLOCK, Member, Shard
from spike4dgs.benchmark.release.source import ByteProgress, Source, Stopped

PIECE = 16 << 20  # bytes of one request at most: each worker holds one piece in memory
_GAP = 64 << 10  # bytes between wanted ones that are cheaper to read than a request of their own
_TRIES_OF_A_BLOCK = 3


@dataclass(frozen=True)
class Wanted:
    """A file to fetch, or with `cut` only its bytes [start, stop), and the path where they go."""

    shard: Shard
    member: Member
    path: Path
    cut: tuple[int, int] | None = None

    @property
    def blocks(self) -> range:
        """The blocks of the file that are needed."""
        if self.cut is None:
            return range(len(self.member.blocks))
        return range(self.cut[0] // BLOCK, -(-self.cut[1] // BLOCK))

    @property
    def part(self) -> Path:
        """Where its blocks are gathered."""
        return self.path.with_name(f".{self.path.name}.part")

    def size_of(self, block: int) -> int:
        """Return the bytes of a block: BLOCK, of the last one what remains."""
        return min(BLOCK, self.member.bytes - block * BLOCK)

    @property
    def bytes(self) -> int:
        """The bytes to fetch."""
        return sum(map(self.size_of, self.blocks))


@dataclass(frozen=True)
class _Block:
    """A block that is to be fetched: of which file, which one, and where it lies in the shard."""

    file: _File
    number: int
    offset: int
    bytes: int


class _File:
    """A wanted file and how many of its blocks are missing."""

    def __init__(self, wanted: Wanted) -> None:
        self.wanted, self._lock = wanted, Lock()
        held = self._held()
        self.missing = [b for b in wanted.blocks if b not in held]
        self.left = len(self.missing)

    def _held(self) -> set[int]:
        """Return the blocks that are on disk and good. A file that is whole but damaged becomes a part again."""
        wanted = self.wanted
        with writing(wanted.path):
            if wanted.cut is None and wanted.path.is_file():
                held = self._good(wanted.path)
                if len(held) == len(wanted.blocks) and wanted.path.stat().st_size == wanted.member.bytes:
                    wanted.part.unlink(missing_ok=True)  # it would replace the file
                    return held
                os.replace(wanted.path, wanted.part)
                return held
            return self._good(wanted.part) if wanted.part.is_file() else set()

    def _good(self, path: Path) -> set[int]:
        good = set()
        with open(path, "rb") as file:
            for number in self.wanted.blocks:
                data = file.read(self.wanted.size_of(number))
                if hashlib.sha256(data).hexdigest() == self.wanted.member.blocks[number]:
                    good.add(number)
        return good

    def blocks(self) -> Iterator[_Block]:
        """Yield the missing blocks."""
        for number in self.missing:
            offset = self.wanted.member.offset + number * BLOCK
            yield _Block(self, number, offset, self.wanted.size_of(number))

    def write(self, number: int, data: bytes) -> None:
        """Write a verified block; with the last one the file gets its name."""
        wanted = self.wanted
        with writing(wanted.path):
            wanted.path.parent.mkdir(parents=True, exist_ok=True)
            # Windows would translate line ends, and has no `pwrite`.
            descriptor = os.open(wanted.part, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666)
            try:
                os.lseek(descriptor, (number - wanted.blocks.start) * BLOCK, os.SEEK_SET)
                view = memoryview(data)
                while view:  # a system may write less than it is given, as where a disk is about to be full
                    view = view[os.write(descriptor, view) :]
            finally:
                os.close(descriptor)
        with self._lock:
            self.left -= 1
            last = self.left == 0
        if last:
            self.finish()

    def finish(self) -> None:
        """Give the part, whose blocks are all there, its name."""
        wanted = self.wanted
        if wanted.cut is None:
            with writing(wanted.path):
                with open(wanted.part, "rb+") as part:
                    part.truncate(wanted.bytes)  # of a part of another release more may be there
                    os.fsync(part.fileno())
                os.replace(wanted.part, wanted.path)
            return
        first = wanted.blocks.start * BLOCK
        with open(wanted.part, "rb") as part:
            part.seek(wanted.cut[0] - first)
            write_bytes(wanted.path, part.read(wanted.cut[1] - wanted.cut[0]))
        wanted.part.unlink()


def transfer(source: Source, wanted: Iterable[Wanted], progress: ByteProgress, workers: int) -> None:
    """Fetch files; those that are whole and good stay as they are.

    Raises UserError where the source keeps failing or sends damaged data, and where the disk is full. Verified blocks
    stay for the next run.
    """
    missing: dict[Shard, list[_Block]] = {}
    for file in map(_File, wanted):
        progress.skip(file.wanted.bytes - sum(block.bytes for block in file.blocks()))
        if not file.missing and file.wanted.part.is_file():  # the run before was killed just here
            file.finish()
        missing.setdefault(file.wanted.shard, []).extend(file.blocks())
    pieces = [(shard, piece) for shard, blocks in missing.items() for piece in _pieces(blocks)]
    with ThreadPoolExecutor(workers) as pool:
        running = [pool.submit(_fetch, source, shard, piece, progress) for shard, piece in pieces]
        try:
            for done in as_completed(running):
                done.result()
        except BaseException:
            source.stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _pieces(blocks: Iterable[_Block]) -> Iterator[list[_Block]]:
    """Yield the blocks of each request: neighbours, at most PIECE bytes from the first to the last."""
    held: list[_Block] = []
    for block in sorted(blocks, key=lambda b: b.offset):
        if held:
            gap, end = block.offset - _end(held[-1]), _end(block)
            if gap > _GAP or end - held[0].offset > PIECE:
                yield held
                held = []
        held.append(block)
    if held:
        yield held


def _end(block: _Block) -> int:
    return block.offset + block.bytes


def _fetch(source: Source, shard: Shard, blocks: Sequence[_Block], progress: ByteProgress) -> None:
    """Fetch neighbouring blocks, verify and write them.

    After a failure the request is halved, down to one block, so a connection that is cut again and again still gets on.
    """
    todo, failures, damaged = [list(blocks)], 0, dict.fromkeys(blocks, 0)
    while todo:
        if source.stop.is_set():
            raise Stopped
        piece = todo.pop()
        start = piece[0].offset
        try:
            data = source.read(shard.file, start, _end(piece[-1]), shard.bytes)
        except Exception as e:  # file systems behind fsspec raise errors of their own kinds
            failures += 1
            source.wait(e, failures, shard.file)
            half = len(piece) // 2
            todo += [piece[half:], piece[:half]] if half else [piece]
            continue
        failures = 0
        for block in piece:
            own = data[block.offset - start : _end(block) - start]
            if hashlib.sha256(own).hexdigest() == block.file.wanted.member.blocks[block.number]:
                block.file.write(block.number, own)
                progress.advance(block.bytes)
                continue
            damaged[block] += 1
            if damaged[block] == _TRIES_OF_A_BLOCK:
                raise _damaged(source, shard, block, own)
            todo.append([block])


def _damaged(source: Source, shard: Shard, block: _Block, data: bytes) -> Exception:
    member = block.file.wanted.member
    where = f"{source.where(shard.file)}, {member.scene}/{member.path}"
    expected = f"bytes with sha256 {member.blocks[block.number][:16]}... at offset {block.offset}"
    found = f"{hashlib.sha256(data).hexdigest()[:16]}... {_TRIES_OF_A_BLOCK} times"
    return problem(where, expected, found, "the server's copy is damaged: tell its owner, or use another source")
