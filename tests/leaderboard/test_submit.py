from __future__ import annotations

import inspect
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from changes import edit_json, files_in
from dummy_methods import CountMethod, run
from nosy_methods import Darker, PlaysBack
from submissions import board, enter, entry_of, read, release_of, submit

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import sha256_json, write_bytes
from spike4dgs.cli.submit import submit_all
from spike4dgs.leaderboard.refit import refits_of


def test_with_files_an_entry_is_re_scored(done: Path, released: None, said: Any) -> None:
    path = enter(done)
    entry = read(path)
    assert entry["verification"]["label"] == "re-scored"
    assert entry["record"] == json.loads((done / "out/results/tfp+4dgs.json").read_text())
    assert entry["verification"]["by"].keys() == {"when", "harness", "environment"}
    revision = board(done, "leaderboard")["boards"][0]["revision"][:12]
    assert path.parent == done / f"board/entries/2-patterns@{revision}"
    at = f"place 1 of 1 by mean PSNR on patterns (release 2, revision {revision})"
    ranks = f"ranks, with their intervals: spike4dgs leaderboard --leaderboard {done / 'board'}"
    assert said() == f"tfp+4dgs: re-scored, {at}\n{ranks}\n"


def test_another_revision_is_local_says_why_and_leaves_the_track_alone(
    done: Path, monkeypatch: pytest.MonkeyPatch, said: Any
) -> None:
    release_of(done, monkeypatch)
    enter(done)
    public = files_in(done / "board/entries")
    release_of(done, monkeypatch, pattern_0="cd" * 32)
    edit_json(done / "out/results/tfp+4dgs.json", lambda r: r["dataset"]["scenes"].update({"pattern-0": "ab" * 32}))
    said()
    assert submit(done / "out/results/tfp+4dgs.json", leaderboard=done / "board", replace=True) == 0
    out = said()
    assert f"pattern-0: revision {'ab' * 6} here, {'cd' * 6} in release 2" in out
    assert f"local board, in {done}/board/local.json, not on a track: local/pattern-0+1@" in out
    assert files_in(done / "board/entries") == public, "the track's entry is as it was"
    (only,) = board(done)["boards"]
    assert only["track"] is None and only["why"].startswith("pattern-0: revision abab")


@pytest.mark.parametrize(
    ("predictions", "scenes", "reason"),
    [
        (None, (), "no --predictions"),
        (None, ("s0", "s1"), "no --predictions"),
        ("tfp+4dgs", (), "no --scenes for pattern-0, pattern-1"),
        ("tfp+4dgs", ("s0",), "no --scenes for pattern-1"),
    ],
)
def test_without_files_an_entry_is_claimed(
    done: Path, predictions: str | None, scenes: tuple[str, ...], reason: str, said: Any
) -> None:
    folder = done / "out/predictions" / predictions if predictions else None
    options = {"predictions": folder, "scenes": tuple(done / name for name in scenes)}
    assert read(enter(done, verified=False, **options))["verification"]["label"] == "claimed"
    assert f"claimed ({reason}), not ranked (nothing was computed again) on the local" in (text := said())
    assert "ranks, with their intervals" not in text


def test_submitting_twice_changes_nothing_and_neither_does_scoring_again(entered: Path) -> None:
    before = files_in(entered / "board")
    enter(entered)
    assert files_in(entered / "board") == before
    enter(entered, verified=False)
    assert files_in(entered / "board") == before, "a verified entry stays so"
    edit_json(entered / "out/results/tfp+4dgs.json", lambda r: r.update(created="2031-01-01T00:00:00Z", command="x"))
    enter(entered)
    assert files_in(entered / "board") == before


def test_a_claimed_entry_can_be_verified_later(done: Path) -> None:
    submitted = read(enter(done, verified=False))["submitted"]
    entry = read(enter(done))
    assert (entry["verification"]["label"], entry["submitted"]) == ("re-scored", submitted)


