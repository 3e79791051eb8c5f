"""Objects that installed packages register by entry points: each names a mapping from name to value."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from spike4dgs.benchmark.errors import problem


@dataclass(frozen=True)
class Plugin:
    """A registered value and the package that it comes from, such as "spike4dgs 0.1.0"."""

    value: Any
    package: str


def find_plugins(
    group: str, kind: str, check: Callable[[str, Any, str], None], taken: Collection[str] = ()
) -> dict[str, Plugin]:
    """Return all that is registered in a group, by name, in the order of the entry points' names.

    `kind` is the word for one of them in errors, `taken` has names that are in use, and `check(name, value, source)`
    raises UserError for a value that cannot be used. Raises UserError where a name is used twice, and where a package
    cannot be imported or names no mapping.
    """
    plugins, fix = dict[str, Plugin](), "repair or uninstall the package that registers it"
    for entry in sorted(entry_points(group=group), key=lambda e: e.name):
        where, source = f"entry point {entry.name}", source_of(entry)
        try:
            found = entry.load()
        except Exception as e:  # somebody else's package
            raise problem(where, entry.value, f"{type(e).__name__}: {e}", fix) from e
        if not isinstance(found, Mapping):
            raise problem(source, f"a mapping from {kind} name to {kind}", type(found).__name__, fix)
        package = f"{entry.dist.name} {entry.dist.version}" if entry.dist else entry.value
        for name, value in found.items():
            if name in plugins or name in taken:
                raise problem(where, f"a new {kind} name", f"'{name}' twice", "rename one of them")
            check(name, value, source)
            plugins[name] = Plugin(value, package)
    return plugins


def is_distributed(group: str, name: str) -> bool:
    """Return whether an installed package registers a name in a group: every process of this Python finds it."""
    return any(entry.dist and name in entry.load() for entry in entry_points(group=group))


def source_of(entry: EntryPoint) -> str:
    """Return the words for an error by which a user finds an entry point."""
    package = f"{entry.dist.name} {entry.dist.version}, " if entry.dist else ""
    return f"{package}entry point {entry.name} = {entry.value}"
