from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changes import edit_json, files_in
from dummy_methods import CountMethod, FailingMethod, run
from made_season import NUMBER, Made

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import locked
from spike4dgs.benchmark.method import Budget
from spike4dgs.benchmark.runs.predictions import open_predictions
from spike4dgs.benchmark.runs.run import Settings
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.cli.season import check, predict, reveal, score
from spike4dgs.leaderboard.season.results import predict_all, read_results, table_text, write_result
from spike4dgs.leaderboard.season.secret_folder import open_committed, scene_folder, training_folder


def test_scores_are_those_of_whole_scenes(scored_once: Made, tmp_path: Path) -> None:
    """The same method, fitted on the whole scenes by `run-benchmark`, has the same scores to the last bit."""
    whole = [scene_folder(scored_once.secret, s.id) for s in scored_once.season.scenes]
    expected = run(tmp_path / "out", whole, CountMethod("counts"), CountMethod("rough", steps=1), budget=Budget(0.5))
    found = {r.name: r.record for r in read_results(scored_once.seasons, scored_once.season)}
    for record in expected:
        mine = found[record["method"]["name"]]
        assert mine["mean"] == record["mean"] and mine["dataset"] == record["dataset"]


def test_the_psnr_is_that_of_the_files(scored_once: Made) -> None:
    (result,) = (r for r in read_results(scored_once.seasons, scored_once.season) if r.name == "counts")
    for scene in (open_scene(scene_folder(scored_once.secret, s.id)) for s in scored_once.season.scenes):
        predictions = open_predictions(scored_once.root / "runs/predictions/counts" / scene.id, scene.targets)
        values = []
        for t in scene.targets:  # linear radiance, clipped to [0, 1]
            a, b = (np.clip(x.astype(np.float64), 0, 1) for x in (scene.ground_truth(t), predictions.read(t)))
            values.append(-10 * np.log10(np.mean((a - b) ** 2)))
        assert result.record["scenes"][scene.id]["metrics"]["psnr"] == pytest.approx(np.mean(values), abs=1e-6)


def test_the_table_is_ordered_by_psnr_and_has_means_over_scenes(scored_once: Made) -> None:
    results = read_results(scored_once.seasons, scored_once.season)
    psnr = [r.record["mean"]["psnr"] for r in results]
    assert psnr == sorted(psnr, reverse=True) and len(psnr) == 2
    slow = replace(results[1], record=copy.deepcopy(results[1].record))
    for seconds, cell in zip((100.0, 200.0), slow.record["scenes"].values(), strict=True):
        cell["fit_seconds"] = seconds
    text = table_text(scored_once.season, [results[0], slow])
    header, _, *rows = [line for line in text.splitlines() if line.startswith("|")]
    assert header.startswith("| order | method |") and "2 scenes do not tell near rows apart." in text
    assert [row.split(" | ")[:4] for row in rows] == [
        [f"| {i}", r.name, "predictions", f"{r.record['mean']['psnr']:.2f}"] for i, r in enumerate(results, start=1)
    ]
    assert header.endswith("| fit, s |") and rows[1].endswith("| 150 |"), "seconds a scene"
    assert (scored_once.public / "table.md").read_text() == table_text(scored_once.season, results)


def test_half_a_result_of_a_killed_process_is_none(scored: Made) -> None:
    (scored.public / "results/.counts.77.part.json").write_text('{"schema":')
    assert {r.name for r in read_results(scored.seasons, scored.season)} == {"counts", "rough"}
    assert scored.score("counts", "rough") == 0
    assert check(NUMBER, seasons=scored.seasons, scenes=None, predictions=None) == 0


@pytest.mark.parametrize("name", ["Counts", "co.unts", "COUNTS_"])
def test_a_name_that_is_written_in_another_way_is_the_same(scored_once: Made, name: str) -> None:
    (result,) = (r for r in read_results(scored_once.seasons, scored_once.season) if r.name == "counts")
    record = {**result.record, "method": {**result.record["method"], "name": name}}
    with pytest.raises(UserError, match="a name that differs in letters or digits, found counts"):
        write_result(scored_once.seasons, NUMBER, replace(result, record=record))


def test_a_name_is_scored_once(scored: Made, said: Any) -> None:
    before = files_in(scored.seasons)
    assert scored.score("counts") == 0 and files_in(scored.seasons) == before
    said()
    tuned = CountMethod("counts", steps=2)
    scenes = open_committed(scored.secret, scored.season, training=True)
    predict_all(scenes, [tuned], Settings(scored.root / "runs", budget=Budget()))
    assert scored.score("counts") == 1 and files_in(scored.seasons) == before
    assert "a name is scored once in a season: submit under another one" in said()


