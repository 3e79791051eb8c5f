"""Records of cells: what the schema takes, one file a row, small, and refused where they contradict each other."""

import json
from pathlib import Path
from typing import Any

import pytest
from made_records import record

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.runs.record import missing_cell
from spike4dgs.studies.results.records import key_of, measured, read_records, scores_of, with_finite, write_row

ROOT = Path(__file__).resolve().parents[3]


def test_records_come_back_and_a_row_has_one_file(tmp_path: Path) -> None:
    cells = [record(seed=seed, scene=scene) for seed in (1, 0) for scene in ("car-0-small", "bird-0-small")]
    other = record(row="tfp+stg", dirty=True)
    for row in ("spike4dgs-x+self-calibrated", "tfp+stg"):
        write_row(tmp_path, row, [*cells, other])
    assert read_records(tmp_path) == {key_of(r): r for r in (*cells, other)}
    text = (tmp_path / "spike4dgs-x+self-calibrated.json").read_text()
    lines = [json.loads(line.rstrip(",")) for line in text.splitlines()[1:-1]]
    assert [(r["seed"], r["scene"]) for r in lines] == sorted((r["seed"], r["scene"]) for r in cells)
    assert all(len(line) < 650 for line in text.splitlines())


def test_a_failed_cell_has_its_reason_and_no_metrics(tmp_path: Path) -> None:
    scores = scores_of(missing_cell("skipped", "no weights " * 100))
    failed = record(**scores)
    write_row(tmp_path, failed["row"], [failed])
    assert scores["metrics"] == {} and scores["fit_seconds"] is None and len(scores["error"]) == 300
    assert scores["error"].startswith("skipped: no weights no")
    assert measured(read_records(tmp_path)) == []


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_metric_that_is_not_finite_is_a_failure(value: float, tmp_path: Path) -> None:
    odd = with_finite(record(metrics={"psnr": 30.0, "flip": value}))
    write_row(tmp_path, odd["row"], [odd])
    (kept,) = read_records(tmp_path).values()
    assert kept["metrics"] == {} and kept["error"] == "failed: not finite: flip"
    assert with_finite(record()) == record()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"metrics": {"vmaf": 1.0}}, "metrics"),
        ({"metrics": {"psnr": None}}, "metrics/psnr"),
        ({"commit": "HEAD"}, "commit"),
        ({"knowledge": "some"}, "knowledge"),
        ({"dirty": False}, "dirty"),
        ({"extra": 1}, "extra"),
    ],
)
def test_a_record_of_another_form_is_refused(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    wrong = record(**changes)
    with pytest.raises(UserError, match=message):
        write_row(tmp_path, wrong["row"], [wrong])
    path = tmp_path / f"{wrong['row']}.json"
    path.write_text(json.dumps({"format": "spike4dgs-cells/1", "cells": [wrong]}))
    with pytest.raises(UserError, match=message):
        read_records(tmp_path)


def test_records_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    own = record()
    write_row(tmp_path, own["row"], [own, own])
    with pytest.raises(UserError, match="expected one record of turntable-0-small, seed 0, found two"):
        read_records(tmp_path)
    write_row(tmp_path, own["row"], [own])
    write_row(tmp_path, "tfp+stg", [record(row="tfp+stg", revision="ffffffffffff")])
    with pytest.raises(UserError, match="tfp.stg.json: expected revision 0123456789ab of turntable-0-small"):
        read_records(tmp_path)
    (tmp_path / "tfp+stg.json").rename(tmp_path / "tfi+stg.json")
    with pytest.raises(UserError, match="expected records of tfi.stg, found tfp.stg"):
        read_records(tmp_path)


def test_the_checkouts_records_are_read() -> None:
    read_records(ROOT / "studies" / "results" / "records")
