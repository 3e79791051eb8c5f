"""Fixtures of the seasons' tests: a season that was made once, and copies that a test may damage."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from dummy_methods import CountMethod
from fake_renderer import render_fakes
from made_season import NUMBER, WORLDS, Made

from spike4dgs.cli.season import make


@pytest.fixture(scope="session")
def once(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """A season that is made, and not scored; no test changes it."""
    made = Made(tmp_path_factory.mktemp("season"))
    with pytest.MonkeyPatch.context() as patch:
        render_fakes(patch)
        given = {"worlds": WORLDS, "profile": "tiny", "budget": "0.02", "rendering": "paths"}  # split has no fake
        assert make(NUMBER, secret=made.secret, seasons=made.seasons, **given) == 0
    made.predict(CountMethod("counts"), CountMethod("rough", steps=1))
    return made


@pytest.fixture
def made(once: Made, tmp_path: Path) -> Made:
    """A copy of a season that is made, and not scored."""
    return Made(Path(shutil.copytree(once.root, tmp_path / "copy")))


@pytest.fixture(scope="session")
def scored_once(once: Made, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """A season with two results; no test changes it."""
    copy = Made(Path(shutil.copytree(once.root, tmp_path_factory.mktemp("scored") / "copy")))
    assert copy.score("counts", "rough") == 0
    return copy


@pytest.fixture
def scored(scored_once: Made, tmp_path: Path) -> Made:
    """A copy of a season with two results."""
    return Made(Path(shutil.copytree(scored_once.root, tmp_path / "copy")))
