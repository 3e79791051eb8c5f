from __future__ import annotations

import copy
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from dummy_methods import CountMethod, FailingMethod, run
from small_scenes import write_small_scene

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import write_json
from spike4dgs.benchmark.metrics.iqa.metaiqa import metaiqa_network
from spike4dgs.benchmark.metrics.table import METRICS, PRIMARY
from spike4dgs.benchmark.results.predictions import INFO, SUMS
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.benchmark.weights import METAIQA, VARIABLE
from spike4dgs.leaderboard import submit as module
from spike4dgs.leaderboard.submit import rank, read_entry, submit, write_leaderboard

Record = dict[str, Any]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes, and a run of two methods and a failing one on them."""
    root = tmp_path_factory.mktemp("finished")
    scenes = [write_small_scene(root / f"s{i}", seed=i) for i in range(2)]
    methods = (CountMethod("tfp+4dgs"), CountMethod("rough", steps=1), FailingMethod("bad", ValueError("no luck")))
    run(root / "out", scenes, *methods)
    return root


@pytest.fixture
def done(finished: Path, tmp_path: Path) -> Path:
    """A copy of the run that a test may damage."""
    return Path(shutil.copytree(finished, tmp_path / "run"))


def enter(done: Path, name: str = "tfp+4dgs", verified: bool = True, **options: Any) -> Path:
    """Submit a method's record; returns its entry."""
    if verified:
        options = {
            "predictions": done / "out/predictions" / name,
            "scenes": (done / "s0", done / "s1"),
            **options,
        }
    assert submit(done / f"out/results/{name}.json", leaderboard=done / "board", **options) == 0
    return next((done / "board/entries").glob(f"*/{name}.json"))


def edit(path: Path, change: Any) -> None:
    data = json.loads(path.read_text())
    change(data)
    write_json(path, data)


