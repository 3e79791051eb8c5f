"""What the page shows of a board, as JSON values: cells with their means, what a reader filters by, and details."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from spike4dgs.benchmark.method import DEFAULT_GIVEN
from spike4dgs.benchmark.metrics.measure import mean
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.paper_tables import published
from spike4dgs.benchmark.runs.record import COSTS
from spike4dgs.benchmark.variants import world_of
from spike4dgs.leaderboard.page.intervals import Comparison
from spike4dgs.leaderboard.page.rows import NOT_STATED, Board, Row, distinct
from spike4dgs.leaderboard.page.scores import ImageScores, rounded
from spike4dgs.leaderboard.tracks import PUBLIC, current_release

PARTS = ("images", "initialization", "motion", "supervision")
PAPER_TABLES = (1, 2)  # those of whole methods by scene


def page_metrics() -> list[dict[str, Any]]:
    """Return the metrics and costs as the page lists them."""
    same = ("id", "title", "definition", "unit", "digits")
    metrics = [
        {**{key: getattr(m, key) for key in same}, "higher": m.higher_is_better, "cost": False}
        for m in METRICS.values()
    ]
    costs = [
        {"id": c, "title": t, "definition": "", "higher": c == "render_fps", "unit": "", "digits": d, "cost": True}
        for c, (t, d) in COSTS.items()
    ]
    return [*metrics, *costs]


def board_content(board: Board, identifier: str) -> dict[str, Any]:
    """Return a board's table. Cells are in the order of `scenes`, values in that of `page_metrics`."""
    release = current_release()
    return {
        "id": identifier,
        "name": board.name,
        "title": board.title,
        "label": board.name if board.folder == PUBLIC else board.title,
        "folder": board.folder,
        "why": board.why,
        "withheld": list(board.withheld),
        "split": board.dataset["split"],
        "scenes": [
            {
                "id": s,
                "revision": (revision := board.dataset["scenes"][s]),
                "ceiling": release.ceiling_db(s, revision),
                "sensor": release.sensor(s, revision)
                or distinct(r["sensors"][s] for row in board.rows for r in row.records if s in r.get("sensors", {})),
            }
            for s in board.scenes
        ],
        "worlds": [world_of(s) for s in board.scenes],
        "published": published_values(board),
        "rows": [_row(row, board.scenes) for row in board.rows],
    }


def _row(row: Row, scenes: Sequence[str]) -> dict[str, Any]:
    method = row.first["method"]
    cells = [[r["scenes"][scene] for r in row.records] for scene in scenes]
    params = method["params"]
    fitted = [c for of in cells for c in of if c["status"] == "ok"]
    return {
        "name": row.name,
        "method": method["name"],
        "label": row.label,
        "apart": row.apart,
        "unverified": sorted(row.unverified),
        "ranked": row.ranked,
        "why": row.why,
        "seeds": [r["method"]["seed"] or 0 for r in row.records],
        "parts": {p: str(params[p]) if isinstance(params.get(p), str) else "none" for p in PARTS},
        "budget": distinct(_budget(c["budget"]) for c in fitted),
        "hardware": row.hardware,
        "given": list(method.get("given", DEFAULT_GIVEN)),
        "trainedOn": len(method["trained_on"]),
        "cells": [_cell(of) for of in cells],
    }


def _cell(seeds: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a cell: the means over seeds, null where one has none, and the reason where one was not scored."""
    values = [mean(c["metrics"].get(m) for c in seeds) for m in METRICS]
    costs = [mean(c[cost] for c in seeds) for cost in COSTS]
    failed = [f"{c['status']}: {c['error']}" for c in seeds if c["status"] != "ok"]
    return {"v": [rounded(v) for v in (*values, *costs)], "why": failed[0] if failed else ""}


def _budget(budget: float | str | None) -> str:
    if budget is None:
        return NOT_STATED
    return budget if isinstance(budget, str) else f"{budget:g} x quick"


def published_values(board: Board) -> dict[str, Any] | None:
    """Return what the paper has for a board's methods and worlds: row -> metric -> a value for each scene or null.

    The published scenes are others, so these values stand in a column of their own. None where the paper has none.
    """
    worlds = [scene.split("-")[0] for scene in board.scenes]
    found: dict[str, dict[str, list[float | None]]] = {}
    names: dict[str, str] = {}
    sources = []
    for number in PAPER_TABLES:
        table = published(number)
        if not set(worlds) & set(table.worlds):
            continue
        sources.append(f"{table.source}, table {number}. {table.note}")
        names |= dict(zip(table.metrics, table.names, strict=True))
        for i, row in enumerate(board.rows):
            for metric in table.metrics:
                values = [table.value(row.first["method"]["name"], world, metric) for world in worlds]
                if any(v is not None for v in values):
                    other = found.setdefault(str(i), {}).get(metric) or [None] * len(worlds)  # of another table
                    found[str(i)][metric] = [a if b is None else b for a, b in zip(other, values, strict=True)]
    return {"source": " ".join(sources), "names": names, "rows": found} if found else None


def score_content(scores: ImageScores, comparison: Comparison | None) -> dict[str, Any]:
    """Return the scores image by image, with the comparison: `better` has a row of 0 and 1 for each compared row."""
    return {
        "images": scores.images,
        "rows": list(scores.values),
        # [images] where there is one seed, else [images][seeds]
        "values": [[s.tolist() if s.shape[1] > 1 else s[:, 0].tolist() for s in of] for of in scores.values.values()],
        "leftOut": {str(i): why for i, why in scores.left_out.items()},
        "better": [] if comparison is None else ["".join("01"[int(b)] for b in line) for line in comparison.better],
    }


def details(board: Board) -> list[dict[str, Any]]:
    """Return for each row what a doubting reader asks for: commands, hashes, environments, commits."""
    return [_details(row) for row in board.rows]


def _details(row: Row) -> dict[str, Any]:
    method = row.first["method"]
    checks = {path: e["verification"] for path, e in row.entries.items()}
    return {
        "entries": [
            {"path": path, "sha256": row.hashes[path], "submitted": e["submitted"]} for path, e in row.entries.items()
        ],
        "run": row.run.as_posix() if row.run else None,
        "version": method["version"],
        "trainedOn": method["trained_on"],
        "params": method["params"],
        "verified": [
            {"path": p, "label": v["label"], "unverified": v["unverified"], "by": v["by"]} for p, v in checks.items()
        ],
        "records": [
            {
                "seed": r["method"]["seed"],
                "command": r["command"],
                "created": r["created"],
                "environment": r["environment"],
                "harness": r["harness"],
                "cells": {scene: _cell_details(cell, r) for scene, cell in sorted(r["scenes"].items())},
            }
            for r in row.records
        ],
    }


def _cell_details(cell: Mapping[str, Any], record: Mapping[str, Any]) -> dict[str, Any]:
    keys = ("status", "error", "predictions_sha256", "budget", "device", "gain_aligned", "notes")
    fitted = cell["fitted_with"]
    same = fitted["environment"] == record["environment"] and fitted["harness"] == record["harness"]
    return {**{key: cell[key] for key in keys}, "fittedWith": None if same else fitted}
