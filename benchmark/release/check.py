"""Check a release before it is uploaded: the limits of Hugging Face, and every byte against the index.

The limits are those of https://huggingface.co/docs/hub/storage-limits, "Repository limitations and recommendations";
the card's form is that of https://huggingface.co/docs/hub/datasets-cards.
"""

from __future__ import annotations

import json
import logging
import re
import tarfile
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

from spike4dgs.benchmark import croissant
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import sha256_file
from spike4dgs.benchmark.json_values.text import parse_json
from spike4dgs.benchmark.release import card, index
from spike4dgs.benchmark.release.index import Release, parse_shard, read_release
from spike4dgs.benchmark.release.pack import SUMS
from spike4dgs.benchmark.release.source import ByteProgress
from spike4dgs.benchmark.scene import manifest
from spike4dgs.benchmark.untrusted import parse_yaml

MOST_FILES = 100_000  # of a repository
MOST_ENTRIES = 10_000  # of a folder
MOST_BYTES = 20_000_000_000  # of a file, as recommended; the hard limit is 50 GB
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")  # of a file or folder: the same on every system, and in addresses


def find_problems(root: Path) -> Iterator[str]:
    """Yield one line for each fault of a release. Raises UserError where it has no readable release.json."""
    release = read_release(root)
    files = sorted(p for p in root.rglob("*") if p.is_file())
    yield from _limits(root, files)
    yield from _card(root)
    yield from _croissant(root)
    sums = _read_sums(root)
    names = {path.relative_to(root).as_posix() for path in files} - {SUMS}
    needed = {index.NAME, *card.NAMES, *(n for s in release.shards for n in (s.file, s.index))}
    for name in sorted(needed - names):
        yield f"{root / name}: missing"
    for name in sorted(names ^ set(sums)):
        yield f"{root / SUMS}: lists not just the files that are there: {name}"
    with ByteProgress("checking", sum((root / name).stat().st_size for name in names)) as progress:
        for name in sorted(names & set(sums)):
            if sha256_file(root / name) != sums[name]:
                yield f"{root / name}: expected sha256 {sums[name]}, found another"
            progress.advance((root / name).stat().st_size)
    yield from _contents(root, release, sums)


def _limits(root: Path, files: list[Path]) -> Iterator[str]:
    if len(files) > MOST_FILES:
        yield f"{root}: {len(files)} files, more than {MOST_FILES}"
    folders = Counter(path.parent for path in files)
    folders.update(p.parent for p in root.rglob("*") if p.is_dir())
    for folder, entries in sorted(folders.items()):
        if entries > MOST_ENTRIES:
            yield f"{folder}: {entries} entries, more than {MOST_ENTRIES}"
    for path in files:
        if (size := path.stat().st_size) > MOST_BYTES:
            yield f"{path}: {size} bytes, more than {MOST_BYTES}"
        if not all(_NAME.fullmatch(part) for part in path.relative_to(root).parts):
            yield f"{path}: a name of other characters than letters, digits, dots, dashes and underscores"


def _card(root: Path) -> Iterator[str]:
    """The dataset card begins with YAML between two lines of dashes, and has a licence."""
    path = root / card.README
    try:
        parts = path.read_text(encoding="utf-8").split("---\n", 2) if path.is_file() else []
        facts = parse_yaml(parts[1]) if len(parts) == 3 and not parts[0] else None
    except ValueError as e:
        yield f"{path}: damaged YAML ({' '.join(str(e).split())[:100]})"
        return
    if not isinstance(facts, dict) or not facts.get("license"):
        yield f"{path}: no dataset card, which begins with YAML between lines of three dashes and has a license"


def _croissant(root: Path) -> Iterator[str]:
    """Croissant is checked by mlcroissant where it is installed, else only for being JSON, which is then said."""
    path = root / croissant.NAME
    if not path.is_file():
        return
    try:
        parse_json(path.read_text(encoding="utf-8"))
    except ValueError as e:
        yield f"{path}: damaged text ({e})"
        return
    try:
        import mlcroissant
    except ImportError:
        print("Croissant: not validated, needs `pip install mlcroissant`")
        return
    logging.getLogger("absl").setLevel(logging.ERROR)  # it recommends facts that only who publishes knows
    try:
        mlcroissant.Dataset(jsonld=str(path))
    except mlcroissant.ValidationError as e:
        yield f"{path}: not valid: {' '.join(str(e).split())[:200]}"


def _read_sums(root: Path) -> dict[str, str]:
    path = root / SUMS
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines() if path.is_file() else []
    return {name: digest for digest, _, name in (line.partition("  ") for line in lines)}


def _contents(root: Path, release: Release, sums: Mapping[str, str]) -> Iterator[str]:
    """Compare release.json, the lists of the shards, the tars' own headers, and the scenes' manifests."""
    listed: dict[str, dict[str, tuple[int, str]]] = {scene: {} for scene in release.scenes}
    manifests: dict[str, bytes] = {}
    for shard in release.shards:
        if (sums.get(shard.file), sums.get(shard.index)) != (shard.sha256, shard.index_sha256):
            yield f"{root / index.NAME}: other hashes of {shard.file} or its list than {SUMS}"
        try:
            members = parse_shard((root / shard.index).read_bytes(), shard, str(root / shard.index))
            with tarfile.open(root / shard.file, "r:") as tar:
                found = {(m.name, m.offset_data, m.size) for m in tar}
        except (UserError, OSError, tarfile.TarError) as e:
            yield str(e) if isinstance(e, UserError) else f"{root / shard.file}: {e}"
            continue
        for name, _, _ in sorted(found ^ {(m.name, m.offset, m.bytes) for m in members}):
            yield f"{root / shard.index}: {name} is another one in the tar"
        for member in members:
            listed.setdefault(member.scene, {})[member.path] = (member.bytes, member.sha256)
            if member.path == manifest.NAME:
                with open(root / shard.file, "rb") as file:
                    file.seek(member.offset)
                    manifests[member.scene] = file.read(member.bytes)
    for scene, files in listed.items():
        yield from _scene(root, release, scene, files, manifests.get(scene, b""))


def _scene(
    root: Path, release: Release, scene: str, files: Mapping[str, tuple[int, str]], text: bytes
) -> Iterator[str]:
    """Compare the files that the lists have of a scene with its manifest, and their sizes with release.json."""
    try:
        recorded = {path: (f["bytes"], f["sha256"]) for path, f in json.loads(text)["files"].items()}
    except (ValueError, KeyError, TypeError, AttributeError):
        yield f"{root}: {scene} has no readable {manifest.NAME}"
        return
    for path in sorted(files.keys() | recorded.keys()):
        if path != manifest.NAME and files.get(path) != recorded.get(path):
            yield f"{root}: {scene}/{path} is not as its manifest lists it"
    size = sum(n for n, _ in files.values())
    if scene not in release.scenes or release.scenes[scene].bytes != size:
        yield f"{root / index.NAME}: not the {size} bytes of {scene} that the shards hold"
