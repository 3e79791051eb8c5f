from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from dummy_methods import CountMethod, FailingMethod
from submissions import board, edit, enter, read

from spike4dgs.benchmark import plugins
from spike4dgs.benchmark.errors import UserError


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """A package that registers the methods of the finished run; a test may put others in their place."""
    methods: dict[str, Any] = {m.name: m for m in (CountMethod("tfp+4dgs"), CountMethod("rough", steps=1))}
    entry = SimpleNamespace(name="theirs", value="theirs:METHODS", dist=None, load=lambda: methods)
    monkeypatch.setattr(plugins, "entry_points", lambda group: [entry])
    return methods


def test_a_second_fit_is_compared_and_its_costs_stand_beside_the_claimed_ones(
    done: Path, installed: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    submitted = read(enter(done))["submitted"]
    entry = read(enter(done, refit=True))
    assert installed["tfp+4dgs"].fits == 2
    refit = entry["verification"]["refit"]
    claimed = {scene: cell["metrics"]["psnr"] for scene, cell in entry["record"]["scenes"].items()}
    assert (entry["verification"]["label"], entry["submitted"]) == ("re-fitted", submitted)
    assert refit["psnr"] == pytest.approx(claimed) and refit["bit_equal"] is True
    (row,) = board(done)["boards"][0]["rows"]
    costs = row["costs"]["fit_seconds"]
    assert row["label"] == "re-fitted" and costs["re-fitted"] == pytest.approx(
        sum(c["fit_seconds"] for c in refit["costs"].values())
    )
    assert costs["claimed"] != costs["re-fitted"]
    assert "tfp+4dgs: re-fitted, rank 1 of 1" in capsys.readouterr().out
    assert not list((done / "board/.refit").iterdir())


def test_a_score_that_the_method_does_not_reach_is_refused(done: Path, installed: dict[str, Any]) -> None:
    class Worse(CountMethod):
        def fit(self, scene: Any, request: Any) -> Any:
            model = super().fit(scene, request)
            model.image = 0.9 * model.image
            return model

    installed["tfp+4dgs"] = Worse("tfp+4dgs")
    with pytest.raises(UserError, match=r"on pattern-0: expected a second fit within 0\.3 dB of the claimed"):
        enter(done, refit=True)
    assert not (done / "board/local").exists()


@pytest.mark.parametrize(
    ("method", "message"),
    [
        (CountMethod("tfp+4dgs", steps=3), "expected the installed method as in the record, found another params"),
        (FailingMethod("tfp+4dgs", ValueError("no luck")), "no luck"),
        (None, "expected one of rough"),
    ],
)
def test_what_cannot_be_fitted_again_is_refused(
    done: Path, installed: dict[str, Any], method: CountMethod | None, message: str
) -> None:
    del installed["tfp+4dgs"]
    if method:
        method.params = {"steps": 4} if isinstance(method, FailingMethod) else method.params
        installed["tfp+4dgs"] = method
    with pytest.raises(UserError, match=message):
        enter(done, refit=True)


def test_a_second_fit_needs_the_files(done: Path, installed: dict[str, Any]) -> None:
    with pytest.raises(UserError, match=r"--refit: expected predictions and scenes .* found no --predictions"):
        enter(done, verified=False, refit=True)


def test_the_second_fit_has_the_records_seed(done: Path, installed: dict[str, Any]) -> None:
    edit(done / "out/results/tfp+4dgs.json", lambda r: r["method"].update(seed=None))
    for info in (done / "out/predictions/tfp+4dgs").glob("*/prediction.json"):
        edit(info, lambda p: p["method"].update(seed=None))
    with pytest.raises(UserError, match="a scored cell with budget and seed"):
        enter(done, refit=True)
