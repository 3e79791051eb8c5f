from __future__ import annotations

import copy
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changes import edit_json
from dummy_methods import CountMethod, run
from submissions import Record, board, edit_with_ledger, enter, entry_of, read, refitted, submit

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import sha256_file
from spike4dgs.benchmark.metrics.table import METRICS, PRIMARY
from spike4dgs.benchmark.runs.predictions import INFO, SUMS
from spike4dgs.benchmark.scene.images import write_exr
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.cli.score import score
from spike4dgs.leaderboard.rank import REFINED, flags_of, rank_entries, reason, write_boards


def test_rows_are_ranked_and_failures_come_last(done: Path) -> None:
    enter(done, "bad", verified=False)
    enter(done, "rough")
    enter(done)
    (only,) = board(done)["boards"]
    rows = only["rows"]
    assert [(r["method"], r["rank"]) for r in rows] == [("tfp+4dgs", 1), ("rough", 2), ("bad", None)]
    assert rows[0]["mean"][PRIMARY] > rows[1]["mean"][PRIMARY]
    assert rows[2]["status"] == {"pattern-0": "failed", "pattern-1": "failed"}
    assert rows[2]["mean"][PRIMARY] is None and rows[2]["costs"]["fit_seconds"]["claimed"] is None
    assert [m["id"] for m in board(done)["metrics"]] == list(METRICS)
    check_schema(board(done), load_schema("spike4dgs.leaderboard", "leaderboard.schema.json"), "board", "")


def test_claimed_rows_have_no_rank_and_come_after_the_others(done: Path) -> None:
    enter(done, verified=False)
    enter(done, "rough")
    first, second = board(done)["boards"][0]["rows"]
    assert first["mean"][PRIMARY] < second["mean"][PRIMARY]
    assert (first["method"], first["rank"], first["label"]) == ("rough", 1, "re-scored")
    assert (second["method"], second["rank"], second["label"]) == ("tfp+4dgs", None, "claimed")


def test_costs_are_claimed_and_trained_on_is_shown(done: Path) -> None:
    class Learned(CountMethod):
        trained_on = ("other-1-small",)

    run(done / "out", [done / "s0", done / "s1"], Learned("learned"))
    record = read(enter(done, "learned"))["record"]
    (row,) = board(done)["boards"][0]["rows"]
    seconds = sum(cell["fit_seconds"] for cell in record["scenes"].values())
    assert row["costs"]["fit_seconds"] == {"claimed": pytest.approx(seconds), "re-fitted": None}
    assert row["trained_on"] == ["other-1-small"] and row["rank"] == 1
    assert row["given"] == ["poses", "flat-field"] and len(row["code"]["claimed"]) == len(row["code"]["verifier"]) == 1


@pytest.fixture
def record(finished: Path) -> Record:
    return json.loads((finished / "out/results/rough.json").read_text())


def entry_with(record: Record, name: str, psnr: float | None, submitted: str, seed: int = 0, **changes: Any) -> Record:
    record = copy.deepcopy(record)
    record["method"].update(name=name, seed=seed, **changes)
    record["mean"][PRIMARY] = psnr
    by = {"when": submitted, "harness": record["harness"], "environment": record["environment"]}
    verification = {"label": "re-scored", "unverified": [], "by": by, "truth": {}, "refit": None}
    return {"schema": "spike4dgs-entry/2", "submitted": submitted, "verification": verification, "record": record}


def ranks(entries: list[Record]) -> list[tuple[str, int | None, list[int], float | None]]:
    rows = rank_entries({f"entries/a@0/{i}.json": entry for i, entry in enumerate(entries)})
    return [(r["method"], r["rank"], r["seeds"], r["mean"][PRIMARY]) for r in rows]


def test_of_equal_values_the_earlier_submission_is_first(record: Record) -> None:
    entries = [
        entry_with(record, "later", 20.0, "2026-01-02T00:00:00Z"),
        entry_with(record, "none", None, "2026-01-01T00:00:00Z"),
        entry_with(record, "best", 21.0, "2026-01-03T00:00:00Z"),
        entry_with(record, "earlier", 20.0, "2026-01-01T00:00:00Z"),
    ]
    assert [r[:2] for r in ranks(entries)] == [("best", 1), ("earlier", 2), ("later", 3), ("none", None)]


def test_a_row_is_the_mean_over_the_seeds_of_one_configuration(record: Record) -> None:
    entries = [entry_with(record, "a", 20.0 + seed, "2026-01-02T00:00:00Z", seed) for seed in range(3)]
    other = entry_with(record, "a", 50.0, "2026-01-02T00:00:00Z", 3, params={"steps": 9})
    claimed = entry_with(record, "a", 90.0, "2026-01-02T00:00:00Z", 4)
    claimed["verification"] = {"label": "claimed", "unverified": [], "by": None, "truth": {}, "refit": None}
    expected = [("a", 1, [3], 50.0), ("a", 2, [0, 1, 2], 21.0), ("a", None, [4], 90.0)]
    assert ranks([*entries, other, claimed]) == expected


