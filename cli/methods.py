"""`methods`: list the installed methods, or describe one with its settings."""

from __future__ import annotations

import ast
import inspect
import textwrap
from dataclasses import fields
from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text
from tyro.conf import Positional

from spike4dgs.benchmark.method import DEFAULT_GIVEN, Method, Recipe, find_packaged_methods, get_method
from spike4dgs.benchmark.reports.console import make_console

_PARTS = tuple(f.name for f in fields(Recipe) if f.name not in ("name", "settings"))


def methods(name: Positional[str | None] = None) -> int:
    """List the methods of all installed packages with their four parts, or describe one with its settings.

    A dash marks a part that a method does not name. A star marks a setting that the recipe changes. `run-benchmark
    --set PART.NAME=VALUE` changes any setting.

    Args:
        name: Method to describe.
    """
    console = make_console()
    if name is not None:
        _describe(console, get_method(name, where="NAME"))
        return 0
    package = None
    headings = (part.replace("initialization", "initial-\nization") for part in _PARTS)  # names fit 80 characters
    table = Table("method", *headings, box=None, padding=(0, 0, 0, 1), pad_edge=False)
    for column in table.columns:
        column.no_wrap = True
    for shown, found in find_packaged_methods().items():
        if found.package != package:
            package = found.package
            table.add_row(Text(package, style="italic"))
        table.add_row(Text(shown), *(_part(found.value, part) for part in _PARTS))
    console.print(table)
    console.print("`spike4dgs methods NAME` describes one and lists its settings", markup=False)
    return 0


def description(method: Method) -> str:
    """Return a method's own description, or the first line of its class's docstring."""
    own: str = getattr(method, "description", "") or type(method).__doc__ or ""
    return own.strip().partition("\n")[0]


def reasons(settings: type) -> dict[str, str]:
    """Return the comments that stand beside the fields of a dataclass in its source, by field; its bases' too."""
    found: dict[str, str] = {}
    for cls in reversed(settings.__mro__[:-1]):
        lines = textwrap.dedent(inspect.getsource(cls)).splitlines()
        for node in ast.parse("\n".join(lines)).body[0].body:  # type: ignore[attr-defined]
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                code = lines[node.lineno - 1 : node.end_lineno]
                found[node.target.id] = code[-1][node.end_col_offset or 0 :].strip().removeprefix("#").strip()
    return found


def _part(method: Method, part: str) -> str:
    found: Any = method.params.get(part)
    return found if isinstance(found, str) else "-"


def _describe(console: Console, method: Method) -> None:
    """Print a method's description, parts, what it is given, and its settings with their reasons."""
    given = getattr(method, "given", DEFAULT_GIVEN)
    console.print(f"{method.name}: {description(method)}", markup=False)
    console.print(", ".join(f"{part} {_part(method, part)}" for part in _PARTS), markup=False)
    console.print(f"given beside streams, clock and intrinsics: {', '.join(given) or 'nothing'}", markup=False)
    settings: Any = getattr(method, "settings", None)
    if not isinstance(settings, dict):
        return
    changed = set(getattr(method, "recipe", Recipe("", "", "", "", "")).settings)
    table = Table("setting", "value", "why", box=None, padding=(0, 0, 0, 1), pad_edge=False)
    table.columns[0].no_wrap = table.columns[1].no_wrap = True
    for part, values in settings.items():
        why = reasons(type(values))
        for field in fields(values):
            dotted = f"{part}.{field.name}"
            value = getattr(values, field.name)
            shown = f"{value:.6g}" if isinstance(value, float) else str(value)
            table.add_row(dotted, f"{shown}{' *' if dotted in changed else ''}", Text(why.get(field.name, "")))
    console.print(table)
    console.print("* the recipe's own; others are the part's defaults", markup=False)
