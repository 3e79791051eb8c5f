"""Boards for tests of the leaderboard's page, made without scenes or fits."""

from typing import Any

import numpy as np

from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.leaderboard.page.rows import Board, Row
from spike4dgs.leaderboard.tracks import LOCAL

MACHINE = {"python": "3.11", "platform": "none", "packages": {}, "cpu": "a CPU", "gpu": None, "cuda": None}
CODE = {"version": "0.1.0", "commit": "c" * 40, "dirty": False}


def cell(scores: dict[str, np.ndarray], **costs: Any) -> dict[str, Any]:
    """A scored cell; `scores`: metric -> one value for each image."""
    n = len(next(iter(scores.values()))) if scores else 0
    images = {
        f"cam_03/{20 * i:06d}": {m: float(scores[m][i]) if m in scores else None for m in METRICS} for i in range(n)
    }
    means = {m: float(np.mean(scores[m])) if m in scores else None for m in METRICS}
    plain = {"fit_seconds": 50.0, "render_fps": 100.0, "peak_memory_mb": 900.0, "model_mb": 2.5, "notes": {}}
    made = {"status": "ok", "error": None, "metrics": means, "per_image": images, "gain_aligned": 1.0}
    made |= {"predictions_sha256": "a" * 64, "budget": 1.0, "device": "cpu"}
    return {**made, "fitted_with": {"environment": MACHINE, "harness": CODE}, **plain, **costs}


def failed(error: str = "no luck") -> dict[str, Any]:
    """A cell of a fit that failed."""
    nothing = dict.fromkeys(("fit_seconds", "render_fps", "peak_memory_mb", "model_mb", "budget", "device"))
    return cell({}) | nothing | {"status": "failed", "error": error, "predictions_sha256": None}


def row(name: str, cells: dict[str, dict[str, Any]], **changes: Any) -> Row:
    """A row of one record; `changes` replace fields of the record's method, or `label`, `ranked` and `why`."""
    facts = {key: changes.pop(key) for key in ("label", "ranked", "why") if key in changes}
    params = {"images": "tfp", "initialization": "rig", "motion": "static", "supervision": "pixel"}
    method = {"name": name, "version": "1", "params": params, "seed": 0, "trained_on": [], "given": ["poses"]}
    record = {"method": method | changes, "dataset": {"split": "center"}, "scenes": cells}
    record |= {"command": f"spike4dgs run-benchmark --methods {name}", "created": "2026-11-21T00:00:00Z"}
    record |= {"environment": MACHINE, "harness": CODE}
    ranked = all(c["status"] == "ok" for c in cells.values())
    return Row(**({"name": name, "label": "re-scored", "ranked": ranked, "why": "", "records": (record,)} | facts))


def board(name: str, rows: list[Row], title: str = "Made for a test") -> Board:
    """A local board of these rows, on the scenes of the first."""
    scenes = dict.fromkeys(rows[0].first["scenes"], "5" * 64)
    return Board(name, title, LOCAL, "", (), {"name": name, "scenes": scenes, "split": "center"}, rows)


def large_board(rows: int, scenes: int, ranked: int) -> Board:
    """A board of many rows; the first `ranked` ones may be ranked."""
    rng = np.random.default_rng(0)
    made = []
    for i in range(rows):
        level = rng.normal(30, 3)
        cells = {
            f"scene-{s:02d}": cell({"psnr": level + rng.normal(size=2)}, fit_seconds=float(rng.uniform(20, 100)))
            for s in range(scenes)
        }
        params = {"images": ("tfi", "tfp")[i % 2], "motion": ("static", "paths", "hexplane")[i % 3]}
        claimed = {} if i < ranked else {"ranked": False, "label": "claimed", "why": "nothing was computed again"}
        made.append(row(f"method-{i:04d}", cells, params=params, **claimed))
    return board("large", made)