def test_refined_scores_have_no_rank_and_say_so(record: Record) -> None:
    names = {"rough.refined": 30.0, "rough": 20.0}
    entries = {
        f"entries/a@0/{n}.json": entry_with(record, n, psnr, "2026-01-01T00:00:00Z") for n, psnr in names.items()
    }
    first, refined = rank_entries(entries)
    assert (first["method"], first["rank"]) == ("rough", 1)
    assert (refined["method"], refined["rank"], reason(refined)) == ("rough.refined", None, REFINED)


def test_seeds_join_only_with_equal_code_parameters_and_verification(record: Record) -> None:
    """Gray images under another method's name are a row of their own, whatever they leave equal."""

    def of(seed: int, change: Any) -> Record:
        found = entry_with(record, "a", 40.0 - 20 * (seed > 0), "2026-01-02T00:00:00Z", seed)
        change(found)
        return found

    def fitted_with(harness: Any) -> Any:
        return lambda e: [cell["fitted_with"].update(harness=harness) for cell in e["record"]["scenes"].values()]

    other_commit = {**record["harness"], "commit": "ab" * 20}
    for change in (
        fitted_with(None),
        fitted_with(other_commit),
        refitted({}),
        lambda e: e["verification"].update(unverified=["metaiqa"]),
        lambda e: e["record"]["method"].update(version="0.0.1"),
    ):
        assert ranks([of(0, lambda e: None), of(1, change)]) == [("a", 1, [0], 40.0), ("a", 2, [1], 20.0)]
    assert ranks([of(0, fitted_with(None)), of(1, fitted_with(None))]) == [("a", 1, [0], 40.0), ("a", 2, [1], 20.0)]
    assert ranks([of(0, lambda e: None), of(1, lambda e: None)]) == [("a", 1, [0, 1], 30.0)]


def test_a_forged_seed_joins_re_scored_ones_and_never_re_fitted_ones(done: Path, installed: dict[str, Any]) -> None:
    """Gray images of a seed 1, with a copy of all that an honest fit of seed 0 states."""
    honest, forged, scenes = done / "out/predictions/tfp+4dgs", done / "forged", (done / "s0", done / "s1")
    shutil.copytree(honest, forged)
    for folder in forged.iterdir():
        edit_json(folder / INFO, lambda info: info["method"].update(seed=1))
        names = [line.split()[1] for line in (folder / SUMS).read_text().splitlines()]
        for name in names:
            write_exr(folder / name, np.full((24, 40), 0.5, np.float32), 0.0)
        (folder / SUMS).write_text("".join(f"{sha256_file(folder / name)}  {name}\n" for name in names))
    record, files = done / "forged.json", {"predictions": forged, "scenes": scenes, "leaderboard": done / "board"}
    assert score(forged, scenes, out=record) == submit(record, **files) == 0
    stated = read(path := enter(done))["record"]
    (row,) = board(done)["boards"][0]["rows"]
    assert row["seeds"] == [0, 1], "of re-scored entries nothing proves who made them: docs/leaderboard.md says so"
    with pytest.raises(UserError, match=r"expected a second fit within 0\.3 dB of the claimed"):
        submit(record, **files, refit=True)
    edit_with_ledger(path, refitted({scene: cell["metrics"]["psnr"] for scene, cell in stated["scenes"].items()}))
    write_boards(done / "board")
    rows = board(done)["boards"][0]["rows"]
    assert [(r["rank"], r["label"], r["seeds"]) for r in rows] == [(1, "re-fitted", [0]), (2, "re-scored", [1])]
    assert rows[0]["mean"] == stated["mean"]


def test_a_method_with_one_failed_scene_is_not_ranked(done: Path, said: Any) -> None:
    class Half(CountMethod):
        def fit(self, scene: Any, *args: Any, **kwargs: Any) -> Any:
            if scene.id == "pattern-1":
                raise ValueError("too dark")
            return super().fit(scene, *args, **kwargs)

    run(done / "out", [done / "s0", done / "s1"], Half("half"))
    entry = read(enter(done, "half"))
    assert entry["verification"]["label"] == "re-scored", "what was scored was verified"
    (row,) = board(done)["boards"][0]["rows"]
    assert row["rank"] is None and row["status"] == {"pattern-0": "ok", "pattern-1": "failed"}
    assert "not ranked (pattern-1 failed)" in said()


def test_only_records_of_one_dataset_compare(entered: Path) -> None:
    run(entered / "single", [entered / "s1"], CountMethod("other"))
    submit(entered / "single/results/other.json", leaderboard=entered / "board")
    names = [(b["dataset"]["name"], [r["method"] for r in b["rows"]]) for b in board(entered)["boards"]]
    assert sorted(names) == [("pattern-0+pattern-1", ["tfp+4dgs"]), ("pattern-1", ["other"])]


