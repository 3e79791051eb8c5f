from __future__ import annotations

import csv
from pathlib import Path

import pytest

from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.studies.speed import metrics as speed_metrics


def test_every_metric_is_timed_and_flip_is_beside_its_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed_metrics, "SIZES", ((96, 192),))
    assert speed_metrics.metrics(["--repeats", "1", "--csv", str(tmp_path / "t.csv")]) == 0
    with open(tmp_path / "t.csv", newline="") as f:
        rows = list(csv.DictReader(f))
    ours = {r["metric"]: r for r in rows if r["by"] == "spike4dgs"}
    assert set(ours) == {m.id for m in METRICS.values() if not m.aligned}
    assert all(float(r["min ms"]) > 0 for r in rows)
    (package,) = (r for r in rows if r["by"] == "flip-evaluator")
    assert float(package["error"]) < 5e-6
