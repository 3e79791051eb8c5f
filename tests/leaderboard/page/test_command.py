"""The ranking in the terminal."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from spike4dgs.cli import main

COMMITTED = Path(__file__).resolve().parents[3] / "leaderboard"


def test_the_ranking_has_intervals_ties_and_reasons(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["leaderboard", "--track", "outdoor-small", "--leaderboard", str(COMMITTED)]) == 0
    out = capsys.readouterr().out
    lines = [line.split() for line in out.splitlines()]
    (first,) = (line for line in lines if "spike4dgs-x" in line[:2])
    assert first[:3] == ["1-2", "spike4dgs-x", "41.98"], "not told apart from spike4dgs on five scenes"
    (last,) = (line for line in lines if "dy-spikenerf" in line[:2])
    assert last[:3] == ["13", "dy-spikenerf", "22.23"]


def test_own_runs_stand_beside_and_failures_have_a_reason(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["leaderboard", "--leaderboard", str(tmp_path / "none"), "--runs", str(finished / "out")]) == 0
    out = capsys.readouterr().out
    assert "out/tfp+4dgs" in out and "pattern-0 failed" in out


def test_unknown_names_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["leaderboard", "--metric", "nothing", "--leaderboard", str(COMMITTED)]) == 2
    assert "psnr_dynamic" in capsys.readouterr().err


def test_a_run_without_its_scenes_gives_a_page_without_images(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.copytree(finished / "out", tmp_path / "first")
    given = ["--out", str(tmp_path / "page"), "--runs", str(tmp_path / "first"), "--data", str(tmp_path)]
    assert main(["leaderboard", "build", *given, "--leaderboard", str(tmp_path / "none")]) == 0
    out = capsys.readouterr().out
    assert "left out: no images of pattern-0" in out and str(tmp_path / "page/index.html") in out
    assert (tmp_path / "page/data/boards.js").is_file() and not (tmp_path / "page/pictures").exists()