def test_one_participants_mistake_does_not_stop_another(made: Made, said: Any) -> None:
    folder = made.root / "runs/predictions/counts/car-9003-tiny"
    edit_json(folder / "prediction.json", lambda p: p.update(scene_revision="0" * 64))
    assert made.score("counts", "rough") == 1
    assert "expected predictions for scene revision" in said()
    assert [r.name for r in read_results(made.seasons, made.season)] == ["rough"]


def test_what_a_killed_fit_left_half_written_goes_and_predictions_stay(made: Made) -> None:
    folder = made.root / "runs/predictions/counts"
    before, left = files_in(folder), folder / "car-9003-tiny/.prediction.4711.part.json"
    left.write_text("{")
    made.predict(CountMethod("counts"))
    assert files_in(folder) == before


def test_a_scene_without_predictions_is_not_left_out(made: Made) -> None:
    (made.root / "runs/predictions/counts/car-9003-tiny").rename(made.root / "elsewhere")
    assert made.score("counts", "rough") == 0
    results = read_results(made.seasons, made.season)
    assert [r.name for r in results] == ["rough", "counts"]
    assert results[1].record["mean"]["psnr"] is None
    assert "\n| - | counts | predictions | - |" in (made.public / "table.md").read_text()


def test_a_method_gets_the_training_part_alone(once: Made, tmp_path: Path) -> None:
    seen = []

    class Looking(CountMethod):
        def fit(self, scene: Any, request: Any) -> Any:
            seen.append((scene.revision, request.budget.scale))
            return super().fit(scene, request)

    predict_all(open_committed(once.secret, once.season, training=True), [Looking("l")], Settings(tmp_path / "out"))
    assert [r for r, _ in seen] == [s.training_revision for s in once.season.scenes]


@pytest.mark.usefixtures("installed")
def test_installed_methods_are_run_and_scored(made: Made) -> None:
    assert score(NUMBER, secret=made.secret, seasons=made.seasons, methods=("rough",), device="cpu") == 0
    (result,) = read_results(made.seasons, made.season)
    assert (result.name, result.submitted_as) == ("rough", "method")
    assert {cell["budget"] for cell in result.record["scenes"].values()} == {0.02}


def test_no_method_is_no_prediction(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="--methods: expected names of methods, found none"):
        predict((tmp_path,), methods=(), out=tmp_path / "out")


def test_a_failing_method_is_named(once: Made, tmp_path: Path) -> None:
    scenes = open_committed(once.secret, once.season, training=True)
    bad = FailingMethod("bad", ValueError("no luck"))
    assert predict_all(scenes, [bad, CountMethod("good")], Settings(tmp_path / "out")) == {"bad"}
    assert "no luck" in (tmp_path / "out/logs/bad__car-9003-tiny.log").read_text()
    assert (tmp_path / "out/predictions/good/car-9003-tiny").is_dir()


def test_two_processes_do_not_score_one_season(once: Made) -> None:
    message = "expected a folder in which nobody else scores, found a run in progress"
    with locked(once.secret / ".lock", "x", "free"), pytest.raises(UserError, match=message):
        once.score("counts")
    assert not read_results(once.seasons, once.season)


def test_nothing_is_scored_after_the_reveal(scored: Made) -> None:
    assert reveal(NUMBER, secret=scored.secret, seasons=scored.seasons) == 0
    with pytest.raises(UserError, match="expected a season whose seeds are secret, found revealed ones"):
        scored.score("counts")


def test_nothing_to_score_is_an_error_and_hidden_streams_take_methods_only(made: Made) -> None:
    with pytest.raises(UserError, match="expected --predictions or --methods, found neither"):
        made.score()
    edit_json(made.public / "season.json", lambda s: s.update(streams="hidden"))
    with pytest.raises(UserError, match="expected a season with published streams"):
        made.score("counts")


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("folder", [scene_folder, training_folder])
def test_another_scene_than_the_committed_one_is_not_scored(folder: Any, made: Made) -> None:
    key = "revision" if folder is scene_folder else "training_revision"
    edit_json(made.public / "season.json", lambda season: season["scenes"][1].update({key: "0" * 64}))
    with pytest.raises(UserError, match=r"turntable-9003-tiny: expected revision 0000.*, as committed"):
        score(NUMBER, secret=made.secret, seasons=made.seasons, methods=("rough",), device="cpu")