def everything(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def board(done: Path) -> dict[str, Any]:
    return json.loads((done / "board/leaderboard.json").read_text())


def test_with_files_an_entry_is_verified(done: Path, capsys: pytest.CaptureFixture[str]) -> None:
    entry = read_entry(enter(done))
    assert entry["label"] == "verified"
    assert entry["record"] == json.loads((done / "out/results/tfp+4dgs.json").read_text())
    assert capsys.readouterr().out == "tfp+4dgs: verified, rank 1 of 1 on pattern-0+pattern-1\n"


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ((), "no --predictions"),
        (("scenes",), "no --predictions"),
        (("predictions",), "no --scenes for pattern-0, pattern-1"),
        (("predictions", "one"), "no --scenes for pattern-1"),
    ],
)
def test_without_files_an_entry_is_self_reported(
    done: Path, given: tuple[str, ...], reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    options: dict[str, Any] = {"predictions": done / "out/predictions/tfp+4dgs"} if "predictions" in given else {}
    options |= {"scenes": (done / "s0", done / "s1")} if "scenes" in given else {}
    options |= {"scenes": (done / "s0",)} if "one" in given else {}
    assert read_entry(enter(done, verified=False, **options))["label"] == "self-reported"
    assert f"self-reported ({reason}), rank 1" in capsys.readouterr().out


def test_submitting_twice_changes_nothing(done: Path) -> None:
    enter(done)
    before = everything(done / "board")
    enter(done)
    assert everything(done / "board") == before
    enter(done, verified=False)
    assert everything(done / "board") == before, "a verified entry stays so"


def test_scoring_again_is_the_same_record(done: Path) -> None:
    enter(done)
    before = everything(done / "board")
    edit(done / "out/results/tfp+4dgs.json", lambda r: r.update(created="2031-01-01T00:00:00Z", command="another"))
    enter(done)
    assert everything(done / "board") == before


def test_a_self_reported_entry_can_be_verified_later(done: Path) -> None:
    submitted = read_entry(enter(done, verified=False))["submitted"]
    entry = read_entry(enter(done))
    assert (entry["label"], entry["submitted"]) == ("verified", submitted)


def test_another_record_needs_replace(done: Path) -> None:
    path = enter(done)
    before = path.read_bytes()
    run(done / "out", [done / "s0", done / "s1"], CountMethod("tfp+4dgs", steps=2))
    with pytest.raises(UserError, match=r"tfp\+4dgs\.json: expected no entry .* found another record; pass --replace"):
        enter(done)
    assert path.read_bytes() == before
    enter(done, replace=True)
    assert read_entry(path)["record"]["method"]["params"] == {"steps": 2}


def better_psnr(record: Record) -> None:
    """A forgery that agrees with itself."""
    cells = record["scenes"].values()
    for cell in cells:
        for values in cell["per_image"].values():
            values["psnr"] += 0.01
        cell["metrics"]["psnr"] += 0.01
    record["mean"]["psnr"] += 0.01


def test_scores_that_the_files_do_not_give_are_refused(done: Path) -> None:
    edit(done / "out/results/tfp+4dgs.json", better_psnr)
    with pytest.raises(
        UserError, match=r"scene pattern-0, cam_03/0000\d0: expected psnr = .* as computed from the files"
    ):
        enter(done)
    assert not (done / "board").exists()
    assert read_entry(enter(done, verified=False))["label"] == "self-reported"


def test_rounding_below_the_tolerance_is_no_forgery(done: Path) -> None:
    def nudge(record: Record) -> None:
        values = record["scenes"]["pattern-0"]["per_image"]["cam_03/000020"]
        values["psnr"] += 1e-7
        record["scenes"]["pattern-0"]["metrics"]["psnr"] += 1e-7 / 3
        record["mean"]["psnr"] += 1e-7 / 6

    edit(done / "out/results/tfp+4dgs.json", nudge)
    assert read_entry(enter(done))["label"] == "verified"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda r: r["scenes"]["pattern-0"].update(predictions_sha256="0" * 64),
            "expected predictions 00000000",
        ),
        (lambda r: r["scenes"]["pattern-1"].update(fit_seconds=1e-3), "expected fit_seconds"),
        (lambda r: r["scenes"]["pattern-1"].update(gain_aligned=7.0), "expected gain_aligned"),
        (lambda r: r["method"].update(params={"steps": 1}), "as in the record"),
        (lambda r: r["dataset"]["scenes"].update({"pattern-0": "1" * 64}), "expected scene revision 1111111111111111"),
        (lambda r: r["mean"].update(psnr=99.0), "expected psnr ="),
        (lambda r: r["scenes"]["pattern-0"]["per_image"].pop("cam_03/000020"), "the mean of its parts"),
        (lambda r: r["method"].update(name="../../evil"), "at method/name"),
        (lambda r: r["method"].update(name="a/b"), "at method/name"),
        (lambda r: r.update(surprise=1), "'surprise' was unexpected"),
    ],
)
def test_records_that_the_files_contradict_are_refused(done: Path, change: Any, message: str) -> None:
    edit(done / "out/results/tfp+4dgs.json", change)
    with pytest.raises(UserError) as e:
        enter(done)
    assert message in str(e.value) and "\n" not in str(e.value)
    assert not (done / "board").exists()


def test_damaged_predictions_are_refused_by_name(done: Path) -> None:
    path = done / "out/predictions/tfp+4dgs/pattern-1/cam_03/000040.exr"
    path.write_bytes(path.read_bytes()[:-1] + b"\1")
    with pytest.raises(UserError, match=r"pattern-1/cam_03/000040\.exr: expected sha256"):
        enter(done)


def test_missing_predictions_and_paths_are_refused(done: Path) -> None:
    shutil.rmtree(done / "out/predictions/tfp+4dgs/pattern-1")
    with pytest.raises(UserError, match="pattern-1: expected a predictions folder"):
        enter(done)
    with pytest.raises(UserError, match="nowhere: expected a predictions folder"):
        enter(done, predictions=done / "nowhere")
    with pytest.raises(UserError, match="nowhere: expected a scene folder"):
        enter(done, scenes=(done / "nowhere",))
    with pytest.raises(UserError, match=r"nothing\.json: expected a spike4dgs-result/1 record, found no such file"):
        submit(done / "nothing.json", leaderboard=done / "board")


