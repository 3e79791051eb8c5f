"""`methods` lists what is installed."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from dummy_methods import CountMethod

from spike4dgs.baselines.recipes import POSED, RECIPES
from spike4dgs.benchmark import plugins
from spike4dgs.benchmark.method import find_methods
from spike4dgs.cli import main

METHODS = find_methods()


def test_every_installed_method_has_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["methods"]) == 0
    header, *lines = capsys.readouterr().out.splitlines()
    assert header.split() == ["method", "images", "initialization", "motion", "supervision", "package", "description"]
    found = {line.split()[0]: line for line in lines}
    assert len(found) == len(lines) and list(METHODS) == [name for name in found if name in METHODS]
    for recipe in (*RECIPES, *POSED):
        parts = [recipe.images, recipe.initialization, recipe.motion, recipe.supervision]
        assert found[recipe.name].split()[1:6] == [*parts, "spike4dgs"]
        assert METHODS[recipe.name].description in found[recipe.name]
    assert found["nearest-view"].split()[1:5] == ["tfp", "-", "-", "-"]
    assert found["nearest-view"].endswith("the nearest training camera's image, without any reconstruction")


def test_descriptions_tell_methods_apart() -> None:
    texts = [method.description for method in METHODS.values()]
    assert all(texts) and len(set(texts)) == len(texts)
    assert "description" not in METHODS["tfp+4dgs"].params, "words are no part of the key that a run resumes by"


def test_a_method_of_another_package_is_named_with_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    package = SimpleNamespace(name="theirs", version="2.1")
    entry = SimpleNamespace(name="a", value="a:M", dist=package, load=lambda: {"counts": CountMethod()})
    monkeypatch.setattr(plugins, "entry_points", lambda group: [entry])
    assert main(["methods"]) == 0
    (line,) = capsys.readouterr().out.splitlines()[1:]
    assert line.split(maxsplit=7)[:7] == ["counts", "-", "-", "-", "-", "theirs", "2.1"]
    assert line.endswith("Steps towards equal weights of the training views, with a checkpoint after every step.")
