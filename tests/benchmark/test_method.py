"""Methods of installed packages, found by entry point."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from dummy_methods import CountMethod

from spike4dgs.benchmark import method as recipes
from spike4dgs.benchmark import plugins
from spike4dgs.benchmark.errors import UserError


def test_a_package_that_cannot_be_imported_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def load() -> None:
        raise ImportError("no libfoo")

    entry = SimpleNamespace(name="theirs", value="theirs.recipes:METHODS", load=load)
    monkeypatch.setattr(plugins, "entry_points", lambda group: [entry])
    with pytest.raises(UserError, match="entry point theirs: expected theirs.recipes:METHODS, found ImportError"):
        recipes.find_methods()


def test_one_name_in_two_packages_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def load() -> dict[str, CountMethod]:
        return {"same": CountMethod("same")}

    entries = [SimpleNamespace(name=n, value=f"{n}:METHODS", dist=None, load=load) for n in "ab"]
    monkeypatch.setattr(plugins, "entry_points", lambda group: entries)
    with pytest.raises(UserError, match="entry point b: expected a new method name, found 'same' twice"):
        recipes.find_methods()
