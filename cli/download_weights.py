"""`download weights`: fetch weight files into the folder where metrics and methods look for them."""

from __future__ import annotations

import sys
from collections.abc import Mapping

from tyro.conf import Positional

from spike4dgs.baselines.images.published.makers import FILES as PUBLISHED
from spike4dgs.baselines.starts.dust3r import FILE as DUST3R
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import sha256_file
from spike4dgs.benchmark.release.source import Source
from spike4dgs.benchmark.release.weights import fetch_weights
from spike4dgs.benchmark.weights import ALEXNET, METAIQA, SQUEEZENET, VGG16, WeightFile
from spike4dgs.cli.options import From, check_names

OTHERS = {"lpips-vgg": VGG16, "lpips-squeeze": SQUEEZENET, "metaiqa": METAIQA, "dust3r": DUST3R}
FILES = {"lpips": ALEXNET, **OTHERS, **PUBLISHED}


def download_weights(names: Positional[tuple[str, ...]] = (), *, source: From = None, yes: bool = False) -> int:
    """Fetch weight files once you have accepted their licences. Known hashes are checked.

    Files go where metrics and methods look for them: the folder that SPIKE4DGS_WEIGHTS names, or else torch hub's.

    Args:
        names: lpips (AlexNet, used in the tables), lpips-vgg, lpips-squeeze, metaiqa, dust3r, ssml, ssir, spikeclip,
            scflow; if left out, all are listed.
        source: Another folder to fetch the files from, such as a mirror: https://..., file://... or a path.
        yes: Accept the licences without being asked.
    """
    check_names("weights", names, FILES)
    chosen = {name: FILES[name] for name in names or FILES}
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
        try:
            answer = input(f"Do you accept the licences of {', '.join(files)}? [y/N] ")
        except EOFError:  # Ctrl-D is no consent
            print()
    if answer.strip().lower() not in ("y", "yes"):
        raise problem("licences", "your consent to the licences above", "none", "add --yes to accept them")