def test_methods_are_on_the_tracks_that_withhold_nothing_they_are_given(done: Path, released: None, said: Any) -> None:
    class Unposed(CountMethod):
        given = ("flat-field",)

    run(done / "out", [done / "s0", done / "s1"], Unposed("unposed"))
    enter(done)
    enter(done, "unposed")
    boards = {b["track"]: {r["method"]: r["rank"] for r in b["rows"]} for b in board(done, "leaderboard")["boards"]}
    assert boards.keys() == {"patterns", "unposed"} and boards["patterns"].keys() == {"tfp+4dgs", "unposed"}
    assert boards["unposed"] == {"unposed": 1} and not (done / "board/local.json").exists()
    out = said()
    revision = board(done, "leaderboard")["boards"][0]["revision"][:12]
    assert f"on patterns (release 2, revision {revision})" in out
    assert f"place 1 of 1 by mean PSNR on unposed (release 2, revision {revision})" in out


def test_the_boards_are_made_from_the_entries_alone(entered: Path) -> None:
    enter(entered, "rough")
    before = (entered / "board/local.json").read_bytes()
    (entered / "board/local.json").unlink()
    write_boards(entered / "board")
    assert (entered / "board/local.json").read_bytes() == before
    shutil.rmtree(entered / "board/local")
    write_boards(entered / "board")
    assert not (entered / "board/local.json").exists()


def test_the_archive_is_kept_and_has_no_ranks(entered: Path) -> None:
    path = entry_of(entered)
    archive = entered / "board/archive" / path.parent.name
    archive.parent.mkdir()
    path.parent.rename(archive)
    name = f"archive/{path.parent.name}/{path.name}"
    (entered / "board/LEDGER").write_text((entered / "board/LEDGER").read_text().replace("local/", "archive/"))
    write_boards(entered / "board")
    (only,) = board(entered, "archive")["boards"]
    assert only["why"].startswith("of an earlier release") and not (entered / "board/local.json").exists()
    assert [(r["rank"], r["entries"]) for r in only["rows"]] == [(None, [name])]


def entry(record: Record, truth: dict[str, Any] | None = None, **method: Any) -> dict[str, Any]:
    record["method"].update(method)
    return {"record": record, "verification": {"truth": {"pattern-0": truth} if truth else {}}}


def check(share: float | None = None, error: float | None = None, **changes: Any) -> dict[str, Any]:
    plain = {"images": 3, "equal_images": 0, "equal_pixels": 0.04, "ceiling_db": None}
    return {**plain, "noise_share": share, "noise_share_error": error, **changes}


@pytest.mark.parametrize(
    ("trained_on", "flagged"),
    [
        ((), False),
        (("car-1-small", "pattern-2"), False),
        (("pattern-01", "my-pattern-0", "pattern-0-long", "pattern-0.v2"), False),
        (("pattern-0",), True),
        (("scenes PATTERN-0, and others.",), True),
        (("pattern-0@0123",), True),
        (("data/pattern-0/",), True),
    ],
)
def test_trained_on_is_checked_against_scene_ids(record: Record, trained_on: tuple[str, ...], flagged: bool) -> None:
    expected = ["trained on test scenes (pattern-0)"] if flagged else []
    assert flags_of(entry(record, trained_on=[*trained_on])) == expected


def test_trained_on_is_checked_against_revisions(record: Record) -> None:
    revision = record["dataset"]["scenes"]["pattern-1"]
    assert flags_of(entry(record, trained_on=[f"sha256:{revision}"])) == ["trained on test scenes (pattern-1)"]


@pytest.mark.parametrize(
    ("truth", "flag"),
    [
        (check(), None),
        (check(0.4, 0.2), None),
        (check(0.1, 0.0), None),
        (check(-3.0, 0.1), None),
        (check(0.3, 0.02), "carries the truth's noise (pattern-0)"),
        (check(equal_images=1), "equals truth (pattern-0)"),
        (check(equal_pixels=0.3), "equals truth (pattern-0)"),
        (check(ceiling_db=200.0), None),
    ],
)
def test_flags_follow_from_what_was_measured(record: Record, truth: dict[str, Any], flag: str | None) -> None:
    assert flags_of(entry(record, truth)) == ([flag] if flag else [])


def test_no_score_is_above_the_ceiling_or_as_near_to_it_as_another_rendering(record: Record) -> None:
    psnr = record["scenes"]["pattern-0"]["metrics"]["psnr"]
    as_many_samples = psnr + 10 * math.log10(1 + 1)  # the ceiling of what scores like a second rendering
    assert not flags_of(entry(record, check(ceiling_db=as_many_samples + 1)))
    for ceiling in (as_many_samples, psnr):
        (flag,) = flags_of(entry(record, check(ceiling_db=ceiling)))
        noted = f"(pattern-0 has {psnr:.1f} of {ceiling:.1f} dB)"
        assert flag == f"as near to the truth as another rendering {noted}"
    (flag,) = flags_of(entry(record, check(ceiling_db=psnr - 0.2)))
    assert flag == f"above the noise ceiling (pattern-0 has {psnr:.1f} of {psnr - 0.2:.1f} dB)"
