"""The table of results on the console: a row for each method, whatever its seeds gave."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from dummy_methods import CountMethod, run
from rich.console import Console

from spike4dgs.benchmark.reports.console import results_table, seeds_of_methods
from spike4dgs.benchmark.runs.record import missing_cell


def printed(records: list[dict[str, Any]]) -> str:
    console = Console(width=240)
    with console.capture() as capture:
        console.print(results_table(records))
    return capture.get()


def test_a_seed_that_failed_leaves_no_mean(small_scene: Path, tmp_path: Path) -> None:
    records = run(tmp_path, [small_scene], CountMethod(), seeds=3, metrics=("psnr",))
    values = [r["mean"]["psnr"] for r in records]
    assert f"{np.mean(values):.2f} ± {np.std(values, ddof=1):.2f}" in printed(records)
    failed = {**records[2], "scenes": {"pattern-0": missing_cell("failed", "no luck")}}
    text = printed([*records[:2], failed])
    assert text.count("counts") == 1 and "(failed)" in text and "±" not in text.partition("higher")[0]
    assert f"{values[0]:.2f}" in printed(records[:1]) and "±" not in printed(records[:1])


def test_records_of_another_budget_or_with_other_parameters_are_rows_of_their_own() -> None:
    def record(seed: int, budget: float | None, **params: Any) -> dict[str, Any]:
        cell = {"status": "failed" if budget is None else "ok", "budget": budget}
        return {"method": {"name": "m", "seed": seed, "params": params}, "scenes": {"s": cell}}

    records = [record(0, 1.0), record(1, None), record(0, 0.5), record(2, 1.0), record(0, 1.0, steps=3)]
    assert seeds_of_methods(records) == [[records[0], records[1], records[3]], [records[2]], [records[4]]]
