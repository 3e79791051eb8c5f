"""The page of a study: a summary, then each measurement with its plots, its numbers and its reasons."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.reports.html_chart import Axis, Curve, Dot, chart, short
from spike4dgs.benchmark.reports.html_page import (
    Html,
    contents,
    facts,
    figure,
    folded,
    grid,
    link,
    paragraph,
    run_facts,
    section,
    table,
    write_page,
)

_OPEN_ROWS = 12  # a longer table is folded


def write_page_of(path: Path, report: dict[str, Any]) -> None:
    """Write the page of a report of `speed_error.schema.json`."""
    results = report["measurements"]
    groups = list(dict.fromkeys(r["group"] for r in results))
    intro = (
        "Every approximation stands beside its slow exact twin, measured in the same run by turns. A ring marks the "
        "point that the project uses. Errors are against the exact twin, and do not depend on the machine; times do. A "
        "time is the best of several turns, unless its title says otherwise."
    )
    sections = [section(g, [_measurement(r) for r in results if r["group"] == g]) for g in groups]
    parts = [
        paragraph(intro),
        run_facts(report, ("size", "seed", "device"), "measured"),
        contents(["Summary", *groups]),
        section("Summary", [_summary(results), *_failures(results)]),
        *sections,
        section("Program", [program_facts(report)]),
    ]
    write_page(path, "Speed against error", parts)


def program_facts(report: dict[str, Any]) -> Html:
    """Return the table of the command, the system and the packages of a report."""
    machine = report["environment"]
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items())
    return facts(
        [
            ("command", f"`{report['command']}`"),
            ("system", f"Python {machine['python']}, {machine['platform']}"),
            ("packages", packages),
        ]
    )


def _summary(results: Iterable[dict[str, Any]]) -> Html:
    """Return a row for each measurement with an exact twin: its chosen point on the first input."""
    rows = []
    for r in results:
        for s in r["series"][:1]:
            roles = {p["role"]: p for p in reversed(s["points"])}  # the first of each
            if not {"chosen", "exact"} <= roles.keys():
                continue
            chosen, exact = roles["chosen"], roles["exact"]
            x, y = (next(c for c in r["columns"] if c["id"] == i) for i in (r["cost"], r["error"]))
            cost, base, error = chosen["values"][x["id"]], exact["values"][x["id"]], chosen["values"][y["id"]]
            ratio = f"{short(base / cost)}" if cost and base is not None else "-"
            costs = (_number(cost), _number(base), ratio)
            rows.append((link(r["title"], r["title"]), chosen["name"], *costs, x["title"], _number(error), y["title"]))
    heads = ("approximation", "chosen", "its cost", "exact twin", "ratio", "cost in", "its error", "error in")
    return table(heads, rows, words=(0, 1, 5, 7))


def _failures(results: Iterable[dict[str, Any]]) -> list[Html]:
    return [paragraph(f"Failed: {r['title']}: {r['problem']}", "bad") for r in results if r["problem"]]


def _measurement(r: dict[str, Any]) -> Html:
    first = "approximation" if r["exact"] else "what"
    said = [(first, r["approximation"]), ("exact twin", r["exact"]), ("chosen because", r["reason"])]
    said += [("held by", f"`{r['held_by']}`" if r["held_by"] else ""), ("id", f"`{r['id']}`")]
    plots = [figure(_plot(r, y), _caption(r, y)) for y in r["y"]]
    numbers = _numbers(r)
    rows = sum(len(s["points"]) for s in r["series"])
    parts = [
        facts((name, words) for name, words in said if words),
        *([paragraph(f"Failed: {r['problem']}", "bad")] if r["problem"] else []),
        *([grid(plots)] if r["series"] else []),
        *([folded(f"{rows} rows of numbers", [numbers]) if rows > _OPEN_ROWS else numbers] if rows else []),
    ]
    return section(r["title"], parts, level=3)


def _caption(r: dict[str, Any], y: str) -> str:
    return f"{_title(r, y)} against {_title(r, r['x'])}"


def _plot(r: dict[str, Any], y: str) -> Html:
    curves = []
    for s in r["series"]:
        shown = [p for p in s["points"] if p["values"][r["x"]] is not None and p["values"][y] is not None]
        shown.sort(key=lambda p: p["values"][r["x"]])
        dots = (Dot(p["values"][r["x"]], p["values"][y], p["name"], p["role"] == "chosen") for p in shown)
        curves.append(Curve(s["name"], tuple(dots)))
    x, up = (Axis(_title(r, c), next(a["log"] for a in r["columns"] if a["id"] == c)) for c in (r["x"], y))
    return chart(curves, x, up, f"{r['title']}: {_caption(r, y)}")


def _numbers(r: dict[str, Any]) -> Html:
    rows: list[list[Any]] = []
    marked = []
    several = len(r["series"]) > 1
    named = any(p["name"] for s in r["series"] for p in s["points"])
    for s in r["series"]:
        for p in s["points"]:
            if p["role"] == "chosen":
                marked.append(len(rows))
            role = f" ({p['role']})" if p["role"] else ""
            cells = [_number(p["values"][c["id"]]) for c in r["columns"]]
            rows.append([*([s["name"]] if several else []), *([f"{p['name']}{role}"] if named else []), *cells])
    heads = ["input"] * several + ["setting"] * named + [c["title"] for c in r["columns"]]
    return table(heads, rows, words=range(several + named), marked=marked)


def _title(r: dict[str, Any], column: str) -> str:
    return str(next(c["title"] for c in r["columns"] if c["id"] == column))


def _number(value: float | None) -> str:
    return "-" if value is None else short(value)
