"""Fixtures of the leaderboard's tests: a finished run, made once, and copies that a test may damage."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from dummy_methods import CountMethod, FailingMethod, run
from small_scenes import write_small_scene
from submissions import enter, release_of

from spike4dgs.benchmark import plugins
from spike4dgs.cli.verify_leaderboard import verify_leaderboard


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes, and a run of two methods and a failing one on them."""
    root = tmp_path_factory.mktemp("finished")
    scenes = [write_small_scene(root / f"s{i}", seed=i) for i in range(2)]
    methods = (CountMethod("tfp+4dgs"), CountMethod("rough", steps=1), FailingMethod("bad", ValueError("no luck")))
    run(root / "out", scenes, *methods)
    return root


@pytest.fixture
def done(finished: Path, tmp_path: Path) -> Path:
    """A copy of the run that a test may damage."""
    return Path(shutil.copytree(finished, tmp_path / "run"))


@pytest.fixture(scope="session")
def entered_once(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    copy = Path(shutil.copytree(finished, tmp_path_factory.mktemp("entered") / "run"))
    enter(copy)
    return copy


@pytest.fixture
def entered(entered_once: Path, tmp_path: Path) -> Path:
    """A copy of the run that a test may damage, with an entry of tfp+4dgs in `board`."""
    return Path(shutil.copytree(entered_once, tmp_path / "run"))


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Callable[[], str]:
    """What has been printed since the last question, errors included."""
    return lambda: "".join(capsys.readouterr())


@pytest.fixture
def released(done: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A release whose tracks have the run's two scenes."""
    release_of(done, monkeypatch)


@pytest.fixture
def problems(capsys: pytest.CaptureFixture[str]) -> Callable[..., list[str]]:
    """What `verify-leaderboard` finds in the board beside a run, line by line."""

    def found(done: Path, **options: Any) -> list[str]:
        capsys.readouterr()
        code = verify_leaderboard(done / "board", **options)
        lines = capsys.readouterr().err.splitlines()
        assert code == (1 if lines else 0)
        return lines

    return found


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """A package that registers the methods of the finished run; a test may put others in their place."""
    methods: dict[str, Any] = {m.name: m for m in (CountMethod("tfp+4dgs"), CountMethod("rough", steps=1))}
    entry = SimpleNamespace(name="theirs", value="theirs:METHODS", dist=None, load=lambda: methods)
    monkeypatch.setattr(plugins, "entry_points", lambda group: [entry])
    return methods
