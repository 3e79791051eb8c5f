"""`download weights`: fetch weight files into the folder where metrics and methods look for them."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import sha256_file, writing
from spike4dgs.benchmark.locks import locked
from spike4dgs.benchmark.release.download_command import From
from spike4dgs.benchmark.release.progress import ByteProgress, size_text
from spike4dgs.benchmark.release.source import Source
from spike4dgs.benchmark.release.transfer import PIECE
from spike4dgs.benchmark.weights import ALEXNET, METAIQA, SQUEEZENET, VGG16, WeightFile

FILES = {"lpips": ALEXNET, "lpips-vgg": VGG16, "lpips-squeeze": SQUEEZENET, "metaiqa": METAIQA}
DUST3R = "dust3r"


def make_download_weights(dust3r: Callable[[], WeightFile]) -> Callable[..., int]:
    """Return the command `download weights`; `dust3r` gives the facts of the weights of another room."""

    def command(names: Positional[tuple[str, ...]] = (), *, source: From = None, yes: bool = False) -> int:
        """Fetch weight files after their licences were accepted. Where a hash is known, it is checked.

        Files go where metrics and methods look for them: the folder that SPIKE4DGS_WEIGHTS names, else torch hub's.

        Args:
            names: lpips (AlexNet, of the tables), lpips-vgg, lpips-squeeze, metaiqa, dust3r; a list of all if left out.
            source: Another folder to fetch the files from, such as a mirror: https://..., file://... or a path.
            yes: Accept the licences without being asked.
        """
        known = (*FILES, DUST3R)
        if unknown := [name for name in names if name not in known]:
            raise problem("weights", f"names among {', '.join(known)}", unknown[0], "correct the name")
        chosen = {name: dust3r() if name == DUST3R else FILES[name] for name in names or known}
        for name, file in chosen.items():
            print(_facts(name, file))
        missing = {name: file for name, file in chosen.items() if not _is_here(file)}
        if not names or not missing:
            return 0
        sources = {name: _source(name, file, source) for name, file in missing.items()}
        _accept(missing, yes)
        for name, file in missing.items():
            print(f"{fetch_weights(*sources[name], file)}: sha256 {sha256_file(file.candidates[0])}")
        return 0

    return command


def _facts(name: str, file: WeightFile) -> str:
    """Return what is to be known of a file before it is fetched, in lines."""
    place = f"is at {file.candidates[0]}" if _is_here(file) else f"goes to {file.candidates[0]}"
    return f"{name}: {file.description}\n  licence: {file.licence}\n  from {file.source}; {place}"


def _is_here(file: WeightFile) -> bool:
    path = file.candidates[0]
    return path.is_file() and file.sha256 in (None, sha256_file(path))


def _source(name: str, file: WeightFile, address: str | None) -> tuple[Source, str]:
    """Return where a file is fetched from, and its name there. Raises UserError where nobody can say."""
    if address is not None:
        return Source(address), file.name
    if file.address is None:
        fix = f"get the file from {file.source}, then name its folder: --from FOLDER"
        raise problem(f"weights {name}", "an address of the file", "a page for people only", fix)
    folder, remote = file.address
    return Source(folder), remote


def _accept(files: Mapping[str, WeightFile], yes: bool) -> None:
    """Ask for the licences. Raises UserError where they are not accepted."""
    if yes:
        return
    answer = ""
    if sys.stdin.isatty():
        answer = input(f"Do you accept the licences of {', '.join(files)}? [y/N] ")
    if answer.strip().lower() not in ("y", "yes"):
        raise problem("licences", "your consent to the licences above", "none", "add --yes to accept them")


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
    """Fetch the bytes that a part lacks."""
    with ByteProgress(f"downloading {name} ({size_text(size)})", size) as progress, writing(part):
        with open(part, "ab") as file:
            have = min(file.tell(), size)
            file.truncate(have)
            progress.skip(have)
            while have < size:
                stop = min(have + PIECE, size)
                data = source.read_again(name, have, stop, size)
                file.write(data)
                file.flush()
                have = stop
                progress.advance(len(data))
            os.fsync(file.fileno())
