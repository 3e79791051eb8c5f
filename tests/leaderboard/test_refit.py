from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from nosy_methods import Refines
from rich.console import Console
from submissions import Record

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.runs.apart.fit import Apart
from spike4dgs.benchmark.runs.run import Settings
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.leaderboard import refit
from spike4dgs.leaderboard.refit import Refit, fit_again

FitAgain = Callable[[Record, Any], Refit]


@pytest.fixture
def again(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, installed: dict[str, Any]) -> FitAgain:
    """A second fit of a record that gives what a change makes of its cells."""
    scenes = [open_scene(finished / name) for name in ("s0", "s1")]

    def fit(record: Record, change: Any) -> Refit:
        def run_matrix(of: list[Scene], methods: Any, settings: Settings, console: Console) -> list[Record]:
            made = copy.deepcopy(record)
            settings.out.mkdir(parents=True)
            assert settings.refined is (None if record["method"]["name"].endswith(".refined") else False)
            assert set(settings.metrics) == set(record["scenes"][of[0].id]["computed"])
            change(made["scenes"][of[0].id]["metrics"])
            return [made]

        monkeypatch.setattr(refit, "run_matrix", run_matrix)
        return fit_again(record, scenes, tmp_path / "work", Console(), Apart())

    return fit


@pytest.fixture
def record(finished: Path) -> Record:
    return json.loads((finished / "out/results/tfp+4dgs.json").read_text())


@pytest.mark.parametrize(
    ("metric", "factor", "message"),
    [
        ("psnr_dynamic", 0.9, r"on pattern-0: expected a second fit within 0\.6 dB of the claimed psnr_dynamic"),
        ("ssim_dynamic", 0.5, r"expected a second fit within 0\.\d+ of the claimed ssim_dynamic"),
        ("flip", 1.2, r"expected a second fit within 0\.\d+ of the claimed flip"),
        ("temporal_error", 1.2, "of the claimed temporal_error"),
        ("spike_psnr_20", 0.9, r"within 0\.3 dB of the claimed spike_psnr_20"),
        ("ssim", None, "of the claimed ssim .*, found -"),
    ],
)
def test_a_second_fit_reaches_every_metric_that_was_computed(
    again: FitAgain, record: Record, metric: str, factor: float | None, message: str
) -> None:
    """Images that were forged where things move have the PSNR of an honest fit, and no other metric of it."""
    with pytest.raises(UserError, match=message):
        again(record, lambda m: m.update({metric: factor and m[metric] * factor}))


def test_a_second_fit_says_which_metrics_were_compared(again: FitAgain, record: Record) -> None:
    found = again(record, lambda m: m.update(psnr=m["psnr"] - 0.2, ssim=m["ssim"] * 0.99))
    assert {"psnr", "psnr_dynamic", "flip", "spike_deviance"} <= set(found.metrics)
    assert set(found.metrics) == set(record["scenes"]["pattern-0"]["computed"])


def test_a_second_fit_of_refined_scores_alone_gets_the_held_out_views(
    again: FitAgain, record: Record, installed: dict[str, Any], tmp_path: Path
) -> None:
    """A method may keep what it gets, and its next fit find it."""
    installed["refines"] = Refines(tmp_path / "seen.json")
    for name in ("refines", "refines.refined"):
        assert again({**record, "method": {**record["method"], "name": name}}, lambda m: None).psnr
