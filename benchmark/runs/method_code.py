"""The code of methods, by whose hash a run notices that it changed."""

from __future__ import annotations

import hashlib
import inspect
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from spike4dgs.benchmark.errors import problem

_LIBRARIES = {*sys.stdlib_module_names, "spike4dgs", "numpy", "torch"}  # no method is written in these packages
_MOST_FILES = 5000


def code_of(method: Any) -> dict[str, str]:
    """Return the SHA-256 of the Python sources of each package that a method comes from, by the package's name.

    These are the packages of its class, of the bases of this, and of its attributes; `spike4dgs` itself is not among
    them: the version stands for it. Raises UserError for a package of more than 5000 files.
    """
    classes = [*type(method).__mro__, *(type(value) for value in getattr(method, "__dict__", {}).values())]
    found: dict[str, str] = {}
    for cls in classes:
        package = cls.__module__.partition(".")[0]
        if package not in _LIBRARIES and package not in found:
            found[_name(package)] = _sha256(package, cls)
    return dict(sorted(found.items()))


def sources_sha256(packages: Sequence[ModuleType]) -> str:
    """Return the SHA-256 of the Python sources of packages, with their names."""
    digest = hashlib.sha256()
    for package in packages:
        _add_files(digest, sorted(_files(package)), f"{package.__name__}/")
    return digest.hexdigest()


def _name(package: str) -> str:
    """Return a package's name, and that of the file for a program that was started."""
    file = getattr(sys.modules.get(package), "__file__", None)
    return Path(file).stem if package == "__main__" and file else package


def _sha256(package: str, cls: type) -> str:
    """Return the hash of a package's sources; of the class alone where the package has no files, as in a notebook."""
    digest = hashlib.sha256()
    module = sys.modules.get(package)
    files = sorted(_files(module)) if module else []
    _add_files(digest, files)
    if not files:
        try:
            digest.update(inspect.getsource(cls).encode())
        except (OSError, TypeError):  # compiled, or typed in
            digest.update(cls.__qualname__.encode())
    return digest.hexdigest()


def _add_files(digest: Any, files: Sequence[tuple[str, Path]], prefix: str = "") -> None:
    for name, path in files:
        digest.update(f"{prefix}{name}\0".encode())
        digest.update(path.read_bytes())


def _files(module: ModuleType) -> Iterator[tuple[str, Path]]:
    """Yield the sources of a module or a package, with their names in it."""
    if not (roots := list(getattr(module, "__path__", []))):
        if (file := getattr(module, "__file__", None)) and Path(file).is_file():
            yield Path(file).name, Path(file)
        return
    for root in map(Path, roots):
        for count, path in enumerate(root.rglob("*.py")):
            if count >= _MOST_FILES:
                fix = "move the method into a package of its own"
                raise problem(root, f"a method's package of at most {_MOST_FILES} files", "more", fix)
            if path.is_file() and not path.name.startswith("."):  # editors keep links of locks
                yield path.relative_to(root).as_posix(), path