def test_another_record_needs_replace(entered: Path) -> None:
    path = entry_of(entered)
    before = path.read_bytes()
    run(entered / "out", [entered / "s0", entered / "s1"], CountMethod("tfp+4dgs", steps=2))
    with pytest.raises(UserError, match=r"tfp\+4dgs\.json: expected no entry .* found another record; pass --replace"):
        enter(entered)
    assert path.read_bytes() == before
    enter(entered, replace=True)
    assert read(path)["record"]["method"]["params"] == {"steps": 2}


def test_seeds_are_entries_of_one_row(entered: Path) -> None:
    run(entered / "other", [entered / "s0", entered / "s1"], CountMethod("tfp+4dgs"), seed=5)
    seeded, scenes = entered / "other/results/tfp+4dgs.json", (entered / "s0", entered / "s1")
    submit_all({seeded: entered / "other/predictions/tfp+4dgs"}, scenes=scenes, leaderboard=entered / "board")
    (row,) = board(entered)["boards"][0]["rows"]
    assert row["seeds"] == [0, 5]
    assert [p.rpartition("/")[2] for p in row["entries"]] == ["tfp+4dgs.json", "tfp+4dgs@seed-5.json"]
    each = [json.loads(p.read_text())["mean"]["psnr"] for p in (seeded, entered / "out/results/tfp+4dgs.json")]
    assert row["mean"]["psnr"] == pytest.approx(sum(each) / 2)


