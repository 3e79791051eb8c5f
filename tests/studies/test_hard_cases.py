"""The report on the tests of a small checkout, and the fixture that judges a case."""

import json
import math
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import hard_case as support
import numpy as np
import pytest
from devtools import Page
from hard_case import HardCase, core_counts, described, on_cores

from spike4dgs.benchmark.environment import available_cores
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.studies.hard_cases import hard_cases
from spike4dgs.studies.kit import checkout as checkout_module

HOSTILE = '<img src=x onerror="window.hacked=1">'
SCHEMA = load_schema("spike4dgs.studies", "hard_cases.schema.json")
NAN, INF = math.nan, math.inf
CASES = """
import warnings

import numpy as np
import pytest

HOSTILE = '<img src=x onerror="window.hacked=1">'


def mark(**changes):
    return pytest.mark.hard_case(**{"asked": HOSTILE, "twin": "numpy", "unit": "mm", "tolerance": 1e-3, **changes})


@mark(on_device=True)
def test_mean(hard_case):
    values = hard_case.rng().random(3)
    hard_case.close(values.sum(), hard_case.rng().random(3).sum())
    warnings.warn("overflow", RuntimeWarning)
    (hard_case.folder / "x").touch()


@mark(kind="resume", tolerance=0)
def test_resume(hard_case):
    assert not list(hard_case.folder.iterdir())
    hard_case.same_bytes([b"abc", b"abc"], ["whole", "resumed"])


@mark(kind="seeds")
@pytest.mark.parametrize("seeds", [2, 3])
def test_seeds(hard_case, seeds):
    hard_case.check(0.0005, f"{seeds} {hard_case.seed}")


@mark(kind="threads", asked="{n} threads")
@pytest.mark.parametrize("n", [4])
def test_threads(hard_case, n):
    hard_case.check(0, "equal")


@mark()
def test_wrong(hard_case):
    values = hard_case.rng().random(9) + 1
    hard_case.close(values.mean(), values.mean(), "right")
    hard_case.close(values[:-1].sum() / 9, values.mean(), "a mean that forgets the last value")


@mark()
def test_crash(hard_case):
    hard_case.check(0.0005, "fine so far")
    raise ValueError(HOSTILE)


@mark()
def test_lack(hard_case):
    pytest.skip("no such camera")


@pytest.fixture
def broken():
    raise OSError("no space left")


@mark()
def test_early(broken, hard_case):
    hard_case.check(0, "never")


@mark()
def test_infinite(hard_case):
    hard_case.check(np.inf, "inf")


def test_of_no_report():
    raise AssertionError
"""


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a checkout of a single file of tests."""
    root = tmp_path_factory.mktemp("checkout")
    (root / "tests" / "support").mkdir(parents=True)
    (root / "tests" / "room" / "deep").mkdir(parents=True)
    shutil.copy(support.__file__, root / "tests" / "support")
    settings = (
        '[tool.pytest.ini_options]\npythonpath = ["tests/support"]\nmarkers = ["hard_case"]\nfilterwarnings = "error"'
    )
    (root / "pyproject.toml").write_text(settings)
    (root / "tests" / "conftest.py").write_text("from hard_case import hard_case")
    (root / "tests" / "room" / "deep" / "test_hard_part.py").write_text(CASES)
    return root


def report(checkout: Path, out: Path, **options: Any) -> tuple[subprocess.CompletedProcess[str], dict[str, Any]]:
    """Run the report in a process of its own: pytest cannot run within pytest."""
    code = (
        "import sys; from pathlib import Path; from spike4dgs.studies.hard_cases import hard_cases\n"
        f"sys.exit(hard_cases(out=Path({str(out)!r}), **{options!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=checkout, capture_output=True, text=True)
    path = out / "hard_cases.json"
    return done, json.loads(path.read_text()) if path.exists() else {}


@pytest.fixture(scope="module")
def whole(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any, dict[str, Any]]:
    out = tmp_path_factory.mktemp("report")
    return out, *report(checkout, out, seed=5)


def test_a_test_that_dies_before_its_case_is_exit_1(checkout: Path, tmp_path: Path) -> None:
    done, found = report(checkout, tmp_path, only="early or resume")
    assert done.returncode == 1 and "a test failed before it told of its case" in done.stderr
    assert [c["passed"] for c in found["cases"]] == [True]


def test_every_case_is_a_row_and_one_that_fails_is_exit_1(whole: tuple[Path, Any, dict[str, Any]]) -> None:
    out, done, found = whole
    rows = {c["id"].removeprefix("room/part/"): c for c in found["cases"]}
    assert done.returncode == 1 and found["seed"] == 5 and found["only"] is None
    assert {name: row["passed"] for name, row in rows.items()} == {
        **dict.fromkeys(("mean", "resume", "seeds-2", "seeds-3", "threads-4"), True),
        **dict.fromkeys(("wrong", "crash", "infinite"), False),
        "lack": None,
    }
    assert 1 / 9 < rows["wrong"]["error"] < 2 / 9 and rows["wrong"]["came_out"].startswith("a mean that forgets")
    assert rows["crash"]["error"] is None and HOSTILE in rows["crash"]["came_out"]
    assert rows["infinite"]["error"] is None, "JSON has no infinity"
    assert rows["lack"]["came_out"] == "not run: no such camera"
    assert rows["seeds-3"]["came_out"] == "3 5" and rows["threads-4"]["asked"] == "4 threads"
    assert rows["mean"]["warnings"] == ["RuntimeWarning: overflow"], "told, and fails nothing"
    assert {r["kind"] for r in rows.values()} == {"twin", "resume", "seeds", "threads"}
    assert "5 of 9 cases passed, 3 failed, 1 not run" in done.stdout
    assert f"page: {out / 'index.html'}" in done.stdout and f"JSON: {out / 'hard_cases.json'}" in done.stdout


def test_the_json_is_of_its_schema_and_says_where_it_comes_from(whole: tuple[Path, Any, dict[str, Any]]) -> None:
    found = whole[2]
    check_schema(found, SCHEMA, "report", "")
    assert found["environment"]["packages"]["numpy"] == np.__version__
    assert {"version", "commit", "dirty"} <= found["harness"].keys()
    for broken in ({"error": -1.0}, {"kind": "other"}, {"passed": "yes"}, {"surprise": 1}):
        with pytest.raises(UserError):
            check_schema({**found, "cases": [found["cases"][0] | broken]}, SCHEMA, "report", "")


def test_some_cases_are_run_by_a_pattern(checkout: Path, tmp_path: Path) -> None:
    done, found = report(checkout, tmp_path, only="mean or lack")
    assert done.returncode == 0 and [c["id"] for c in found["cases"]] == ["room/part/mean", "room/part/lack"]
    done, _ = report(checkout, tmp_path / "none", only="nothing_of_it")
    assert done.returncode == 1 and "--only: expected a part of the name of a test" in done.stderr


def test_without_tests_the_command_says_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(checkout_module, "__file__", str(tmp_path / "spike4dgs" / "studies" / "kit" / "checkout.py"))
    with pytest.raises(UserError, match=r"expected a checkout with its tests, found none in .*; clone the repository"):
        hard_cases(out=tmp_path)


@pytest.mark.parametrize("width", [390, 1400])
def test_the_page_opens_without_errors_and_shows_every_row(empty_page: Page, whole: Any, width: int) -> None:
    empty_page.show((whole[0] / "index.html").as_uri(), "document.readyState == 'complete'", width=width)
    assert not empty_page.errors() and empty_page.value("window.hacked") is None
    assert empty_page.value("document.documentElement.scrollWidth") <= width
    text = empty_page.value("document.body.innerText")
    assert "5 of 9 cases passed, 3 failed, 1 not run" in text and HOSTILE in text
    assert empty_page.value("document.querySelectorAll('tr.marked').length") == 6, (
        "in the list of failures and in its part"
    )
    titles = empty_page.value("[...document.querySelectorAll('h2')].map(h => h.innerText).join('|')")
    assert titles == "Failed|Summary|Seeds|Interrupted and resumed|Threads|room/part|Program"
    links = empty_page.value("[...document.querySelectorAll('nav a')].every(a => document.querySelector(a.hash))")
    assert links is True


@pytest.fixture
def judge(tmp_path: Path) -> HardCase:
    """Return a case that passes up to an error of 0.5."""
    row = {"unit": "px", "tolerance": 0.5, "error": None, "came_out": "", "finite": True}
    return HardCase(3, "cpu", tmp_path, row)


@pytest.mark.parametrize(
    ("found", "expected", "passes"),
    [
        ([1.0, 2.0], [1.0, 2.5], True),
        ([1.0, 2.0], [1.0, 2.5000001], False),
        ([1.0, NAN], [1.0, NAN], True),  # NaN is expected there
        ([1.0, 2.0], [1.0, NAN], False),  # a number where there should be none
        ([1.0, NAN], [1.0, 2.0], False),
        ([1.0, INF], [1.0, 2.0], False),
        ([], [], True),
        ([[1.0, 2.0]], [[1.0], [2.0]], False),  # other shapes
    ],
)
def test_the_worst_difference_counts(judge: HardCase, found: Any, expected: Any, passes: bool) -> None:
    if passes:
        judge.close(found, expected)
    else:
        with pytest.raises(AssertionError):
            judge.close(found, expected)


def test_relative_errors_are_of_the_whole_array_and_the_worst_check_is_kept(judge: HardCase) -> None:
    a = np.random.default_rng(0).normal(size=30)
    judge.close(a + 0.1, a, "all", relative=True)
    assert judge.row["error"] == pytest.approx(0.1 * np.sqrt(30) / np.linalg.norm(a), rel=1e-12)
    judge.close([0.5], [0.0], "one", relative=True)  # nothing to be relative to
    judge.close([0.2], [0.0], "another")
    assert judge.row["error"] == 0.5 and judge.row["came_out"] == "one: 0.5"
    with pytest.raises(AssertionError):
        judge.check(NAN, "not a number")
    np.testing.assert_array_equal(judge.rng().random(5), judge.rng().random(5))


def test_only_user_errors_are_refusals(judge: HardCase) -> None:
    def refuse() -> None:
        raise problem("here", "this", "that", "do so")

    judge.refused({"a": refuse})
    assert judge.row["error"] == 0 and "expected this" in judge.row["came_out"]
    with pytest.raises(AssertionError, match="taken gave int"):
        judge.refused({"a": refuse, "taken": lambda: 3})
    with pytest.raises(ZeroDivisionError):
        judge.refused({"a": lambda: 1 / 0})


def test_differing_bytes_are_counted_and_named_and_cores_are_given_back(judge: HardCase) -> None:
    judge.same_bytes([b"abcd", b"abcd"], ["one", "two"])
    with pytest.raises(AssertionError, match="4 bytes; three differ: 2 px"):
        judge.same_bytes([b"abcd", b"abcd", b"axyd"], ["one", "two", "three"])
    with pytest.raises(AssertionError, match="two differ: 4 px"):
        judge.same_bytes([b"abcd", b"abc"], ["one", "two"])
    before = available_cores()
    with on_cores(1):
        assert available_cores() == 1
    assert available_cores() == before and core_counts()[0] == 1 and core_counts()[-1] == before
    if before > 1:
        with pytest.raises(AssertionError):
            judge.same_on_all_cores(lambda: bytes([available_cores()] * 3))


def test_arrays_are_described_with_what_is_missing() -> None:
    assert described(np.array([1.0, NAN, 3.0])) == "3 values from 1 to 3, 1 not finite"
    assert described(np.full(2, NAN)) == "2 values, none of them finite"
    assert described(np.zeros((0, 4))) == "nothing"
