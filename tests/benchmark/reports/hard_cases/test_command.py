"""The report with cases of its own: the exit code, the JSON, the page, and what the command prints."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from devtools import Page, browser

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.hard_cases.case import Case, NotRunError, Outcome, Setting, compare
from spike4dgs.benchmark.reports.hard_cases.command import make_hard_cases
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.cli import load, main

HOSTILE = '<img src=x onerror="window.hacked=1">'


def wrong_mean(setting: Setting) -> Outcome:
    """A deliberately wrong function: a mean that forgets the last value, beside numpy's."""
    values = setting.rng().random(9) + 1
    return compare(float(values[:-1].sum() / 9), float(np.mean(values)))


def crash(setting: Setting) -> Outcome:
    raise ValueError(HOSTILE)


def lack(setting: Setting) -> Outcome:
    raise NotRunError("no such camera")


def case(name: str, run: Any, **changes: Any) -> Case:
    texts = {"asked": f"{name} {HOSTILE}", "twin": "numpy", "unit": "mm", "tolerance": 1e-3}
    return Case(id=f"room/part/{name}", run=run, **(texts | changes))


RIGHT = (
    case("mean", lambda s: compare(s.rng().random(3).sum(), s.rng().random(3).sum())),
    case("resume", lambda s: Outcome("equal", 0.0), kind="resume", tolerance=0),
    case("seeds", lambda s: Outcome("spread", 0.0005), kind="seeds"),
    case("threads", lambda s: Outcome("equal", 0.0), kind="threads", tolerance=0),
)
WRONG = (
    case("wrong", wrong_mean),
    case("crash", crash),
    case("lack", lack),
    case("infinite", lambda s: Outcome("inf", math.inf)),
)


def report(out: Path, *cases: Case, **options: Any) -> tuple[int, dict[str, Any]]:
    code = make_hard_cases(lambda: cases)(out=out, **options)
    return code, json.loads((out / "hard_cases.json").read_text())


def test_all_right_is_exit_0(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, found = report(tmp_path, *RIGHT)
    assert code == 0 and all(c["passed"] for c in found["cases"])
    said = capsys.readouterr().out
    assert "[1/4] room/part; about " in said and "4 of 4 cases passed, 0 failed" in said
    assert f"page: {tmp_path / 'index.html'}" in said and f"JSON: {tmp_path / 'hard_cases.json'}" in said


def test_a_wrong_function_is_a_failed_row_and_exit_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, found = report(tmp_path, *RIGHT, *WRONG)
    rows = {c["id"].rpartition("/")[2]: c for c in found["cases"]}
    assert code == 1 and len(rows) == 8
    assert {name: row["passed"] for name, row in rows.items()} == {
        **dict.fromkeys(("mean", "resume", "seeds", "threads"), True),
        **dict.fromkeys(("wrong", "crash", "infinite"), False),
        "lack": None,
    }
    assert 1 / 9 < rows["wrong"]["error"] < 2 / 9 and rows["wrong"]["tolerance"] == 1e-3
    assert rows["crash"]["error"] is None and rows["infinite"]["error"] is None, "JSON has no infinity"
    said = capsys.readouterr().out
    assert "failed: room/part/wrong" in said and "4 of 8 cases passed, 3 failed, 1 not run" in said


def test_what_lacks_alone_fails_nothing(tmp_path: Path) -> None:
    assert report(tmp_path, WRONG[2])[0] == 0


def test_the_json_is_of_its_schema_and_says_where_it_comes_from(tmp_path: Path) -> None:
    _, found = report(tmp_path, *RIGHT, *WRONG, seed=5)
    schema = load_schema("spike4dgs.benchmark", "hard_cases.schema.json")
    check_schema(found, schema, "report", "")
    assert found["seed"] == 5 and found["environment"]["packages"]["numpy"] == np.__version__
    assert {"version", "commit", "dirty"} <= found["harness"].keys()
    for broken in ({"error": -1.0}, {"kind": "other"}, {"passed": "yes"}, {"surprise": 1}):
        with pytest.raises(UserError):
            check_schema({**found, "cases": [found["cases"][0] | broken]}, schema, "report", "")


def test_the_same_seed_gives_the_same_rows_and_another_one_others(tmp_path: Path) -> None:
    def rows(seed: int) -> list[dict[str, Any]]:
        return [{**c, "seconds": 0} for c in report(tmp_path, *RIGHT, *WRONG, seed=seed)[1]["cases"]]

    assert rows(0) == rows(0) != rows(1)


def test_some_cases_are_run_by_a_pattern(tmp_path: Path) -> None:
    code, found = report(tmp_path, *RIGHT, *WRONG, only="part/m")
    assert code == 0 and [c["id"] for c in found["cases"]] == ["room/part/mean"] and found["only"] == "part/m"
    with pytest.raises(UserError, match="--only"):
        report(tmp_path, *RIGHT, only="nothing-of-it")


def test_the_command_line_runs_real_cases_and_shows_an_example(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["report", "hard-cases", "--only", "poses/angle", "--out", str(tmp_path)]) == 0
    (row,) = json.loads((tmp_path / "hard_cases.json").read_text())["cases"]
    assert row["id"] == "benchmark/poses/angle" and row["error"] < 1e-9
    capsys.readouterr()
    assert main(["report", "hard-cases", "--help"]) == 0
    shown = capsys.readouterr().out
    assert "spike4dgs report hard-cases --out runs/hard-cases" in shown
    assert all(option in shown for option in ("--seed", "--device", "--only"))
    assert callable(load("report hard-cases"))


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("profile")) as shown:
        yield shown


@pytest.mark.parametrize("width", [390, 1400])
def test_the_page_opens_without_errors_and_shows_every_row(opened: Page, tmp_path: Path, width: int) -> None:
    report(tmp_path, *RIGHT, *WRONG)
    opened.events.clear()
    opened.show((tmp_path / "index.html").as_uri(), "document.readyState == 'complete'", width=width)
    assert not opened.errors() and opened.value("window.hacked") is None
    assert opened.value("document.documentElement.scrollWidth") <= width
    text = opened.value("document.body.innerText")
    assert "4 of 8 cases passed, 3 failed, 1 not run" in text and HOSTILE in text
    assert opened.value("document.querySelectorAll('tr.marked').length") == 6, "in the list of failures and in its part"
    titles = opened.value("[...document.querySelectorAll('h2')].map(h => h.innerText).join('|')")
    assert titles == "Failed|Summary|Seeds|Interrupted and resumed|Threads|room/part|Program"
    links = opened.value("[...document.querySelectorAll('nav a')].every(a => document.querySelector(a.hash))")
    assert links is True
