"""`report hard-cases`: run the tests marked `hard_case`, then write OUT/index.html and OUT/hard_cases.json."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from spike4dgs.benchmark.environment import choose_device, command_line, environment, harness, utc_now
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import write_json
from spike4dgs.benchmark.reports.html_chart import short
from spike4dgs.benchmark.reports.html_page import (
    Html,
    bullets,
    contents,
    folded,
    paragraph,
    run_facts,
    section,
    table,
    wide,
    write_page,
)
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.studies.kit.checkout import find_checkout, pytest_options
from spike4dgs.studies.kit.page import program_facts

FORMAT = "spike4dgs-hard-cases/1"
Rows = Sequence[dict[str, Any]]
_INTRO = (
    "Every row is an input that tends to break programs. What came out stands beside an independent result: a slow "
    "twin in float64, a closed form, another library, or a contract that an input is refused. A case passes if its "
    "result is finite and the worst error is within the tolerance. Errors are worst cases, not means."
)
_KINDS = {
    "seeds": (
        "Seeds",
        "The same seed has to give the same bytes. Other seeds have to give another result; the error is how far they "
        "spread.",
    ),
    "resume": (
        "Interrupted and resumed",
        "A fit that is interrupted at a checkpoint and goes on has to equal, bit for bit, the fit that was never "
        "interrupted: Gaussians, networks, optimiser and statistics.",
    ),
    "threads": ("Threads", "The number of threads or cores has to change no bit of a result."),
}
_HEADS = ("", "case", "asked", "came out", "beside", "worst error", "tolerance", "finite", "s")
_VERDICTS = {True: "pass", False: "FAIL", None: "not run"}


def hard_cases(
    *,
    out: Path = Path("runs/hard-cases"),
    only: str | None = None,
    seed: int = 0,
    device: Literal["auto", "cpu", "cuda"] = "cpu",
) -> int:
    """Run hard inputs through every part of the project, each beside an independent result, and write one page.

    The cases are the tests marked `hard_case`: run this in a checkout, with the extra `test` installed. A case passes
    if what came out is finite and its worst error is within the tolerance beside it. Other rows run one thing twice:
    with the same and with other seeds, interrupted and resumed, on one and on more threads. Writes OUT/index.html,
    which opens from the disk, and OUT/hard_cases.json. Takes minutes on two cores; the first run also compiles. Returns
    1 if a case fails.

    Args:
        out: Folder for the page and the JSON.
        only: Run the tests whose names match this expression, as in `pytest -k`.
        seed: Seed of all random inputs.
        device: cpu, cuda, or auto: cuda where there is one. Cases of CPU kernels stay on the CPU.
    """
    root, where = find_checkout("report hard-cases"), choose_device(device)
    import pytest

    found, start = Cases(seed, where), utc_now()
    tests = sorted(p for p in (root / "tests").rglob("test_*.py") if "mark.hard_case" in p.read_text("utf-8"))
    options = ["-m", "hard_case", *pytest_options(root)]
    code = pytest.main([*options, *(["-k", only] if only else []), *map(str, tests)], plugins=[found])
    if code == pytest.ExitCode.NO_TESTS_COLLECTED:
        raise problem("--only", "a part of the name of a test marked hard_case", repr(only), "choose another part")
    if code > pytest.ExitCode.TESTS_FAILED:
        raise problem(f"tests of {root}", "tests that run", f"exit code {int(code)} of pytest", "see the lines above")
    report: dict[str, Any] = {
        "format": FORMAT, "seed": seed, "device": where, "only": only, "started": start, "finished": utc_now(),
        "command": command_line(), "harness": harness(), "environment": environment(where),
        "cases": list(found.rows.values()),
    }  # fmt: skip
    check_schema(report, load_schema("spike4dgs.studies", "hard_cases.schema.json"), "the report", "report this")
    write_json(out / "hard_cases.json", report)
    _write_page(out / "index.html", report)
    print(f"{_counted(report['cases'])}\npage: {out / 'index.html'}\nJSON: {out / 'hard_cases.json'}", flush=True)
    failed = any(c["passed"] is False for c in report["cases"])
    if code == pytest.ExitCode.TESTS_FAILED and not failed:
        print("a test failed before it told of its case: see the lines above", file=sys.stderr)
    return int(failed or code == pytest.ExitCode.TESTS_FAILED)


class Cases:
    """A pytest plugin: it hands the seed and the device to the fixture `hard_case`, and keeps a row of each test."""

    def __init__(self, seed: int, device: str) -> None:
        self.setting, self.rows = (seed, device), dict[str, dict[str, Any]]()

    def pytest_configure(self, config: Any) -> None:
        """Hand over the seed and the device."""
        config.hard_case_setting = self.setting

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Keep what a test told of its case, and whether it passed."""
        told = dict(report.user_properties).get("hard_case")
        if told is None or (report.when != "call" and report.passed):
            return
        error, text = told["error"], told["came_out"]
        if report.skipped:
            text = f"not run: {report.longrepr[2].removeprefix('Skipped: ')}"
        elif report.failed and (error is None or (told["finite"] and error <= told["tolerance"])):
            error, text = None, str(getattr(report.longrepr, "reprcrash", None) and report.longrepr.reprcrash.message)
        self.rows[report.nodeid] = told | {
            "id": case_id(report.nodeid),
            "came_out": text or "no message",
            "error": error if error is not None and math.isfinite(error) else None,  # JSON has no infinity, no NaN
            "finite": told["finite"] and not (report.failed and error is None),
            "tolerance": float(told["tolerance"]),
            "passed": None if report.skipped else report.passed,
            "seconds": report.duration,
            "warnings": [],
        }

    def pytest_warning_recorded(self, warning_message: Any, nodeid: str) -> None:
        """Keep what Python warned of; it fails no case."""
        if nodeid in self.rows:
            text = f"{warning_message.category.__name__}: {warning_message.message}"
            self.rows[nodeid]["warnings"] = sorted({*self.rows[nodeid]["warnings"], text})


