"""Fetch a weight file into the folder where metrics and methods look for it."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import locked, sha256_file, writing
from spike4dgs.benchmark.release.source import ByteProgress, Source, size_text
from spike4dgs.benchmark.release.transfer import PIECE
from spike4dgs.benchmark.weights import WeightFile


def fetch_weights(source: Source, name: str, file: WeightFile) -> Path:
    """Fetch a file to where it is looked for and return its path. A killed run goes on where it was.

    Raises UserError where the source keeps failing or has another file than the known one, and where the disk is full.
    """
    path = file.candidates[0]
    part = path.with_name(f".{path.name}.part")
    with locked(path.with_name(f".{path.name}.lock"), path, "a file that no other program fetches"):
        size = file.bytes or source.size(name)
        if size is None:
            raise problem(source.where(name), "a server that states sizes", "one that does not", "use another source")
        if file.sha256 is None:  # nothing tells whether an earlier part is whole, or of this source
            part.unlink(missing_ok=True)
        for attempt in (1, 2):  # the part of an earlier run may be damaged
            _append(source, name, part, size)
            if file.sha256 in (None, found := sha256_file(part)):
                break
            part.unlink()
            if attempt == 2:
                raise problem(source.where(name), f"sha256 {file.sha256}", found, "use another source")
        with writing(path):
            os.replace(part, path)
    return path


def _append(source: Source, name: str, part: Path, size: int) -> None:
    with ByteProgress(f"downloading {name} ({size_text(size)})", size) as progress, writing(part):
        with open(part, "ab") as file:
            have = min(file.tell(), size)
            file.truncate(have)
            progress.skip(have)
            for start in range(have, size, PIECE):
                stop = min(start + PIECE, size)
                data = source.persist(partial(source.read, name, start, stop, size), name)
                file.write(data)
                file.flush()
                progress.advance(len(data))
            os.fsync(file.fileno())
