"""The rules of the tree, enforced from the source: who may import whom, between the rooms and inside each of them."""

import ast
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MAY_IMPORT = {
    "benchmark": set(),
    "generators": {"benchmark"},
    "method": {"benchmark"},
    "baselines": {"benchmark", "method"},
    "leaderboard": {"benchmark"},
    "cli": {"benchmark", "generators", "method", "baselines", "leaderboard", "studies"},
    "studies": {"benchmark", "generators", "method", "baselines", "leaderboard"},
}
# The modules and folders of each room, low to high: each imports only those before it.
ORDER = {
    "benchmark": "errors arrays lazy machine plugins variants json_values files compilation schemas untrusted "
    "croissant environment weights screen spikes scene exchange release metrics method runs reports",
    "generators": "physics sensor profiles worlds rig other_sensors recorder rendering msdi_data streams render_tasks "
    "truth held_frames previews scene_maker shared_rendering scene_differences scene_check make_dataset",
    "method": "torch_state two_threads settings splat array_path gaussians training_views motion supervision "
    "pose_refinement schedule models checkpoint msdi images matching image_network starts self_calibration "
    "trainer tuned pace fit recipes viewing recordings",
    "baselines": "nearest_view images radiance_field spike_render exposure starts tracking spacetime recipes",
    "leaderboard": "tracks thumbnails ledger entry reading truth_check rank verify verify_entries refit submit page "
    "season",
    "studies": "kit sensors hard_cases speed_error gpu_receipt images recorder_runs recorder saved_models modality "
    "oracle_truth oracle_methods oracle_ladder faults patterns poses realism spike_agreement scene_noise "
    "second_renderer tuning results",
}
FRONT = ROOT / "front" / "__init__.py"  # what `import spike4dgs` gives; no room
MOST_MODULES = 13  # in a folder; `__init__` does not count
MANY_MODULES = {"cli"}  # one module a command: the listing is the table of commands
MOST_LINES = 300  # in a module
SOURCES = sorted(path for room in MAY_IMPORT for path in (ROOT / room).rglob("*.py"))
FOLDERS = sorted({path.parent for path in SOURCES})


