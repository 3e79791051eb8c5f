"""manifest.json: the size and SHA-256 of every file of a scene. Its own SHA-256 is the dataset revision."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import read_json, sha256_file, write_json

NAME = "manifest.json"
_SCHEMA = "spike4dgs-manifest/1"


@dataclass(frozen=True)
class Manifest:
    """The recorded files of a scene folder; `files` maps a relative path to (bytes, sha256)."""

    root: Path
    files: dict[str, tuple[int, str]]
    revision: str
    _checked: set[str] = field(default_factory=set, repr=False, compare=False)

    def path(self, name: str) -> Path:
        """Return the path of a recorded file after its size and hash were checked (once per process).

        Raises UserError where the file is not recorded, is missing, or differs from its record.
        """
        if name not in self._checked:
            self._check(name)
            self._checked.add(name)
        return self.root / name

    def only(self, prefix: str) -> Manifest:
        """Return the manifest of the files alone whose path begins with `prefix`."""
        return replace(self, files={name: facts for name, facts in self.files.items() if name.startswith(prefix)})

    def problems(self) -> Iterator[str]:
        """Check every recorded file and yield one line for each that is missing or differs."""
        for name in self.files:
            try:
                self._check(name)
            except UserError as e:
                yield str(e)

    def _check(self, name: str) -> None:
        path = self.root / name
        if name not in self.files:
            raise problem(path, f"a file that {NAME} lists", "no entry", "make or import the scene again")
        size, digest = self.files[name]
        if not path.is_file():
            raise problem(path, f"a file of {size} bytes", "no such file", "restore it or make the scene again")
        if (found := path.stat().st_size) != size:
            kind = "truncated" if found < size else "longer"
            raise problem(path, f"{size} bytes", f"{found} bytes ({kind})", "restore it or make the scene again")
        if (actual := sha256_file(path)) != digest:
            fix = "the file was changed or damaged: restore it or make the scene again"
            raise problem(path, f"sha256 {digest[:16]}...", f"{actual[:16]}...", fix)


def write_manifest(root: Path) -> Manifest:
    """Hash every file below `root` (hidden files and the manifest itself excepted) and write manifest.json."""
    files = {}
    for path in sorted(p for p in root.rglob("*") if p.is_file()):
        name = path.relative_to(root).as_posix()
        if name != NAME and not any(part.startswith(".") for part in Path(name).parts):
            files[name] = {"bytes": path.stat().st_size, "sha256": sha256_file(path)}
    write_json(root / NAME, {"schema": _SCHEMA, "files": files})
    return read_manifest(root)


def read_manifest(root: Path) -> Manifest:
    """Read manifest.json. Raises UserError where it is missing or is no manifest."""
    path = root / NAME
    data = read_json(path, "a scene's manifest")
    if data.get("schema") != _SCHEMA:
        raise problem(path, f"schema {_SCHEMA}", repr(data.get("schema")), "use a scene made by this version")
    try:
        files = {str(k): (int(v["bytes"]), str(v["sha256"])) for k, v in data["files"].items()}
    except (KeyError, TypeError, ValueError, AttributeError) as e:
        raise problem(path, "path -> {bytes, sha256}", repr(e), "restore it or make the scene again") from None
    return Manifest(root, files, sha256_file(path))
