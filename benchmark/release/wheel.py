"""A wheel of a release: `pip install` brings its files, and the package tells where they lie.

The wheel is written here, without a build tool: a zip archive in the layout of PEP 427. The same release and zlib give
the same bytes.
"""

from __future__ import annotations

import base64
import hashlib
import re
import zipfile
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.benchmark.release import card, index
from spike4dgs.benchmark.release.index import Release
from spike4dgs.benchmark.release.pack import SUMS
from spike4dgs.benchmark.release.source import size_text

MOST_BYTES = 60_000_000  # PyPI takes 100 MB a file unless it is asked
_VERSION = re.compile(r"[0-9]+(\.[0-9]+)*")  # of PEP 440, its plain form
_EPOCH = (1980, 1, 1, 0, 0, 0)  # a zip archive's first date
_BLOCK = 1 << 20

_MODULE = '''"""The release of Spike4DGS's scenes that this package brings: `python -m {package}` prints its folder."""

from pathlib import Path

FOLDER = Path(__file__).resolve().parent / "release"
'''
_MAIN = """from {package} import FOLDER

print(FOLDER)
"""


def write_wheel(root: Path, release: Release, out: Path, version: str) -> Path:
    """Write OUT/PACKAGE-VERSION-py3-none-any.whl of a release and return it; the package is `spike4dgs_NAME`.

    Raises UserError for a bad version, and where the wheel would have more than MOST_BYTES.
    """
    if not _VERSION.fullmatch(version):
        raise problem("--version", "numbers with dots, such as 1.0", repr(version), "correct it")
    package = f"spike4dgs_{re.sub(r'[^a-z0-9]+', '_', release.name.lower())}"
    about = f"{package}-{version}.dist-info"
    names = [*card.NAMES, SUMS, index.NAME, *(name for s in release.shards for name in (s.file, s.index))]
    texts = {
        f"{package}/__init__.py": _MODULE.format(package=package),
        f"{package}/__main__.py": _MAIN.format(package=package),
        f"{about}/METADATA": _metadata(release, package, version),
        f"{about}/WHEEL": "Wheel-Version: 1.0\nGenerator: spike4dgs\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
    }
    path, records = out / f"{package}-{version}-py3-none-any.whl", []
    with atomic_path(path) as part:
        with zipfile.ZipFile(part, "w") as archive:
            for name in names:
                records.append(_add_file(archive, f"{package}/release/{name}", root / name))
            for name, text in texts.items():
                records.append(_add(archive, name, text.encode()))
            _add(archive, f"{about}/RECORD", "".join([*records, f"{about}/RECORD,,\n"]).encode())
        if (size := part.stat().st_size) > MOST_BYTES:
            expected = f"a wheel of at most {size_text(MOST_BYTES)}"
            raise problem(root, expected, size_text(size), "pack fewer scenes, or publish the release")
    return path


def _metadata(release: Release, package: str, version: str) -> str:
    licences = " AND ".join(sorted({scene.licence for scene in release.scenes.values()}))
    scenes = "".join(f"- {s.id}: {s.title}\n" for s in release.scenes.values())
    return f"""Metadata-Version: 2.1
Name: {package.replace("_", "-")}
Version: {version}
Summary: {card.description(list(release.scenes.values()))}
License: {licences}
Requires-Python: >=3.11
Description-Content-Type: text/markdown

# Spike4DGS, release {release.name}

    spike4dgs download all --from "$(python -m {package})" --out data

unpacks its scenes, and checks every byte:

{scenes}"""


def _info(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, _EPOCH)
    info.compress_type, info.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
    return info


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> str:
    archive.writestr(_info(name), data)
    return _record(name, hashlib.sha256(data).digest(), len(data))


def _add_file(archive: zipfile.ZipFile, name: str, path: Path) -> str:
    digest, size = hashlib.sha256(), path.stat().st_size
    with open(path, "rb") as file, archive.open(_info(name), "w", force_zip64=size >= 1 << 31) as target:
        while block := file.read(_BLOCK):
            digest.update(block)
            target.write(block)
    return _record(name, digest.digest(), size)


def _record(name: str, sha256: bytes, size: int) -> str:
    return f"{name},sha256={base64.urlsafe_b64encode(sha256).decode().rstrip('=')},{size}\n"
