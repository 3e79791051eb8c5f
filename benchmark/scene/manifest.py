"""manifest.json: the size and SHA-256 of every file of a scene, and the hash of the content of encoded data.

The hashes of contents make the revision without a file being decoded, or even there. Whoever reads a file checks its
bytes and, by decoding them, its content: what is fitted and scored is what the revision was made of.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import read_json, sha256_file, write_json
from spike4dgs.benchmark.scene.content import data_files, hash_content, is_encoded
from spike4dgs.benchmark.screen.shown import Shown
from spike4dgs.benchmark.spikes.folder import NAME as STREAMS
from spike4dgs.benchmark.untrusted import matches

NAME = "manifest.json"
_NAMED = 4  # scenes that a message names
_SCHEMA = "spike4dgs-manifest/1"


@dataclass(frozen=True, repr=False)
class Manifest(Shown):
    """The recorded files of a scene folder.

    `files` maps a relative path to (bytes, sha256), `recorded` the path of encoded data to the hash of its content, as
    far as manifest.json has it.
    """

    root: Path
    files: dict[str, tuple[int, str]]
    recorded: dict[str, str] = field(default_factory=dict)
    _checked: set[str] = field(default_factory=set, repr=False, compare=False)
    _decoded: set[str] = field(default_factory=set, repr=False, compare=False)

    def _about(self) -> str:
        return f"of {self.root.name[:100]}: {len(self.files)} files"

    def path(self, name: str) -> Path:
        """Return the path of a recorded file after its size, hash and content were checked (once per process).

        Raises UserError where the file is not recorded, is missing, or differs from its record.
        """
        if name not in self._checked:
            self._check(name)
            self._checked.add(name)
        if name not in self._decoded and name in self.recorded and is_encoded(name):
            self._check_content(name)
            self._decoded.add(name)
        return self.root / name

    def only(self, prefix: str) -> Manifest:
        """Return the manifest of the files alone whose path begins with `prefix`."""
        return replace(self, files={name: facts for name, facts in self.files.items() if name.startswith(prefix)})

    def contents(self, meta: Mapping[str, Any]) -> dict[str, str]:
        """Return the hash of the content of each file that is fitted or scored, by its key. `meta`: scene.json.

        Files without a recorded hash are decoded. A stream that is not recorded is left out, as a held-out camera's may
        be. Raises UserError where a file to decode is missing or damaged.
        """
        found = {}
        for key, name in data_files(self.files, meta["streams"]).items():
            if is_encoded(name):
                found[key] = self.recorded.get(name) or hash_content(self.path(name), name, meta)
            elif name in self.files:
                found[key] = self.files[name][1]
        return found

    def problems(self) -> Iterator[str]:
        """Check the bytes of every recorded file and yield one line for each that is missing or differs."""
        for name in self.files:
            try:
                self._check(name)
                self._checked.add(name)
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

    def _check_content(self, name: str) -> None:
        recorded, path = self.recorded[name], self.root / name
        if (found := hash_content(path, name, _scene_json(self.root))) != recorded:
            fix = "the manifest claims another content: restore the scene or make it again"
            raise problem(path, f"content {recorded[:16]}...", f"{found[:16]}...", fix)


def write_manifest(root: Path, known: Manifest | None = None) -> Manifest:
    """Hash every file below `root` (hidden files and the manifest itself excepted) and write manifest.json.

    The hashes of files that were checked already may be `known`.
    """
    meta = _scene_json(root)
    files: dict[str, dict[str, Any]] = {}
    for path in sorted(p for p in root.rglob("*") if p.is_file()):
        name = path.relative_to(root).as_posix()
        if known and name in known.files:
            files[name] = dict(zip(("bytes", "sha256"), known.files[name], strict=True))
            files[name] |= {"content": known.recorded[name]} if name in known.recorded else {}
        elif name != NAME and not any(part.startswith(".") for part in Path(name).parts):
            files[name] = {"bytes": path.stat().st_size, "sha256": sha256_file(path)}
            if is_encoded(name) and (content := _content(path, name, meta)):
                files[name]["content"] = content
    write_json(root / NAME, {"schema": _SCHEMA, "files": files})
    return read_manifest(root)


def _scene_json(root: Path) -> dict[str, Any]:
    """Return scene.json, {} where it is missing or damaged: whoever opens the scene says so."""
    try:
        return read_json(root / "scene.json", "a scene")
    except UserError:
        return {}


def _content(path: Path, name: str, meta: Mapping[str, Any]) -> str | None:
    """Return the hash of a file's content; None where the file or scene.json is damaged, which its reader reports."""
    try:
        return hash_content(path, name, meta)
    except (UserError, KeyError, TypeError, ValueError):
        return None


def check_scene_folder(root: Path) -> None:
    """Raise UserError for what is no scene folder, with what it is and what reads it."""
    if (root / "scene.json").is_file():
        return
    expected, scenes = "a scene folder", sorted(path.parent.name for path in root.glob("*/scene.json"))
    if not root.exists():
        raise problem(root, expected, "no such folder", "make one with `spike4dgs make-dataset`")
    if not root.is_dir():
        raise problem(root, expected, "a file", "name its folder")
    if (root / STREAMS).is_file():
        fix = "`fit`, `inspect` and `images` read it; `import-dat --cameras` makes a scene"
        raise problem(root, expected, "a folder of streams without poses", fix)
    if scenes:
        more = ", ..." if len(scenes) > _NAMED else ""
        raise problem(root, expected, f"a folder of the scenes {', '.join(scenes[:_NAMED])}{more}", "name one")
    if any(root.glob("*.dat")):
        raise problem(root, expected, "bare streams", "import them with `spike4dgs import-dat`")
    raise problem(root / "scene.json", "the description of a scene", "no such file", "check the path")


def read_manifest(root: Path) -> Manifest:
    """Read manifest.json. Raises UserError where it is missing or is no manifest."""
    path = root / NAME
    data = read_json(path, "a scene's manifest")
    if data.get("schema") != _SCHEMA:
        raise problem(path, f"schema {_SCHEMA}", repr(data.get("schema")), "use a scene made by this version")
    try:
        files = {str(k): (int(v["bytes"]), str(v["sha256"])) for k, v in data["files"].items()}
        recorded = {str(k): str(v["content"]) for k, v in data["files"].items() if "content" in v}
    except (KeyError, TypeError, ValueError, AttributeError) as e:
        raise problem(path, "path -> {bytes, sha256}", repr(e), "restore it or make the scene again") from None
    for name in files:
        if not matches("path", name):
            raise problem(path, "paths inside the scene folder", repr(name), "do not use this scene")
    for name, digest in recorded.items():
        if not matches("sha256", digest):
            raise problem(path, f"64 hex digits as the content of {name}", repr(digest), "restore the file")
    return Manifest(root, files, recorded)
