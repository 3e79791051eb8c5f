"""`leaderboard build` writes a page and says what is not shown."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from spike4dgs.cli import main


def test_a_run_without_its_scenes_gives_a_page_without_images(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(finished / "out", tmp_path / "first")
    given = ["--out", str(tmp_path / "page"), "--runs", str(tmp_path / "first"), "--data", str(tmp_path)]
    assert main(["leaderboard", "build", *given, "--leaderboard", str(tmp_path / "none")]) == 0
    out = capsys.readouterr().out
    assert "left out: no images of pattern-0" in out and str(tmp_path / "page/index.html") in out
    assert (tmp_path / "page/data/boards.js").is_file() and not (tmp_path / "page/pictures").exists()