def test_other_predictions_of_the_method_are_refused(done: Path) -> None:
    with pytest.raises(UserError, match="give the predictions that were scored"):
        enter(done, predictions=done / "out/predictions/rough")


def test_rows_are_ranked_and_failures_come_last(done: Path) -> None:
    enter(done, "bad", verified=False)
    enter(done, "rough")
    enter(done)
    (only,) = board(done)["boards"]
    rows = only["rows"]
    assert [(r["method"], r["rank"]) for r in rows] == [("tfp+4dgs", 1), ("rough", 2), ("bad", None)]
    assert rows[0]["mean"][PRIMARY] > rows[1]["mean"][PRIMARY]
    assert rows[2]["status"] == {"pattern-0": "failed", "pattern-1": "failed"}
    assert rows[2]["mean"][PRIMARY] is None and rows[2]["fit_seconds"] is None
    assert [m["id"] for m in board(done)["metrics"]] == list(METRICS)
    check_schema(board(done), load_schema("spike4dgs.leaderboard", "leaderboard.schema.json"), "board", "")


def entry_of(record: Record, name: str, psnr: float | None, submitted: str) -> Record:
    record = copy.deepcopy(record)
    record["method"]["name"] = name
    record["mean"][PRIMARY] = psnr
    checked = {"label": "verified", "unverified": []}
    return {"schema": "spike4dgs-entry/1", **checked, "submitted": submitted, "record": record}


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine that has weights for MetaIQA (random ones) and nothing else."""
    torch.manual_seed(0)
    folder = tmp_path / "weights"
    folder.mkdir()
    torch.save(metaiqa_network().state_dict(), folder / METAIQA.name)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setenv(VARIABLE, str(folder))
    return folder


def test_scores_that_need_absent_weights_stay_as_claimed_and_are_listed(
    done: Path, weights: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run(done / "out", [done / "s0", done / "s1"], CountMethod("with"))
    monkeypatch.delenv(VARIABLE)
    entry = read_entry(enter(done, "with", verified=False))
    assert set(entry["unverified"]) == {*METRICS} - {"lpips_alex", "lpips_vgg", "lpips_squeeze"}
    entry = read_entry(enter(done, "with"))
    assert (entry["label"], entry["unverified"]) == ("verified", ["metaiqa"])
    assert entry["record"]["mean"]["metaiqa"] > 0 and board(done)["boards"][0]["rows"][0]["unverified"] == ["metaiqa"]
    assert "with: verified (as claimed, for lack of weights: metaiqa), rank 1" in capsys.readouterr().out
    monkeypatch.setenv(VARIABLE, str(weights))
    path = enter(done, "with")
    assert read_entry(path)["unverified"] == []
    before = path.read_bytes()
    monkeypatch.delenv(VARIABLE)
    assert enter(done, "with").read_bytes() == before, "what was verified stays so"


def better_metaiqa(record: Record) -> None:
    for cell in record["scenes"].values():
        for values in cell["per_image"].values():
            values["metaiqa"] += 0.25
        cell["metrics"]["metaiqa"] += 0.25
    record["mean"]["metaiqa"] += 0.25


def test_with_the_weights_a_claim_is_checked_and_other_weights_say_nothing(done: Path, weights: Path) -> None:
    run(done / "out", [done / "s0", done / "s1"], CountMethod("with"))
    edit(done / "out/results/with.json", better_metaiqa)
    with pytest.raises(UserError, match="expected metaiqa = .* as computed from the files"):
        enter(done, "with")
    torch.manual_seed(1)
    torch.save(metaiqa_network().state_dict(), weights / METAIQA.name)
    assert read_entry(enter(done, "with"))["unverified"] == ["metaiqa"]


def test_more_weights_than_the_claimants_do_no_harm(done: Path, weights: Path) -> None:
    assert read_entry(enter(done))["unverified"] == []


def test_of_equal_values_the_earlier_submission_is_first(finished: Path) -> None:
    record = json.loads((finished / "out/results/rough.json").read_text())
    rows = rank(
        [
            entry_of(record, "later", 20.0, "2026-01-02T00:00:00Z"),
            entry_of(record, "none", None, "2026-01-01T00:00:00Z"),
            entry_of(record, "best", 21.0, "2026-01-03T00:00:00Z"),
            entry_of(record, "earlier", 20.0, "2026-01-01T00:00:00Z"),
        ]
    )
    assert [(r["method"], r["rank"]) for r in rows] == [("best", 1), ("earlier", 2), ("later", 3), ("none", None)]


def test_a_method_with_one_failed_scene_is_not_ranked(done: Path) -> None:
    class Half(CountMethod):
        def fit(self, scene: Any, *args: Any, **kwargs: Any) -> Any:
            if scene.id == "pattern-1":
                raise ValueError("too dark")
            return super().fit(scene, *args, **kwargs)

    run(done / "out", [done / "s0", done / "s1"], Half("half"))
    entry = read_entry(enter(done, "half"))
    assert entry["label"] == "verified", "what was scored was verified"
    (row,) = board(done)["boards"][0]["rows"]
    assert row["rank"] is None and row["status"] == {"pattern-0": "ok", "pattern-1": "failed"}


def test_only_records_of_one_dataset_compare(done: Path) -> None:
    enter(done)
    run(done / "single", [done / "s1"], CountMethod("other"))
    submit(done / "single/results/other.json", leaderboard=done / "board")
    names = [(b["dataset"]["name"], [r["method"] for r in b["rows"]]) for b in board(done)["boards"]]
    assert sorted(names) == [("pattern-0+pattern-1", ["tfp+4dgs"]), ("pattern-1", ["other"])]


def test_the_leaderboard_is_made_from_the_entries_alone(done: Path) -> None:
    enter(done)
    enter(done, "rough")
    before = (done / "board/leaderboard.json").read_bytes()
    (done / "board/leaderboard.json").unlink()
    write_leaderboard(done / "board")
    assert (done / "board/leaderboard.json").read_bytes() == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: e.update(label="certified"), "at label"),
        (lambda e: e.update(note="x"), "'note' was unexpected"),
        (lambda e: e["record"].update(note="x"), "at record"),
        (
            lambda e: e["record"]["method"].update(name="other"),
            "/tfp+4dgs, found pattern-0+pattern-1/other",
        ),
        (lambda e: e["record"]["mean"].update(psnr=50.0), "expected psnr ="),
    ],
)
def test_damaged_entries_are_refused_by_name(done: Path, change: Any, message: str) -> None:
    path = enter(done)
    edit(path, change)
    with pytest.raises(UserError) as e:
        write_leaderboard(done / "board")
    assert "tfp+4dgs.json" in str(e.value) and message in str(e.value)


def test_predictions_of_another_program_are_scored_and_verified(done: Path) -> None:
    """No key, no environment, no times: a folder written with other tools."""
    from spike4dgs.benchmark.runs.score_command import score

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
    assert read_entry(done / "board/entries/pattern-0+pattern-1/theirs.json")["label"] == "verified"
    (row,) = board(done)["boards"][0]["rows"]
    ours = json.loads((done / "out/results/rough.json").read_text())
    assert row["rank"] == 1 and row["fit_seconds"] is None and row["mean"] == ours["mean"]


def test_the_committed_leaderboard_follows_from_the_committed_entries(tmp_path: Path) -> None:
    committed = Path(__file__).resolve().parents[2] / "leaderboard"
    shutil.copytree(committed / "entries", tmp_path / "entries")
    write_leaderboard(tmp_path)
    assert (tmp_path / "leaderboard.json").read_bytes() == (committed / "leaderboard.json").read_bytes()


def test_the_default_folder_is_the_repositorys() -> None:
    import inspect

    assert inspect.signature(module.submit).parameters["leaderboard"].default == Path("leaderboard")