def name_of(path: Path) -> str:
    """Return a module's dotted name without the distribution's, such as "method.splat.cpu"; a folder's for __init__."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {name_of(path): path for path in SOURCES}


@cache
def imported(source: str, package: str) -> list[tuple[int, str, bool]]:
    """Return (line, module, is a string) of every import at any depth, and of every string that names our modules."""
    found: list[tuple[int, str, bool]] = []
    docstrings = set()
    for node in ast.walk(ast.parse(source)):  # parents come first
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            if node.body and isinstance(node.body[0], ast.Expr):
                docstrings.add(id(node.body[0].value))
        elif isinstance(node, ast.Import):
            found += [(node.lineno, alias.name, False) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            base = ".".join(parts[: len(parts) - node.level + 1]) if node.level else ""
            module = ".".join(filter(None, (base, node.module)))
            found += [(node.lineno, f"{module}.{alias.name}", False) for alias in node.names]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            if re.fullmatch(r"spike4dgs(\.\w+)+(:\w+)?", node.value):
                found.append((node.lineno, node.value, True))
    return found


def violations(source: str, package: str) -> list[tuple[int, str]]:
    """Return the imports that the room of `package` may not make, and the strings that name another room."""
    room, wrong = package.split(".")[1], []
    for line, name, is_string in imported(source, package):
        top, *rest = name.split(".")
        allowed = {room} if is_string else MAY_IMPORT[room] | {room}
        if top == "tests" or (
            top == "spike4dgs"
            and (
                not rest
                or rest[0].split(":")[0] in MAY_IMPORT.keys() - allowed
                or (not is_string and rest[0] not in MAY_IMPORT)  # a name of the front
            )
        ):
            wrong.append((line, name))
    return wrong


def package_of(path: Path) -> str:
    return ".".join(("spike4dgs", *path.relative_to(ROOT).parts[:-1]))


def test_no_room_imports_what_it_may_not() -> None:
    found = {path: violations(path.read_text(encoding="utf-8"), package_of(path)) for path in SOURCES}
    assert not {path.relative_to(ROOT).as_posix(): lines for path, lines in found.items() if lines}


@pytest.mark.parametrize(
    ("source", "package", "caught"),
    [
        ("from spike4dgs.method.fit import Parts", "spike4dgs.benchmark", True),
        ("def f():\n    import spike4dgs.generators.profiles", "spike4dgs.method", True),
        ("def f():\n    from spike4dgs import baselines", "spike4dgs.method", True),
        ("from ..method import fit", "spike4dgs.benchmark", True),
        ("from ...method import fit", "spike4dgs.generators.worlds", True),
        ("importlib.import_module('spike4dgs.leaderboard.submit')", "spike4dgs.benchmark", True),
        ("load('spike4dgs.leaderboard.submit:submit')", "spike4dgs.generators", True),
        ("load('spike4dgs.benchmark.files:read_json')", "spike4dgs.cli", True),
        ("load('spike4dgs.cli.score:score')", "spike4dgs.cli", False),
        ("import spike4dgs", "spike4dgs.method", True),
        ("from spike4dgs import open_scene", "spike4dgs.method", True),
        ("from tests.conftest import WIDTH", "spike4dgs.method", True),
        ("from spike4dgs.method.fit import Parts", "spike4dgs.baselines", False),
        ("from .scene import Scene", "spike4dgs.benchmark", False),
        ("from ..car import Car", "spike4dgs.generators.worlds", False),
        ("GROUP = 'spike4dgs.methods'", "spike4dgs.benchmark", False),
        ("'''spike4dgs.method'''", "spike4dgs.benchmark", False),
    ],
)
def test_the_check_itself_catches_what_it_should(source: str, package: str, caught: bool) -> None:
    assert bool(violations(source, package)) == caught


def imports_of(module: str) -> set[str]:
    """Return our modules that a module imports, by their names in MODULES. Strings do not count here."""
    path = MODULES[module]
    found = imported(path.read_text(encoding="utf-8"), package_of(path))
    names = [name for _, name, is_string in found if not is_string and name.startswith("spike4dgs.")]
    ours = [name.removeprefix("spike4dgs.").split(".") for name in names]
    prefixes = ([".".join(parts[:n]) for n in range(len(parts), 0, -1)] for parts in ours)
    return {next(name for name in longest_first if name in MODULES) for longest_first in prefixes}


def arrows(folder: str, imports: Mapping[str, Iterable[str]]) -> dict[tuple[str, str], str]:
    """Return the arrows between the children of a folder: (importing, imported) -> the modules, for the message."""
    found = {}
    for module, targets in imports.items():
        for target in targets:
            if module.startswith(f"{folder}.") and target.startswith(f"{folder}."):
                a, b = (name.removeprefix(f"{folder}.").partition(".")[0] for name in (module, target))
                if a != b:
                    found[a, b] = f"{module} imports {target}"
    return found


def circle(found: Mapping[tuple[str, str], str]) -> list[str]:
    """Return the imports along a circle of arrows, or an empty list."""
    sorter: TopologicalSorter[str] = TopologicalSorter()
    for a, b in found:
        sorter.add(a, b)
    try:
        sorter.prepare()
    except CycleError as e:  # in the order imported, importing
        return [found[b, a] for a, b in zip(e.args[1], e.args[1][1:], strict=False)]
    return []


def upward(found: Mapping[tuple[str, str], str], order: Sequence[str]) -> list[str]:
    """Return the imports that go from a lower child to a higher one."""
    return [text for (a, b), text in found.items() if order.index(a) < order.index(b)]


@cache
def every_import() -> dict[str, set[str]]:
    return {module: imports_of(module) for module in MODULES}


def test_what_a_folder_holds_imports_without_a_circle() -> None:
    for name in (name_of(folder / "__init__.py") for folder in FOLDERS):
        assert not circle(arrows(name, every_import())), name
        inside = [m for m in MODULES if m.startswith(f"{name}.")]
        assert not [m for m in inside if name in every_import()[m]], "a module imports the folder that holds it"


@pytest.mark.parametrize("room", ORDER)
def test_inside_a_room_arrows_go_down(room: str) -> None:
    order = ORDER[room].split()
    children = {m.split(".")[1] for m in MODULES if m.startswith(f"{room}.")}
    assert sorted(order) == sorted(children), "ORDER lists every module and folder of the room"
    assert not upward(arrows(room, every_import()), order)


def test_the_arrows_themselves_are_found() -> None:
    imports = {"r.a": ["r.b.x"], "r.b.x": ["r.b.y"], "r.b.y": ["r.c"], "r.c": []}
    assert set(arrows("r", imports)) == {("a", "b"), ("b", "c")}
    assert set(arrows("r.b", imports)) == {("x", "y")}
    assert not circle(arrows("r", imports)) and not upward(arrows("r", imports), ("c", "b", "a"))
    assert upward(arrows("r", imports), ("b", "c", "a")) == ["r.b.y imports r.c"]
    found = circle(arrows("r", imports | {"r.c": ["r.a"]}))
    assert sorted(found) == ["r.a imports r.b.x", "r.b.y imports r.c", "r.c imports r.a"]
    assert "benchmark.errors" in every_import()["benchmark.files"]
    assert "method.splat" not in every_import()["baselines.recipes"], "a name resolves to the module that it is in"


def test_a_folder_is_small_and_is_a_package() -> None:
    for folder in FOLDERS:
        if name_of(folder / "__init__.py") not in MANY_MODULES:
            assert sum(path.stem != "__init__" for path in folder.glob("*.py")) <= MOST_MODULES, folder
        assert (folder / "__init__.py").is_file()


def test_the_distribution_lists_every_folder_and_none_that_is_gone() -> None:
    packages = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]["packages"]
    folders = [".".join(("spike4dgs", *f.relative_to(ROOT).parts)) for f in FOLDERS]
    assert sorted(packages) == sorted(["spike4dgs", *folders])


def test_no_module_is_too_long() -> None:
    lengths = {name: len(path.read_text(encoding="utf-8").splitlines()) for name, path in MODULES.items()}
    assert not {name: n for name, n in lengths.items() if n > MOST_LINES}


def test_tests_mirror_the_tree() -> None:
    tests = ROOT / "tests"
    folders = {path.parent.relative_to(tests) for path in tests.rglob("test_*.py")} - {Path()}
    assert not [folder.as_posix() for folder in folders if ROOT / folder not in FOLDERS]


def test_every_folder_with_source_is_a_known_room() -> None:
    rooms = {p.parent.relative_to(ROOT).parts[0] for p in ROOT.glob("*/__init__.py")}
    assert rooms == {*MAY_IMPORT, FRONT.parent.name}
    assert not (ROOT / "spike4dgs").exists()


def test_the_front_names_what_the_rooms_have_and_imports_it_late() -> None:
    assert [path.name for path in FRONT.parent.glob("*.py")] == ["__init__.py"]
    tree = ast.parse(FRONT.read_text(encoding="utf-8"))
    at_once = [n.module for n in tree.body if isinstance(n, ast.ImportFrom) and n.module and "spike4dgs" in n.module]
    assert at_once == ["spike4dgs.benchmark.lazy"]
