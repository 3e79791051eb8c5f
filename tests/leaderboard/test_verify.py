from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from changes import edit_json, exchange, flip_bit
from dummy_methods import CountMethod, run
from nosy_methods import Darker
from submissions import board, edit_with_ledger, enter, entry_of, files_of, raise_metric, read, refitted, submit

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import MOST_BYTES, write_json
from spike4dgs.benchmark.metrics.iqa.metaiqa import metaiqa_network
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.runs.predictions import INFO, SUMS
from spike4dgs.benchmark.scene.images import write_exr
from spike4dgs.benchmark.weights import METAIQA, VARIABLE
from spike4dgs.cli.score import score
from spike4dgs.cli.verify_leaderboard import verify_leaderboard
from spike4dgs.leaderboard import tracks, verify, verify_entries
from spike4dgs.leaderboard.truth_check import TruthCheck, check_truth


def test_rounding_below_the_tolerance_is_no_forgery(done: Path) -> None:
    edit_json(done / "out/results/tfp+4dgs.json", lambda record: raise_metric(record, "psnr", 1e-7))
    assert read(enter(done))["verification"]["label"] == "re-scored"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: raise_metric(r, "psnr", 0.01), r"scene pattern-0, cam_03/0000\d0: expected psnr = .* as computed"),
        (lambda r: r["scenes"]["pattern-0"].update(predictions_sha256="0" * 64), "expected predictions 00000000"),
        (lambda r: r["scenes"]["pattern-1"].update(fit_seconds=1e-3), "expected fit_seconds"),
        (lambda r: r["sensors"].update({"pattern-1": "noisy"}), "pattern-1: expected sensor not stated, found noisy"),
        (lambda r: r["scenes"]["pattern-1"].update(gain_aligned=7.0), "expected gain_aligned"),
        (lambda r: r["method"].update(params={"steps": 1}), "as in the record"),
        (lambda r: r["dataset"]["scenes"].update({"pattern-0": "1" * 64}), "expected scene revision 1111111111111111"),
        (lambda r: r["mean"].update(psnr=99.0), "expected psnr ="),
        (lambda r: r["scenes"]["pattern-0"]["per_image"].pop("cam_03/000020"), "the mean of its parts"),
        (lambda r: r.update(surprise=1), "'surprise' was unexpected"),
    ],
)
def test_records_that_the_files_contradict_are_refused(done: Path, change: Any, message: str) -> None:
    edit_json(done / "out/results/tfp+4dgs.json", change)
    with pytest.raises(UserError, match=message) as e:
        enter(done)
    assert "\n" not in str(e.value) and not (done / "board").exists()


def test_an_exchanged_truth_is_refused(done: Path) -> None:
    gray = np.full((24, 40), 0.5, np.float32)
    exchange(done / "s0", "images/cam_03/000040.exr", lambda path: write_exr(path, gray, 2000.0))
    with pytest.raises(UserError, match=r"images/cam_03/000040\.exr: expected content"):
        enter(done)


