"""The ranking in the terminal."""

from __future__ import annotations

import io
import shutil
from pathlib import Path

import numpy as np
import pytest
from page_boards import board, cell, failed, row
from rich.console import Console

from spike4dgs.benchmark.files import read_json, sha256_json, write_json
from spike4dgs.cli import main
from spike4dgs.cli.leaderboard import ranking_table
from spike4dgs.cli.submit import submit
from spike4dgs.leaderboard.ledger import add_line
from spike4dgs.leaderboard.page import rows
from spike4dgs.leaderboard.page.rows import find_board, gather
from spike4dgs.leaderboard.page.scores import compare_rows, image_scores
from spike4dgs.leaderboard.tracks import SHIPPED

COMMITTED = Path(__file__).resolve().parents[3] / "leaderboard"


def test_the_ranking_has_intervals_ties_and_reasons(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["leaderboard", "--track", "ideal", "--leaderboard", str(COMMITTED)]) == 0
    out = capsys.readouterr().out
    lines = [line.split() for line in out.splitlines()]
    (first,) = (line for line in lines if "spike4dgs-x" in line[:2])
    assert first[:3] == ["1-4", "spike4dgs-x", "42.68"], "not told apart from its tuned twin on nine scenes"
    (last,) = (line for line in lines if "spikeclip+stg" in line[:2])
    assert last[:3] == ["23-24", "spikeclip+stg", "21.38"]


def test_own_runs_stand_beside_and_failures_have_a_reason(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["leaderboard", "--runs", str(finished / "out")]) == 0
    out = capsys.readouterr().out
    assert "out/tfp+4dgs" in out and "pattern-0 failed" in out and "ideal" in out and "no record" not in out
    assert main(["leaderboard", "--track", "ideal", "--runs", str(finished / "out")]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "/out: no record of exactly the scenes of ideal, given what it gives; it is on the board pattern-0" in out


def test_an_empty_folder_has_the_published_entries(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["leaderboard"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("published entries of release 2") and "42.68" in out
    assert main(["leaderboard", "--track", "paper"]) == 2
    assert "a track with entries, found paper, which has none yet; choose one of ideal" in capsys.readouterr().err
    assert main(["leaderboard", "--track", "outdor"]) == 2
    assert "expected one of ideal, no-flat-field, " in capsys.readouterr().err


def test_a_leaderboard_that_does_not_exist_or_is_empty_is_no_success(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["leaderboard", "--leaderboard", str(tmp_path / "none")]) == 2
    assert "a leaderboard with entries, found no such folder" in capsys.readouterr().err
    assert main(["leaderboard", "--leaderboard", str(tmp_path)]) == 2
    assert "found none; `run-benchmark` writes one" in capsys.readouterr().err


@pytest.fixture
def few(tmp_path: Path) -> Path:
    """A copy of the published entries of one track."""
    (folder,) = COMMITTED.glob("entries/2-quick-start@*")
    shutil.copytree(folder, tmp_path / "few/entries" / folder.name)
    shutil.copy(COMMITTED / "LEDGER", tmp_path / "few")
    return tmp_path / "few"


def test_entries_of_ones_own_stand_among_the_published_ones(few: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A copy of the published entries without one method, and with another record of a second."""
    (removed,) = few.glob("entries/*/tfi+4dgs.json")
    published = read_json(removed, "an entry")["record"]["mean"]["psnr"]
    removed.unlink()
    path = removed.with_name("tfp+4dgs.json")
    entry = read_json(path, "an entry") | {"submitted": "2031-01-01T00:00:00Z"}
    write_json(path, entry)
    add_line(few, sha256_json(entry), path.relative_to(few).as_posix())
    assert main(["leaderboard", "--track", "quick-start", "--leaderboard", str(few)]) == 0
    names = [line.split()[1:3] for line in capsys.readouterr().out.splitlines()[2:]]
    assert ["tfp+4dgs", "(published)"] in names and ["tfi+4dgs", f"{published:.2f}"] in names
    assert sum(name[:1] == ["tfp+4dgs"] for name in names) == 2 and sum(n[:1] == ["spike4dgs-x"] for n in names) == 1


def test_unknown_names_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["leaderboard", "--metric", "psnr_dynamc", "--leaderboard", str(COMMITTED)]) == 2
    assert "did you mean 'psnr_dynamic'" in capsys.readouterr().err


def test_a_run_without_its_scenes_gives_a_page_without_images(
    finished: Path, few: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside published entries, few for the sake of time."""
    monkeypatch.setattr(rows, "SHIPPED", few)
    assert submit(finished / "out/results/rough.json", leaderboard=tmp_path / "own") == 0
    shutil.copytree(finished / "out", tmp_path / "first")
    given = ["--out", str(tmp_path / "page"), "--runs", str(tmp_path / "first"), "--data", str(tmp_path)]
    given += ["--leaderboard", str(tmp_path / "own")]
    assert main(["leaderboard", "build", *given]) == 0
    out = capsys.readouterr().out
    assert "left out: no images of pattern-0" in out and str(tmp_path / "page/index.html") in out
    assert (tmp_path / "page/data/boards.js").is_file()
    assert {path.name for path in (tmp_path / "page/pictures").iterdir()} == {"sheets"}, "those of published entries"


@pytest.mark.parametrize(
    ("machines", "marked"),
    [(("a", "a"), False), (("a", "b"), True), (("a", None), True), (("a", "failed"), False), (("failed", "b"), False)],
)
def test_times_of_different_machines_are_marked(machines: tuple[str | None, ...], marked: bool) -> None:
    def made(name: str, machine: str | None) -> rows.Row:
        environment = machine and {"cpu": machine, "gpu": None}
        fitted = cell({"psnr": np.full(2, 30.0)}, fitted_with={"environment": environment, "harness": None})
        return row(name, {"s": failed() if machine == "failed" else fitted})

    found = board("b", [made(f"m{k}", machine) for k, machine in enumerate(machines)])
    console = Console(file=io.StringIO(), width=200)
    console.print(ranking_table(found, "psnr", 200))
    text = " ".join(console.file.getvalue().split())  # type: ignore[attr-defined]
    assert ("Fit times and images/s are of different machines: do not compare them." in text) == marked


def test_a_row_stays_on_its_lines_whatever_the_width() -> None:
    """Rows that fit are laid out together; where a cell breaks, what follows it must not move up."""
    boards, _ = gather(SHIPPED, (), brief=True)
    board = find_board(boards, "ideal")
    values = image_scores(board, "psnr")
    scores = compare_rows(values, "psnr")
    assert scores is not None
    for width in (48, 72, 240):
        console = Console(file=io.StringIO(), width=width, highlight=False)
        console.print(ranking_table(board, "psnr", width))
        lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
        for number, mean in zip(values.values, scores.means, strict=True):
            (cells,) = (line.split() for line in lines if board.rows[number].name in line.split()[:2])
            value = cells[cells.index(board.rows[number].name) + 1]
            assert f"{mean:.2f}".startswith(value) and (value == f"{mean:.2f}" or width < 72)
