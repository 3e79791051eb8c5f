"""The page of the report: what failed, then seeds, resumed fits and threads, then the cases by part."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.reports.html_chart import short
from spike4dgs.benchmark.reports.html_page import (
    Html,
    bullets,
    contents,
    facts,
    folded,
    paragraph,
    run_facts,
    section,
    table,
    wide,
    write_page,
)

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
    "threads": (
        "Threads",
        "The number of threads or cores has to change no bit of a result.",
    ),
}
_HEADS = ("", "case", "asked", "came out", "beside", "worst error", "tolerance", "finite", "s")
_WORDS = (0, 1, 2, 3, 4, 7)
_VERDICTS = {True: "pass", False: "FAIL", None: "not run"}


def write_content(path: Path, report: dict[str, Any]) -> None:
    """Write the page of a report of `hard_cases.schema.json`."""
    cases: Rows = report["cases"]
    failed = [c for c in cases if c["passed"] is False]
    kinds: dict[str, Rows] = {kind: [c for c in cases if c["kind"] == kind] for kind in _KINDS}
    parts: dict[str, Rows] = {}
    for part in dict.fromkeys(part_of(c) for c in cases if c["kind"] == "twin"):
        parts[part] = [c for c in cases if part_of(c) == part and c["kind"] == "twin"]
    sections = [
        *(section("Failed", [_table(failed, whole_ids=True)]) for _ in failed[:1]),
        section("Summary", [_summary(parts, kinds), *_heard(cases)]),
        *(
            section(_KINDS[k][0], [paragraph(_KINDS[k][1]), _table(rows, whole_ids=True)])
            for k, rows in kinds.items()
            if rows
        ),
        *(section(part, [_table(rows)]) for part, rows in parts.items()),
        section("Program", [_program(report)]),
    ]
    titles = ["Summary", *(_KINDS[k][0] for k, rows in kinds.items() if rows), *parts, "Program"]
    verdict = paragraph(counted(cases), "bad" if failed else "good")
    write_page(
        path,
        "Hard cases",
        [paragraph(_INTRO), verdict, run_facts(report, ("seed", "device"), "run"), contents(titles), *sections],
    )


def part_of(case: dict[str, Any]) -> str:
    """Return the part that a case belongs to: room/part."""
    return str(case["id"]).rpartition("/")[0]


def counted(cases: Rows) -> str:
    """Return how many cases passed, failed and were not run, in words."""
    count = {verdict: sum(c["passed"] is verdict for c in cases) for verdict in (True, False, None)}
    text = f"{count[True]} of {len(cases)} cases passed, {count[False]} failed"
    return text + (f", {count[None]} not run" if count[None] else "")


def _summary(parts: dict[str, Rows], kinds: dict[str, Rows]) -> Html:
    """Return a row for each part: how many cases, how many passed, the largest share of a tolerance that was used."""
    rows = []
    for name, cases in {**{_KINDS[k][0]: v for k, v in kinds.items() if v}, **parts}.items():
        passed = sum(c["passed"] is True for c in cases)
        nearest = max(cases, key=_share)
        used = f"{_share(nearest):.1%} by `{nearest['id'].rpartition('/')[2]}`" if _share(nearest) > 0 else ""
        rows.append((name, str(len(cases)), str(passed), f"{sum(c['seconds'] for c in cases):.1f}", used))
    return table(("part", "cases", "passed", "s", "most of a tolerance used"), rows, words=(0, 4))


def _share(case: dict[str, Any]) -> float:
    """Return a case's error as a share of its tolerance; 0 where nothing is tolerated."""
    return case["error"] / case["tolerance"] if case["error"] and case["tolerance"] else 0.0


def _table(cases: Rows, whole_ids: bool = False) -> Html:
    marked = [i for i, c in enumerate(cases) if c["passed"] is False]
    return wide(table(_HEADS, [_cells(c, whole_ids) for c in cases], words=_WORDS, marked=marked))


def _cells(c: dict[str, Any], whole_id: bool) -> tuple[str, ...]:
    name = c["id"] if whole_id else c["id"].rpartition("/")[2]
    device = "" if c["device"] == "cpu" else f" on {c['device']}"
    error = "none" if c["error"] is None else f"{short(c['error'])} {c['unit']}".strip()
    return (
        _VERDICTS[c["passed"]], f"`{name}`", c["asked"] + device, c["came_out"], c["twin"], error,
        short(c["tolerance"]), "yes" if c["finite"] else "NO", f"{c['seconds']:.2f}",
    )  # fmt: skip


def _heard(cases: Rows) -> list[Html]:
    """Return what Python warned of in the cases, folded; nothing if it did not."""
    lines = [f"`{c['id']}`: {text}" for c in cases for text in c["warnings"]]
    return [folded(f"{len(lines)} warnings of libraries", [bullets(lines)])] if lines else []


def _program(report: dict[str, Any]) -> Html:
    machine = report["environment"]
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    rows = [("command", f"`{report['command']}`"), ("Python", machine["python"]), ("platform", machine["platform"])]
    return facts([*rows, ("processor", machine["cpu"]), ("packages", packages), ("JSON", "`hard_cases.json`")])