def test_other_damaged_and_missing_files_are_refused_by_name(done: Path) -> None:
    folder = done / "out/predictions/tfp+4dgs/pattern-1"
    with pytest.raises(UserError, match="nowhere: expected a predictions folder"):
        enter(done, predictions=done / "nowhere")
    with pytest.raises(UserError, match="nowhere: expected a scene folder"):
        enter(done, scenes=(done / "nowhere",))
    with pytest.raises(UserError, match=r"nothing\.json: expected a spike4dgs-result/1 record, found no such file"):
        submit(done / "nothing.json", leaderboard=done / "board")
    with pytest.raises(UserError, match="give the predictions that were scored"):
        enter(done, predictions=done / "out/predictions/rough")
    flip_bit(folder / "cam_03/000040.exr", -1)
    with pytest.raises(UserError, match=r"pattern-1/cam_03/000040\.exr: expected sha256"):
        enter(done)
    shutil.rmtree(folder)
    with pytest.raises(UserError, match="pattern-1: expected a predictions folder"):
        enter(done)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"predictions": Path("typo")}, "typo: expected a folder of predictions, METHOD/SCENE, found no such folder"),
        ({"predictions": Path(".")}, "--predictions: expected --scenes beside it"),
        ({"scenes": (Path("s0"),)}, "--scenes: expected --predictions beside it"),
        ({"refit": True}, "--refit: expected --predictions and --scenes beside it"),
        ({"container": "env"}, "--container: expected --refit beside it"),
    ],
)
def test_options_that_would_verify_nothing_are_refused(done: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        verify_leaderboard(done / "board", **options)


@pytest.fixture(scope="module")
def random_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / METAIQA.name
    torch.save(metaiqa_network().state_dict(), path)
    return path


@pytest.fixture
def weights(random_weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine that has weights for MetaIQA (random ones) and nothing else."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setenv(VARIABLE, str(random_weights.parent))
    return random_weights


def test_scores_that_need_weights_are_checked_with_these_and_else_stay_as_claimed_and_are_listed(
    done: Path, weights: Path, monkeypatch: pytest.MonkeyPatch, said: Any
) -> None:
    run(done / "out", [done / "s0", done / "s1"], CountMethod("with"))
    result = done / "out/results/with.json"
    honest = result.read_bytes()
    edit_json(result, lambda record: raise_metric(record, "metaiqa", 0.25))
    with pytest.raises(UserError, match="expected metaiqa = .* as computed from the files"):
        enter(done, "with")
    (done / "other").mkdir()
    state = torch.load(weights, weights_only=True)
    torch.save({name: tensor + 0.01 for name, tensor in state.items()}, done / "other" / METAIQA.name)
    monkeypatch.setenv(VARIABLE, str(done / "other"))
    assert read(enter(done, "with"))["verification"]["unverified"] == ["metaiqa"], "other weights say nothing"
    shutil.rmtree(done / "board")
    result.write_bytes(honest)
    monkeypatch.delenv(VARIABLE)
    entry = read(enter(done, "with", verified=False))
    assert set(entry["verification"]["unverified"]) == {*METRICS} - {"lpips_alex", "lpips_vgg", "lpips_squeeze"}
    said()
    entry = read(enter(done, "with"))
    assert (entry["verification"]["label"], entry["verification"]["unverified"]) == ("re-scored", ["metaiqa"])
    assert entry["record"]["mean"]["metaiqa"] > 0 and board(done)["boards"][0]["rows"][0]["unverified"] == ["metaiqa"]
    assert "with: re-scored (as claimed, not computed again: metaiqa), place 1" in said()
    monkeypatch.setenv(VARIABLE, str(weights.parent))
    path = enter(done, "with")
    assert read(path)["verification"]["unverified"] == []
    before = path.read_bytes()
    monkeypatch.delenv(VARIABLE)
    assert enter(done, "with").read_bytes() == before, "what was verified stays so"


@pytest.mark.usefixtures("weights")
def test_more_weights_than_the_claimants_do_no_harm(done: Path) -> None:
    assert read(enter(done))["verification"]["unverified"] == []


def test_predictions_of_another_program_are_scored_and_verified(done: Path) -> None:
    """No key, no environment, no times: a folder written with other tools."""
    theirs = done / "theirs"
    for scene in ("pattern-0", "pattern-1"):
        folder = theirs / scene
        shutil.copytree(done / "out/predictions/rough" / scene, folder)
        smallest = {"schema": "spike4dgs-prediction/1", "method": {"name": "theirs"}, "scene": scene}
        (folder / INFO).write_text(json.dumps(smallest))
        lines = (folder / SUMS).read_text().splitlines(keepends=True)
        (folder / SUMS).write_text("".join(reversed(lines)))
    scenes = (done / "s0", done / "s1")
    assert score(theirs, scenes, out=done / "theirs.json") == 0
    assert submit(done / "theirs.json", predictions=theirs, scenes=scenes, leaderboard=done / "board") == 0
    assert read(entry_of(done, "theirs"))["verification"]["label"] == "re-scored"
    (row,) = board(done)["boards"][0]["rows"]
    ours = json.loads((done / "out/results/rough.json").read_text())
    assert row["rank"] == 1 and row["costs"]["fit_seconds"]["claimed"] is None and row["mean"] == ours["mean"]


def test_what_submit_writes_has_no_problems(done: Path, released: None, said: Any, problems: Any) -> None:
    enter(done)
    enter(done, "bad", verified=False)
    assert not problems(done)
    assert verify_leaderboard(done / "board", **files_of(done)) == 0
    assert "release 2, 2 entries, 1 scored again, no problems" in said()


def test_entries_of_other_seeds_and_other_scenes_of_the_same_names_are_passed_over(entered: Path, said: Any) -> None:
    """They are honest, and what was given is not theirs: a line says why."""
    record = entered / "out/results/tfp+4dgs.json"
    forged = json.loads(record.read_text())
    for name, change in (
        ("seed", lambda: forged["method"].update(seed=1)),
        ("scene", lambda: forged["dataset"]["scenes"].update({"pattern-0": "0" * 64})),
    ):
        forged["method"]["seed"] = 0
        change()
        (entered / f"{name}.json").write_text(json.dumps(forged))
        assert submit(entered / f"{name}.json", leaderboard=entered / "board") == 0
    said()
    assert verify_leaderboard(entered / "board", **files_of(entered)) == 0
    lines = said()
    assert "3 entries, 1 scored again" in lines
    assert "tfp+4dgs@seed-1.json: predictions of seed 0, the entry has 1" in lines
    assert lines.count("passed over: ") == 2 and "tfp+4dgs.json: other revisions of pattern-0" in lines
    some = {**files_of(entered), "scenes": files_of(entered)["scenes"][:1]}
    assert verify_leaderboard(entered / "board", **some) == 1, "nothing was scored"
    lines = said()
    assert "tfp+4dgs.json: pattern-1 not among --scenes" in lines
    assert "expected predictions METHOD/SCENE of an entry, and its scenes, found none" in lines
    shutil.rmtree(entered / "out/predictions/tfp+4dgs/pattern-1")
    verify_leaderboard(entered / "board", **files_of(entered))
    assert "tfp+4dgs.json: no predictions of pattern-1" in said()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: e["verification"].update(unverified=["psnr"]), "LEDGER"),
        (lambda e: e.update(submitted="2001-01-01T00:00:00Z"), "LEDGER"),
        (lambda e: e["record"].update(command="x"), "LEDGER"),
        (lambda e: e["verification"].update(label="best"), "at verification/label"),
    ],
)
def test_every_edit_by_hand_is_named(entered: Path, change: Any, message: str, problems: Any) -> None:
    edit_json(entry_of(entered), change)
    lines = problems(entered)
    assert any("tfp+4dgs.json" in line and message in line for line in lines)
    assert any("local.json: expected what the entries give" in line for line in lines), "its row is gone"