def test_a_refused_record_does_not_stop_the_others(done: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edit_json(done / "out/results/rough.json", lambda r: r["mean"].update(psnr=99.0))
    results = {done / f"out/results/{n}.json": done / "out/predictions" / n for n in ("rough", "tfp+4dgs")}
    assert submit_all(results, scenes=(done / "s0", done / "s1"), leaderboard=done / "board") == 1
    captured = capsys.readouterr()
    assert "expected psnr" in captured.err and "tfp+4dgs: re-scored, place 1 of 1 by mean PSNR" in captured.out
    assert captured.out.count("local board, in") == 1


def test_a_folder_that_is_no_leaderboard_is_refused(done: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert inspect.signature(submit).parameters["leaderboard"].default == Path("leaderboard")
    for name in ("site/index.html", "site/archive/2024/photo.webp"):
        write_bytes(done / name, b"theirs")
    before = files_in(done)
    monkeypatch.chdir(done)
    for name in ("", ".", "out", "s0/scene.json", "site"):
        with pytest.raises(UserError, match="--leaderboard: expected a leaderboard or a new folder"):
            submit(done / "out/results/rough.json", leaderboard=Path(name))
        with pytest.raises(UserError, match="--leaderboard"):
            submit_all({}, scenes=(), leaderboard=Path(name))
    (done / "empty").mkdir()
    monkeypatch.chdir(done / "empty")
    with pytest.raises(UserError, match="the working folder"):
        submit(done / "out/results/rough.json", leaderboard=Path(""))
    assert files_in(done) == before


def test_a_second_fit_is_compared_and_its_costs_stand_beside_the_claimed_ones(
    entered: Path, installed: dict[str, Any], said: Any
) -> None:
    submitted = read(entry_of(entered))["submitted"]
    entry = read(enter(entered, refit=True))
    refit = entry["verification"]["refit"]
    claimed = {scene: cell["metrics"]["psnr"] for scene, cell in entry["record"]["scenes"].items()}
    assert (entry["verification"]["label"], entry["submitted"]) == ("re-fitted", submitted)
    assert refit["psnr"] == pytest.approx(claimed) and refit["bit_equal"] is True and refit["apart"] == "process"
    (row,) = board(entered)["boards"][0]["rows"]
    costs, seconds = row["costs"]["fit_seconds"], sum(c["fit_seconds"] for c in refit["costs"].values())
    assert row["label"] == "re-fitted" and costs["re-fitted"] == pytest.approx(seconds) != costs["claimed"]
    assert "tfp+4dgs: re-fitted, place 1 of 1 by mean PSNR" in said()
    assert not list(refits_of(entered / "board").iterdir())


def test_a_method_that_finds_the_held_out_stream_is_not_fitted_again(done: Path, installed: dict[str, Any]) -> None:
    installed["plays-back"] = PlaysBack()
    run(done / "out", [done / "s0", done / "s1"], PlaysBack())
    assert json.loads((done / "out/results/plays-back.json").read_text())["mean"]["psnr"] > 25
    with pytest.raises(UserError, match="plays-back on pattern-0: expected a second fit that ends, found ValueError"):
        enter(done, "plays-back", refit=True)


def test_a_score_that_the_method_does_not_reach_is_refused_whatever_second_fits_are_sent(
    done: Path, installed: dict[str, Any]
) -> None:
    """The leaderboard comes with folders in which the claimed images wait."""
    installed["tfp+4dgs"] = Darker("tfp+4dgs")
    record = json.loads((done / "out/results/tfp+4dgs.json").read_text())
    work = done / "board/.refit" / sha256_json([record["method"], record["dataset"]])[:16]
    for number, scene in enumerate(("pattern-0", "pattern-1")):
        run(work / scene, [done / f"s{number}"], Darker("tfp+4dgs"), metrics=("psnr",))
        sent = work / scene / "predictions/tfp+4dgs" / scene
        key = json.loads((sent / "prediction.json").read_text())["key"]
        shutil.copytree(done / "out/predictions/tfp+4dgs" / scene, sent, dirs_exist_ok=True)
        edit_json(sent / "prediction.json", lambda info, key=key: info.update(key=key))
    with pytest.raises(UserError, match=r"on pattern-0: expected a second fit within 0\.3 dB of the claimed"):
        enter(done, refit=True)
    assert not (done / "board/local").exists()


@pytest.mark.parametrize(
    ("method", "message"),
    [
        (CountMethod("tfp+4dgs", steps=3), "expected the installed method as in the record, found another params"),
        (None, "expected one of rough"),
    ],
)
def test_what_cannot_be_fitted_again_is_refused(
    done: Path, installed: dict[str, Any], method: CountMethod | None, message: str
) -> None:
    del installed["tfp+4dgs"]
    if method:
        installed["tfp+4dgs"] = method
    with pytest.raises(UserError, match=message):
        enter(done, refit=True)


def test_a_second_fit_needs_the_files(done: Path, installed: dict[str, Any]) -> None:
    with pytest.raises(UserError, match=r"--refit: expected predictions and scenes .* found no --predictions"):
        enter(done, verified=False, refit=True)


def test_the_second_fit_has_the_records_seed(done: Path, installed: dict[str, Any]) -> None:
    edit_json(done / "out/results/tfp+4dgs.json", lambda r: r["method"].update(seed=None))
    for info in (done / "out/predictions/tfp+4dgs").glob("*/prediction.json"):
        edit_json(info, lambda p: p["method"].update(seed=None))
    with pytest.raises(UserError, match="a scored cell with budget and seed"):
        enter(done, refit=True)


def test_a_better_verified_entry_is_kept_and_a_claimed_one_gives_way(done: Path) -> None:
    path = enter(done, verified=False)
    edit_json(done / "out/results/tfp+4dgs.json", lambda r: r.update(command="another"))
    result = done / "out/results/tfp+4dgs.json"
    edit_json(result, lambda r: r["method"].update(version="9"))
    claimed = read(path)["record"]["method"]["version"]
    with pytest.raises(UserError, match="pass --replace"):
        enter(done, verified=False)
    assert read(path)["record"]["method"]["version"] == claimed
    edit_json(result, lambda r: r["method"].update(version=claimed))
    entered = read(enter(done))
    assert entered["verification"]["label"] == "re-scored", "what was only claimed gives way"
    edit_json(result, lambda r: r["method"].update(version="9"))
    for replace in (False, True):
        with pytest.raises(UserError, match="as well as the re-scored one, found one that is claimed"):
            enter(done, verified=False, replace=replace)
    assert read(path) == entered
