"""`release pack`, `check`, `publish`, `wheel` and `fingerprint`: make a release, upload it, and identify its scenes."""

from __future__ import annotations

import re
import sys
from pathlib import Path

from rich.table import Table
from tyro.conf import Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import sha256_file
from spike4dgs.benchmark.release.check import find_problems
from spike4dgs.benchmark.release.fingerprint import make_fingerprint, write_fingerprint
from spike4dgs.benchmark.release.index import Release, read_release
from spike4dgs.benchmark.release.pack import pack as pack_scenes
from spike4dgs.benchmark.release.publish import plan, send, token_of
from spike4dgs.benchmark.release.source import size_text
from spike4dgs.benchmark.release.wheel import write_wheel
from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.benchmark.scene.scene import open_scenes
from spike4dgs.leaderboard.tracks import scene_name


def pack(
    scenes: Positional[tuple[Path, ...]], *, out: Path, name: str = "1", shard_mb: int = 1000, flat: bool = False
) -> int:
    """Pack scene folders into uncompressed tars with an index, a dataset card, Croissant and checksums.

    The same scenes give the same bytes. A killed run resumes.

    Args:
        scenes: Scene folders.
        out: Folder of the release.
        name: Name of the release.
        shard_mb: Size of a tar in 10^6 bytes; a larger camera gets a separate tar.
        flat: Put all files into one folder, as Zenodo requires.
    """
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name):
        raise problem("--name", "letters, digits, dots, dashes", repr(name), "choose another name")
    if shard_mb < 1:
        raise problem("--shard-mb", "at least 1", str(shard_mb), "correct the number")
    opened = open_scenes(scenes, allow_gaps=True)
    release = pack_scenes(opened, out, name, shard_mb * 1_000_000, flat)
    make_console().print(_costs(release))
    size = sum(shard.bytes for shard in release.shards)
    print(f"{out}: {len(release.scenes)} scenes, {size} bytes in {len(release.shards)} shards")
    print(f"release.json has sha256 {release.sha256}: publish it, and downloads can be pinned with --sha256")
    return 0


def check(folder: Positional[Path]) -> int:
    """Check a release against the limits of Hugging Face, and check every byte of it.

    This checks the counts, sizes and names of files, the dataset card, Croissant, all SHA-256, and that the index lists
    what the tars contain and every file of every scene.

    Args:
        folder: Folder of the release.
    """
    problems = 0
    for line in find_problems(folder):
        print(f"error: {line}", file=sys.stderr)
        problems += 1
    if not problems:
        release = read_release(folder)
        make_console().print(_costs(release))
        print(f"{folder}: good; release.json has sha256 {release.sha256}")
    return 2 if problems else 0


def publish(folder: Positional[Path], *, to: str, dry_run: bool = False) -> int:
    """Check a release and upload it: to Zenodo, to Hugging Face, or to a web server that accepts PUT.

    The token comes from the environment: ZENODO_TOKEN, HF_TOKEN or SPIKE4DGS_UPLOAD_TOKEN. On Zenodo the record stays a
    draft; its DOI is registered when you publish it.

    Args:
        folder: Folder of the release.
        to: zenodo, zenodo-sandbox, hf://datasets/OWNER/NAME, or https://HOST/FOLDER.
        dry_run: Show what would be sent, byte for byte, and send nothing; needs no token.
    """
    problems = list(find_problems(folder))
    for line in problems:
        print(f"error: {line}", file=sys.stderr)
    if problems:
        return 2
    release = read_release(folder)
    upload = plan(folder, release, to)
    for line in upload.lines():
        print(line)
    print(f"{len(upload.files)} files, {upload.bytes} bytes ({size_text(upload.bytes)}), licence {upload.licence}")
    if dry_run:
        print("a dry run: nothing was sent")
        return 0
    address = send(folder, upload, token_of(upload))
    print(f"spike4dgs download all --from {address} --sha256 {release.sha256} --out data")
    return 0


def wheel(folder: Positional[Path], *, out: Path = Path("dist"), version: str = "1.0") -> int:
    """Write a wheel of a small release, so that pip can install its scenes.

    Args:
        folder: Folder of the release.
        out: Folder of the wheel.
        version: Version of the package, numbers with dots.
    """
    path = write_wheel(folder, read_release(folder), out, version)
    package = path.name.partition("-")[0]
    print(f"{path}: {size_text(path.stat().st_size)}, sha256 {sha256_file(path)}")
    print(f'pip install {path}; spike4dgs download all --from "$(python -m {package})" --out data')
    return 0


def fingerprint(scenes: Positional[tuple[Path, ...]], *, out: Path) -> int:
    """Write the fingerprints of scenes, which identify the same scenes made on other processors.

    Args:
        scenes: Scene folders of a release.
        out: Folder of the fingerprints, OUT/SCENE@REVISION.npz.
    """
    for scene in open_scenes(scenes, allow_gaps=True):
        path = out / f"{scene_name(scene.id, scene.revision)}.npz"
        write_fingerprint(path, make_fingerprint(scene))
        print(f"{path}: {size_text(path.stat().st_size)}, sha256 {sha256_file(path)}")
    return 0


def _costs(release: Release) -> Table:
    """Return what each scene costs, by part."""
    parts = list(dict.fromkeys(part for scene in release.scenes.values() for part in scene.parts))
    table = Table(title=f"Release {release.name}", box=None)
    table.add_column("scene")
    for part in [*parts, "all"]:
        table.add_column(part, justify="right")
    for scene in release.scenes.values():
        sizes = [size_text(scene.parts.get(part, 0)) for part in parts]
        table.add_row(scene.id, *sizes, size_text(scene.bytes))
    return table