def test_boards_follow_from_the_entries(entered: Path, problems: Any) -> None:
    edit_json(entered / "board/local.json", lambda b: b["boards"][0]["rows"][0].update(rank=None))
    (line,) = problems(entered)
    assert "local.json: expected what the entries give" in line
    path = enter(entered)
    path.rename(path.with_name("other.json"))
    assert any("other.json: expected the entry of" in line for line in problems(entered))


def edit_truth(**changes: Any) -> Any:
    return lambda entry: entry["verification"]["truth"]["pattern-0"].update(changes)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: raise_metric(e["record"], "psnr", 1), "scene pattern-0, .* as computed from the files"),
        (edit_truth(equal_pixels=0.0), r"scene pattern-0: expected equal_pixels 0\.\d+, as computed again, found 0\.0"),
        (lambda e: e["verification"].update(unverified=["psnr"]), "no unverified metric that these files give"),
        (lambda e: e["verification"]["truth"].pop("pattern-1"), "expected a check beside the truth of each scored"),
        (refitted({"pattern-0": 20.0}), "expected a second fit of pattern-0, patt"),
        (refitted({"pattern-0": 90.0, "pattern-1": 90.0}), "found 90.00 dB"),
    ],
)
def test_an_edit_that_agrees_with_itself_is_found_with_the_files(
    entered: Path, problems: Any, change: Any, message: str
) -> None:
    """Scores, truth check or label edited together with ledger and board: what was recomputed is compared."""
    edit_with_ledger(entry_of(entered), change)
    enter(entered, "bad", verified=False)  # writes the boards anew, and costs no scores
    assert not problems(entered)
    lines = problems(entered, **files_of(entered))
    assert len(lines) == 1 and "tfp+4dgs.json" in lines[0] and re.search(message, lines[0]), lines


def test_an_edited_entry_is_mended_as_its_line_says(entered: Path, problems: Any) -> None:
    edit_with_ledger(entry_of(entered), edit_truth(equal_images=1))
    (line,) = (line for line in problems(entered, **files_of(entered)) if "local.json" not in line)
    assert "expected equal_images 0, as computed again, found 1" in line
    enter(entered, replace=True)
    assert not problems(entered, **files_of(entered))
    before = entry_of(entered).read_bytes()
    enter(entered, replace=True)
    assert entry_of(entered).read_bytes() == before, "the same check again changes nothing"


