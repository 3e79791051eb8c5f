import csv
import json
import shutil
from pathlib import Path

import pytest
from dummy_methods import CountMethod, run
from PIL import Image
from scipy.stats import spearmanr

from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.runs.held_out import SPIKE_METRICS
from spike4dgs.cli import main
from spike4dgs.studies.spike_agreement import correlations, means, partner


def test_correlations_are_spearmans_and_deviances_count_backwards() -> None:
    rows = {"a": (20.0, 16.0, 3.0), "b": (30.0, 16.4, 1.0), "c": (28.0, 16.5, 2.0), "d": (35.0, 16.6, 0.1)}
    names = ("psnr", "spike_psnr_5", "spike_deviance")
    scores = {"s": {m: dict.fromkeys(METRICS) | dict(zip(names, row, strict=True)) for m, row in rows.items()}}
    found = correlations(scores)
    expected = spearmanr([r[0] for r in rows.values()], [r[1] for r in rows.values()]).statistic
    assert found["spike_psnr_5"]["s"] == pytest.approx(expected) == pytest.approx(0.8)
    assert found["spike_deviance"]["s"] == pytest.approx(1)
    assert found["spike_psnr_20"]["s"] is None and means(found)["spike_psnr_20"] is None
    del scores["s"]["a"], scores["s"]["b"]
    assert correlations(scores)["spike_psnr_5"]["s"] is None, "two methods have no order to speak of"


def test_a_run_becomes_a_table_and_a_plot(small_scene: Path, tmp_path: Path, capsys) -> None:
    data = tmp_path / "data"
    data.mkdir()
    shutil.move(small_scene, data / "pattern-0")
    methods = (CountMethod("fine"), CountMethod("rough", steps=1), CountMethod("mid", steps=2))
    run(tmp_path / "run", [data / "pattern-0"], *methods)
    shutil.copytree(tmp_path / "run/predictions/fine/pattern-0", tmp_path / "run/predictions/fine/unknown-0")
    out = tmp_path / "out"
    assert main(["spike-agreement", str(tmp_path / "run"), "--data", str(data), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "left out: fine on unknown-0" in said and "spike_psnr_20: " in said
    values = json.loads((out / "agreement.json").read_text())
    assert set(values["correlations"]) == set(SPIKE_METRICS)
    assert set(values["scores"]["pattern-0"]) == {"fine", "rough", "mid"}
    with open(out / "agreement.csv", newline="") as f:
        rows = {row["method"]: row for row in csv.DictReader(f)}
    assert float(rows["fine"]["spike_psnr_5"]) == values["scores"]["pattern-0"]["fine"]["spike_psnr_5"]
    table = (out / "agreement.md").read_text()
    assert all(f"`{metric}`" in table for metric in SPIKE_METRICS) and "| methods | 3 |" in table
    with Image.open(out / "agreement.png") as image:
        assert image.width > 1000 and len(set(image.convert("L").getdata())) > 50


def test_runs_without_predictions_are_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["spike-agreement", str(tmp_path), "--data", str(tmp_path), "--out", str(tmp_path / "o")]) == 2
    assert "expected predictions/METHOD/SCENE of scenes with ground truth" in capsys.readouterr().err


def test_a_method_of_two_runs_and_a_folder_that_is_not_there_are_refused(small_scene: Path, tmp_path, capsys) -> None:
    shutil.move(small_scene, tmp_path / "pattern-0")
    run(tmp_path / "run", [tmp_path / "pattern-0"], CountMethod("fine"))
    command = ["spike-agreement", str(tmp_path / "run"), "--data", str(tmp_path), "--out", str(tmp_path / "out")]
    twice = "expected one run of fine on pattern-0, found another one"
    for second, message in (("run", twice), ("typo", "no such folder")):
        assert main([*command[:2], str(tmp_path / second), *command[2:]]) == 2
        assert message in capsys.readouterr().err


def test_scores_of_the_moving_region_stand_beside_the_psnr_of_it() -> None:
    assert [partner(m) for m in ("spike_psnr_5", "spike_deviance_dynamic")] == ["psnr", "psnr_dynamic"]
