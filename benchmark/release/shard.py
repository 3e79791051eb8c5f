"""Write a shard: an uncompressed tar, the same bytes for the same files, hashed while it is written."""

from __future__ import annotations

import hashlib
import tarfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import atomic_path, sha256_file, write_json
from spike4dgs.benchmark.release.index import BLOCK, Member, Shard, index_of, parse_shard, shard_json

_TAR_BLOCK = 512


@dataclass(frozen=True)
class PlannedFile:
    """A file that goes into a shard: its name there, its scene, its path in it and on this machine, and its record."""

    name: str
    scene: str
    path: str
    camera: str | None
    source: Path
    bytes: int
    sha256: str

    @property
    def packed_bytes(self) -> int:
        """The bytes that it takes in a tar: header, content, padding."""
        return len(_header(self)) + self.bytes + -self.bytes % _TAR_BLOCK


def _header(file: PlannedFile) -> bytes:
    info = tarfile.TarInfo(file.name)  # no owner, and the time 0
    info.size, info.mode = file.bytes, 0o644
    return info.tobuf(tarfile.GNU_FORMAT, "utf-8", "strict")


def write_shard(root: Path, name: str, files: Sequence[PlannedFile], advance: Callable[[int], None]) -> Shard:
    """Write the tar `name` below `root` and the list of its members beside it; `advance` gets the bytes read.

    The list comes last: a tar without one is not finished. Raises UserError where a file is not what its record says.
    """
    members, offset, of_shard = [], 0, hashlib.sha256()
    with atomic_path(root / name) as part, open(part, "wb") as tar:

        def write(data: bytes) -> None:
            nonlocal offset
            of_shard.update(data)
            tar.write(data)
            offset += len(data)

        for file in files:
            write(_header(file))
            start, blocks, of_file = offset, [], hashlib.sha256()
            with open(file.source, "rb") as source:
                while block := source.read(BLOCK):
                    blocks.append(hashlib.sha256(block).hexdigest())
                    of_file.update(block)
                    write(block)
                    advance(len(block))
            if (offset - start, of_file.hexdigest()) != (file.bytes, file.sha256):
                found = f"{offset - start} bytes with sha256 {of_file.hexdigest()[:16]}..."
                expected = f"{file.bytes} bytes with sha256 {file.sha256[:16]}..."
                raise problem(file.source, expected, found, "the file was changed or damaged: make the scene again")
            blocks = blocks or [file.sha256]  # of an empty file
            members.append(
                Member(
                    name=file.name,
                    scene=file.scene,
                    path=file.path,
                    camera=file.camera,
                    offset=start,
                    bytes=file.bytes,
                    sha256=file.sha256,
                    blocks=tuple(blocks),
                )
            )
            write(bytes(-file.bytes % _TAR_BLOCK))
        write(bytes(2 * _TAR_BLOCK))  # the end of a tar
    digest = of_shard.hexdigest()
    write_json(root / index_of(name), shard_json(name, offset, digest, members))
    return _shard(root, name, offset, digest)


def _shard(root: Path, name: str, size: int, digest: str) -> Shard:
    index = root / index_of(name)
    return Shard(name, size, digest, index.stat().st_size, sha256_file(index))


def find_shard(root: Path, name: str, files: Sequence[PlannedFile]) -> Shard | None:
    """Return the shard that an earlier run finished with just these files; None for none, or a damaged one."""
    path, index = root / name, root / index_of(name)
    if not (path.is_file() and index.is_file()):
        return None
    shard = _shard(root, name, path.stat().st_size, sha256_file(path))
    try:
        members = parse_shard(index.read_bytes(), shard, str(index))
    except UserError:
        return None
    known = [(m.name, m.scene, m.path, m.camera, m.bytes, m.sha256) for m in members]
    wanted = [(f.name, f.scene, f.path, f.camera, f.bytes, f.sha256) for f in files]
    return shard if known == wanted else None