def test_a_metric_whose_files_were_missing_is_no_edit(done: Path, problems: Any, said: Any) -> None:
    """As scenes come that were downloaded without their held-out streams."""
    streams = [(done / name / "spikes/cam_03.dat", done / f"{name}.dat") for name in ("s0", "s1")]
    for stream, away in streams:
        stream.rename(away)
    enter(done)
    assert "(as claimed, not computed again: spike_psnr_5, " in said()
    assert not problems(done, **files_of(done))
    for stream, away in streams:
        away.rename(stream)
    (line,) = problems(done, **files_of(done))
    assert "expected no unverified metric that these files give, found spike_deviance, " in line
    enter(done)
    assert not problems(done, **files_of(done))


def test_a_forged_metric_whose_weights_are_not_here_is_named(
    entered: Path, monkeypatch: pytest.MonkeyPatch, said: Any
) -> None:
    weights = METRICS["lpips_alex"].weights
    assert weights

    def forge(entry: dict[str, Any]) -> None:
        for cell in entry["record"]["scenes"].values():
            cell["computed"]["lpips_alex"] = weights.sha256
            del cell["notes"]["lpips_alex"]
            for values in (*cell["per_image"].values(), cell["metrics"], entry["record"]["mean"]):
                values["lpips_alex"] = 1e-4

    monkeypatch.setenv("TORCH_HOME", str(entered / "torch"))
    edit_with_ledger(entry_of(entered), forge)
    enter(entered, "bad", verified=False)  # writes the boards anew
    said()
    assert verify_leaderboard(entered / "board", **files_of(entered)) == 0
    named = "tfp+4dgs.json: says that lpips_alex was computed again; its weights or files are not here"
    assert f"not checked: {entry_of(entered).parent}/{named}" in said()


def test_a_large_board_is_read(entered: Path, monkeypatch: pytest.MonkeyPatch, problems: Any) -> None:
    text = "x" * MOST_BYTES
    monkeypatch.setattr(verify_entries, "make_boards", lambda reading: {"local": {"title": text}})
    (entered / "board/leaderboard.json").unlink()
    write_json(entered / "board/local.json", {"title": text})
    assert not problems(entered)
    write_json(entered / "board/local.json", {"title": 3 * text})
    (line,) = problems(entered)
    assert "local.json: expected a board, " in line


def test_flags_that_an_edit_hid_are_found(entered: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A noise share that was edited, or removed as if nobody had measured it."""
    edit_with_ledger(entry_of(entered), edit_truth(noise_share=0.0, noise_share_error=0.01, ceiling_db=60.0))
    enter(entered, "rough")

    def check(share: float) -> tuple[str, ...]:
        def measured(*args: Any) -> TruthCheck:
            return replace(check_truth(*args), noise_share=share, noise_share_error=0.01, ceiling_db=60.0)

        monkeypatch.setattr(verify, "check_truth", measured)
        return verify_entries.verify_leaderboard(entered / "board", **files_of(entered)).problems

    assert not check(0.001)
    found = check(0.5)
    assert len(found) == 2, "rough states none, tfp+4dgs another share"
    assert all("expected the flags carries the truth's noise (pattern-0, pattern-1)" in line for line in found)


def test_a_label_that_a_second_fit_does_not_bear_out_is_found(
    done: Path, installed: dict[str, Any], said: Any, problems: Any
) -> None:
    """Of one scene, as each fit takes a process."""
    run(done / "one", [done / "s1"], CountMethod("tfp+4dgs"), metrics=("psnr",))
    result, files = done / "one/results/tfp+4dgs.json", {"scenes": (done / "s1",), "leaderboard": done / "board"}
    assert submit(result, predictions=done / "one/predictions/tfp+4dgs", **files) == 0
    edit_with_ledger(entry_of(done), refitted({"pattern-1": json.loads(result.read_text())["mean"]["psnr"]}))
    enter(done, "bad", verified=False)  # writes the boards anew
    given = {"predictions": done / "one/predictions", "scenes": (done / "s1",)}
    said()
    assert verify_leaderboard(done / "board", **given) == 0
    assert "1 scored again, 1 labelled re-fitted and not fitted again (--refit), no problems" in said()
    assert verify_leaderboard(done / "board", **given, refit=True) == 0
    installed["tfp+4dgs"] = Darker("tfp+4dgs")
    (line,) = problems(done, **given, refit=True)
    assert "expected a second fit within 0.3 dB of the claimed" in line


def test_the_committed_leaderboard_has_no_problems_and_its_boards_follow_from_its_entries(said: Any) -> None:
    tracks.read_release.cache_clear()
    assert verify_leaderboard(Path(__file__).resolve().parents[2] / "leaderboard") == 0
    assert "no problems" in said()