def case_id(nodeid: str) -> str:
    """Return room/part/name of a test.

    >>> case_id("tests/method/splat/test_hard_splat.py::test_a_scene[needles]")
    'method/splat/a-scene-needles'
    >>> case_id("tests/method/test_trainer.py::test_a[pixel+spike-1.0]")
    'method/trainer/a-pixel+spike-1-0'
    """
    path, _, name = nodeid.partition("::")
    room, file = re.findall(r"tests/(\w+)/.*?(?:test_hard_|test_)(\w+)\.py", path)[0]
    part, case = (re.sub(r"[^a-z0-9+]+", "-", t.lower()).strip("-") for t in (file, name.removeprefix("test_")))
    return f"{room}/{part}/{case}"


def _write_page(path: Path, report: dict[str, Any]) -> None:
    """Write the page: what failed, then seeds, resumed fits and threads, then the cases by part."""
    cases: Rows = report["cases"]
    failed = [c for c in cases if c["passed"] is False]
    groups: dict[str, list[dict[str, Any]]] = {}
    for c in sorted(cases, key=lambda c: [*_KINDS, "twin"].index(c["kind"])):
        groups.setdefault(_KINDS.get(c["kind"], (c["id"].rpartition("/")[0],))[0], []).append(c)
    texts = {title: [paragraph(text)] for title, text in _KINDS.values()}
    warned = [f"`{c['id']}`: {text}" for c in cases for text in c["warnings"]]
    heard = [folded(f"{len(warned)} warnings of libraries", [bullets(warned)])] if warned else []
    parts = [
        paragraph(_INTRO),
        paragraph(_counted(cases), "bad" if failed else "good"),
        run_facts(report, ("seed", "device"), "run"),
        contents(["Summary", *groups, "Program"]),
        *(section("Failed", [_table(failed)]) for _ in failed[:1]),
        section("Summary", [_summary(groups), *heard]),
        *(section(title, [*texts.get(title, ()), _table(rows)]) for title, rows in groups.items()),
        section("Program", [program_facts(report)]),
    ]
    write_page(path, "Hard cases", parts)


def _counted(cases: Rows) -> str:
    """Return how many cases passed, failed and were not run, in words."""
    count = {verdict: sum(c["passed"] is verdict for c in cases) for verdict in (True, False, None)}
    text = f"{count[True]} of {len(cases)} cases passed, {count[False]} failed"
    return text + (f", {count[None]} not run" if count[None] else "")


def _summary(parts: dict[str, Any]) -> Html:
    """Return a row for each part: how many cases, how many passed, the largest share of a tolerance that was used."""
    rows = []
    for name, cases in parts.items():
        passed = sum(c["passed"] is True for c in cases)
        shares = {c["id"]: c["error"] / c["tolerance"] if c["error"] and c["tolerance"] else 0.0 for c in cases}
        nearest = max(shares, key=lambda i: shares[i])
        used = f"{shares[nearest]:.1%} by `{nearest.rpartition('/')[2]}`" if shares[nearest] > 0 else ""
        rows.append((name, str(len(cases)), str(passed), f"{sum(c['seconds'] for c in cases):.1f}", used))
    return table(("part", "cases", "passed", "s", "most of a tolerance used"), rows, words=(0, 4))


def _table(cases: Rows) -> Html:
    rows = []
    for c in cases:
        device = "" if c["device"] == "cpu" else f" on {c['device']}"
        error = "none" if c["error"] is None else f"{short(c['error'])} {c['unit']}".strip()
        what = (_VERDICTS[c["passed"]], f"`{c['id']}`", c["asked"] + device, c["came_out"], c["twin"], error)
        rows.append((*what, short(c["tolerance"]), "yes" if c["finite"] else "NO", f"{c['seconds']:.2f}"))
    marked = [i for i, c in enumerate(cases) if c["passed"] is False]
    return wide(table(_HEADS, rows, words=(0, 1, 2, 3, 4, 7), marked=marked))
