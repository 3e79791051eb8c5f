"""The import rule of the rooms, enforced from the source: who may import whom."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MAY_IMPORT = {
    "benchmark": set(),
    "generators": {"benchmark"},
    "method": {"benchmark"},
    "baselines": {"benchmark", "method"},
    "leaderboard": {"benchmark"},
}
# The command line's table of import strings is the one place that names all rooms.
COMPOSITION_ROOT = "benchmark/cli.py"
SOURCES = sorted(path for room in MAY_IMPORT for path in (ROOT / room).rglob("*.py"))


def imported(source: str, package: str) -> Iterator[tuple[int, str]]:
    """(line, module) of every import at any depth, and of every string that names one of our modules."""
    tree = ast.parse(source)
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            base = ".".join(parts[: len(parts) - node.level + 1]) if node.level else ""
            module = ".".join(filter(None, (base, node.module)))
            yield from ((node.lineno, f"{module}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            if re.fullmatch(r"spike4dgs(\.\w+)+(:\w+)?", node.value):
                yield node.lineno, node.value


def violations(source: str, package: str) -> list[tuple[int, str]]:
    """Imports that the room of `package` may not make."""
    room = package.split(".")[1]
    allowed = MAY_IMPORT[room] | {room}
    ours = [
        (line, m, m.split(".")) for line, m in imported(source, package) if m.split(".")[0] in ("spike4dgs", "tests")
    ]
    return [
        (line, module)
        for line, module, parts in ours
        if parts[0] == "tests" or len(parts) < 2 or parts[1].split(":")[0] in MAY_IMPORT.keys() - allowed
    ]


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_no_room_imports_what_it_may_not(path: Path) -> None:
    name = path.relative_to(ROOT).as_posix()
    if name != COMPOSITION_ROOT:
        package = ".".join(("spike4dgs", *path.relative_to(ROOT).parts[:-1]))
        assert not violations(path.read_text(encoding="utf-8"), package), name


def test_the_command_line_itself_imports_only_its_own_room() -> None:
    tree = ast.parse((ROOT / COMPOSITION_ROOT).read_text(encoding="utf-8"))
    modules = [n.module or "" for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    assert [m for m in modules if m.startswith("spike4dgs")] == ["spike4dgs.benchmark.errors"]


@pytest.mark.parametrize(
    ("source", "package", "caught"),
    [
        ("from spike4dgs.method.fit import Parts", "spike4dgs.benchmark", True),
        ("def f():\n    import spike4dgs.generators.rig", "spike4dgs.method", True),
        ("def f():\n    from spike4dgs import baselines", "spike4dgs.method", True),
        ("from ..method import fit", "spike4dgs.benchmark", True),
        ("from ...method import fit", "spike4dgs.generators.worlds", True),
        ("importlib.import_module('spike4dgs.leaderboard.submit')", "spike4dgs.benchmark", True),
        ("load('spike4dgs.leaderboard.submit:submit')", "spike4dgs.generators", True),
        ("import spike4dgs", "spike4dgs.method", True),
        ("from tests.conftest import WIDTH", "spike4dgs.method", True),
        ("from spike4dgs.method.fit import Parts", "spike4dgs.baselines", False),
        ("from .scene import Scene", "spike4dgs.benchmark", False),
        ("from ..car import Car", "spike4dgs.generators.worlds", False),
        ("GROUP = 'spike4dgs.methods'", "spike4dgs.benchmark", False),
        ("'''spike4dgs.method'''", "spike4dgs.benchmark", False),
    ],
)
def test_the_check_itself_sees_what_it_should(source: str, package: str, caught: bool) -> None:
    assert bool(violations(source, package)) == caught


def test_every_folder_with_source_is_a_known_room() -> None:
    rooms = {p.parent.relative_to(ROOT).parts[0] for p in ROOT.glob("*/__init__.py")}
    assert rooms == set(MAY_IMPORT)
    assert not (ROOT / "spike4dgs").exists()
