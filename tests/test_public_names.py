"""The public names of the rooms: each is found, and none is imported before it is used."""

import ast
import importlib
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("benchmark", "generators", "method", "baselines", "leaderboard")
HEAVY = ("torch", "mitsuba", "numba", "numpy", "scipy", "skimage", "cv2", "matplotlib", "pandas", "rich", "tyro")


@pytest.mark.parametrize("room", ROOMS)
def test_every_public_name_is_there_once_and_hides_no_module(room: str) -> None:
    package = importlib.import_module(f"spike4dgs.{room}")
    assert len(package.__all__) == len(set(package.__all__))
    assert set(package.__all__) <= set(dir(package))
    modules = {path.stem for path in (ROOT / room).glob("*.py")} | {p.parent.name for p in (ROOT / room).glob("*/*.py")}
    assert not set(package.__all__) & modules, "the module would take the name's place once it is imported"
    for name in package.__all__:
        assert getattr(package, name) is not None


@pytest.mark.parametrize("room", [*ROOMS, "front"])
def test_type_checkers_and_the_interpreter_see_the_same_names(room: str) -> None:
    tree = ast.parse((ROOT / room / "__init__.py").read_text(encoding="utf-8"))
    package = "spike4dgs" if room == "front" else f"spike4dgs.{room}"
    (branch,) = [node for node in tree.body if isinstance(node, ast.If) and node.orelse]
    typed = {(n.module, a.name) for n in branch.body if isinstance(n, ast.ImportFrom) for a in n.names}
    (names,) = [ast.literal_eval(n) for n in ast.walk(branch.orelse[0]) if isinstance(n, ast.Dict)]
    lazy = {(f"{package}.{module}", name) for module, of_module in names.items() for name in of_module}
    assert typed == lazy
    assert {name for _, name in lazy} == set(importlib.import_module(package).__all__)


def test_the_front_has_the_names_of_everyday_work() -> None:
    package = importlib.import_module("spike4dgs")
    wanted = "open_scene open_stream load_model find_methods score_image make_image read_record write_predictions"
    assert set(wanted.split()) <= set(package.__all__)
    assert {*package.__all__, *ROOMS, "__version__"} <= set(dir(package))
    assert package.__version__ == version("spike4dgs") and (package.__doc__ or "").startswith("Spike4DGS")
    assert all(callable(getattr(package, name)) for name in package.__all__)
    assert [getattr(package, room).__name__ for room in ROOMS] == [f"spike4dgs.{room}" for room in ROOMS]
    with pytest.raises(AttributeError, match="module 'spike4dgs' has no attribute 'nonsense'"):
        package.nonsense  # noqa: B018


def test_importing_the_rooms_imports_nothing_heavy() -> None:
    rooms = ", ".join(f"spike4dgs.{room}" for room in ROOMS)
    code = f"import sys, {rooms}; print([m for m in {HEAVY!r} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


def test_opening_a_scene_needs_no_torch_and_no_mitsuba() -> None:
    code = "import sys; from spike4dgs.benchmark import open_scene; print({'torch', 'mitsuba'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "set()", done.stdout + done.stderr
