"""The examples in docstrings run, and give what they say."""

from __future__ import annotations

import doctest
import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("benchmark", "generators", "method", "baselines", "leaderboard")
SOURCES = [p for room in ROOMS for p in sorted((ROOT / room).rglob("*.py"))]
MODULES = [
    ".".join(("spike4dgs", *p.relative_to(ROOT).with_suffix("").parts)).removesuffix(".__init__")
    for p in SOURCES
    if re.search(r"^\s*>>> ", p.read_text(encoding="utf-8"), re.MULTILINE)
]


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_give_what_they_say(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.ELLIPSIS)
    assert result.attempted, f"{name} has a >>> that doctest does not find"
    assert not result.failed
