"""`methods`: list the installed methods."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from spike4dgs.benchmark.method import Method, Recipe, find_packaged_methods

_PARTS = tuple(f.name for f in fields(Recipe) if f.name not in ("name", "settings"))


def methods() -> int:
    """List the methods of all installed packages: their names, four parts, packages, and what they are.

    A dash stands for a part that a method does not name.
    """
    rows = [("method", *_PARTS, "package", "description")]
    for name, found in find_packaged_methods().items():
        parts = (_part(found.value, part) for part in _PARTS)
        rows.append((name, *parts, found.package, description(found.value)))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip())
    return 0


def description(method: Method) -> str:
    """Return a method's own description, or the first line of its class's docstring."""
    own: str = getattr(method, "description", "") or type(method).__doc__ or ""
    return own.strip().partition("\n")[0]


def _part(method: Method, part: str) -> str:
    found: Any = method.params.get(part)
    return found if isinstance(found, str) else "-"
