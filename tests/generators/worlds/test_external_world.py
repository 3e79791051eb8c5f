"""A world of another package is found, made, and held to the tests of the worlds; a bad one is one clear error."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest
from packages import install

from spike4dgs.benchmark import plugins
from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.worlds import HARD, OURS, World, Worlds

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of the installed example package, which is on the path."""
    root = tmp_path_factory.mktemp("external")
    source, target = shutil.copytree(ROOT / "examples/external_world", root / "source"), root / "site"
    install(source, target)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(target))
        yield target
    sys.modules.pop("pinwheel_world", None)


def python(installed: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run Python with the package installed."""
    path = os.pathsep.join(filter(None, (str(installed), os.environ.get("PYTHONPATH"))))
    return subprocess.run(
        [sys.executable, *arguments], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, cwd=ROOT
    )


def test_the_world_is_found_beside_our_own(installed: Path) -> None:
    found = Worlds()
    assert list(found) == [*OURS, *HARD, "pinwheel"] and found.all_names == [*OURS, "pinwheel"]
    world = found["pinwheel"].build(0, 0, 0.02)
    assert Path(sys.modules["pinwheel_world"].__file__ or "").parent == installed
    assert world.object_names == ("wheel",)


@pytest.mark.slow
def test_it_passes_the_tests_of_the_worlds(installed: Path) -> None:
    tests = Path(__file__).with_name("test_worlds.py")
    done = python(installed, "-m", "pytest", "-n", "0", "-p", "no:cacheprovider", "-k", "pinwheel", str(tests))
    assert done.returncode == 0, done.stdout + done.stderr
    (passed,) = re.findall(r"(\d+) passed", done.stdout)
    assert int(passed) >= 7, "not without a test"


def test_the_package_may_be_imported_before_the_worlds(installed: Path) -> None:
    """The tests above import it after them."""
    code = "import pinwheel_world; from spike4dgs.generators.worlds import WORLDS; WORLDS['pinwheel']"
    done = python(installed, "-c", code)
    assert done.returncode == 0, done.stderr


class Registered(EntryPoint):
    """An entry point that gives what its test says."""

    def load(self) -> Any:
        return BAD[self.name]


def build(seed: int, variant: int, duration_s: float) -> None: ...


BAD: Mapping[str, Any] = {
    "clash": {"car": World("car", "Another car", build)},
    "other": {"thing": build},
    "renamed": {"one": World("two", "", build)},
    "folders": {"a/b": World("a/b", "", build)},
    "list": [World("one", "", build)],
}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("clash", "entry point clash: expected a new world name, found 'car' twice; rename one of them"),
        ("other", "world 'thing' of entry point other = their:WORLDS: expected a World of spike4dgs.generators.worlds"),
        ("renamed", "world 'one' of entry point renamed = their:WORLDS: expected its own name as the key"),
        ("folders", "expected its own name as the key, of letters, digits and _, found a world named 'a/b'"),
        ("list", "entry point list = their:WORLDS: expected a mapping from world name to world, found list"),
        ("gone", "entry point gone: expected their:WORLDS, found KeyError: 'gone'; repair or uninstall the package"),
    ],
)
def test_what_cannot_be_used_is_one_error(monkeypatch: pytest.MonkeyPatch, name: str, message: str) -> None:
    entry = Registered(name, "their:WORLDS", "spike4dgs.worlds")
    monkeypatch.setattr(plugins, "entry_points", lambda group: [entry])
    with pytest.raises(UserError) as e:
        list(Worlds())
    assert message in str(e.value)
