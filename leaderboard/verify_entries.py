"""Verify a whole leaderboard: its entries, their sheets and the boards; with predictions and scenes also the scores."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import read_json
from spike4dgs.benchmark.json_values.text import json_text
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.runs.predictions import SUMS, read_info
from spike4dgs.benchmark.runs.record import Record, same_value
from spike4dgs.benchmark.scene.scene import Scene, open_scenes
from spike4dgs.benchmark.untrusted import printable
from spike4dgs.leaderboard.entry import CLAIMED, RE_FITTED, Entry, check_folder
from spike4dgs.leaderboard.ledger import FOLDERS, LEDGER, read_ledger, same_but_for_case
from spike4dgs.leaderboard.rank import FILES, flags_of, make_boards
from spike4dgs.leaderboard.reading import Reading, read_all
from spike4dgs.leaderboard.thumbnails import KEY, check_sheet, make_thumbnails, read_sheet, sheet_path, sheets
from spike4dgs.leaderboard.tracks import ARCHIVE
from spike4dgs.leaderboard.truth_check import SecondRenderings, TruthCheck, no_renderings, once_a_scene
from spike4dgs.leaderboard.verify import TOLERANCE_DB, revisions_of, verify_record

FitAgain = Callable[[Record, Sequence[Scene]], object]  # raises UserError where the scores are not reached
_EDITED = "the entry was edited: restore it, or submit the record again with --replace"


@dataclass(frozen=True)
class Findings:
    """What came of checking a leaderboard: how many entries it has, how many were scored and fitted again, and the
    problems. `not_fitted` counts the entries that are labelled re-fitted, which scores alone do not bear out.
    `passed_over` says of which entries there are predictions that were not scored, and why; `not_computed` which
    metrics an entry says were computed again, and were not now."""

    entries: int
    scored: int
    not_fitted: int
    problems: tuple[str, ...]
    passed_over: tuple[str, ...]
    not_computed: tuple[str, ...]


def verify_leaderboard(
    leaderboard: Path,
    predictions: Path | None = None,
    scenes: Sequence[Path] = (),
    allow_gaps: bool = False,
    second_renderings: SecondRenderings = no_renderings,
    fit_again: FitAgain | None = None,
) -> Findings:
    """Check that entries and their sheets are as submitted, and that boards follow from them.

    `predictions` METHOD/SCENE of a run are scored again, with those of `scenes` that are there, and what the entry says
    of that verification is compared with what comes out; with `fit_again` those that are labelled re-fitted are fitted
    too. Raises UserError where the folder is no leaderboard.
    """
    check_folder(leaderboard)
    reading = read_all(leaderboard, *FOLDERS)
    entries = reading.entries
    problems = [f"{leaderboard / printable(path)}: {reason}" for path, reason in reading.refused.items()]
    problems += [*_missing(leaderboard, reading), *_alike(leaderboard, reading)]
    problems += [*_stale_boards(leaderboard, make_boards(reading)), *_wrong_sheets(leaderboard, reading)]
    scored, not_fitted, passed_over, not_computed = 0, 0, list[str](), list[str]()
    if predictions is not None:
        by_id = {open_scenes([scene], allow_gaps)[0].id: scene for scene in scenes}
        rendered = once_a_scene(second_renderings)
        for path, entry in entries.items():
            try:
                opened, why = _scenes_of(entry, predictions, by_id, allow_gaps)
                if why:
                    passed_over.append(f"{leaderboard / path}: {why}")
                if opened:
                    if lacks := _score_again(leaderboard / path, entry, predictions, opened, rendered):
                        said = f"says that {', '.join(lacks)} was computed again; its weights or files are not here"
                        not_computed.append(f"{leaderboard / path}: {said}")
                    scored += 1
                    if entry["verification"]["label"] == RE_FITTED:
                        not_fitted += fit_again is None
                        _fit_again(leaderboard / path, entry, opened, fit_again)
            except UserError as e:
                problems.append(str(e))
        if not scored and not problems:
            expected = "predictions METHOD/SCENE of an entry, and its scenes"
            problems.append(str(problem(predictions, expected, "none", "correct --predictions")))
    return Findings(len(entries), scored, not_fitted, tuple(problems), tuple(passed_over), tuple(not_computed))


def _missing(leaderboard: Path, reading: Reading) -> Iterator[str]:
    """Yield a line for each path that the ledger has and no entry; the package comes without any archive."""
    listed = {path for _, path in read_ledger(leaderboard)}
    if not (leaderboard / ARCHIVE).is_dir():
        listed = {path for path in listed if not path.startswith(f"{ARCHIVE}/")}
    for path in sorted(listed - reading.entries.keys() - reading.refused.keys()):
        fix = f"restore it, submit its record again, or remove its lines from {LEDGER} to withdraw it"
        yield f"{leaderboard / printable(path)}: expected an entry, as {LEDGER} has a line of it, found none; {fix}"


def _alike(leaderboard: Path, reading: Reading) -> Iterator[str]:
    """Yield a line for each entry whose method's name is that of another but for case."""
    for path, others in same_but_for_case(reading.entries.keys()).items():
        expected = "a method's name that differs by more than case"
        yield f"{leaderboard / path}: expected {expected}, found {', '.join(others)}; remove one of them"


def _stale_boards(leaderboard: Path, boards: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each board file that is not as the entries give it."""
    for folder, name in FILES.items():
        path = leaderboard / name
        if folder not in boards:
            if path.exists():
                yield f"{path}: expected no such file, as there are no entries in {folder}/; remove it"
            continue
        most_bytes = 2 * len(json_text(boards[folder]))  # no fixed bound: a board grows with its entries
        try:
            found: Mapping[str, object] | None = read_json(path, "a board", most_bytes)
        except UserError as e:
            yield str(e)
            continue
        if found != boards[folder]:
            yield f"{path}: expected what the entries give, found other content; submit any record again"


def _wrong_sheets(leaderboard: Path, reading: Reading) -> Iterator[str]:
    """Yield a line for each sheet that is not as its entry states, and for each that no entry states."""
    stating = {path: entry[KEY] for path, entry in reading.entries.items() if KEY in entry}
    for path, stated in stating.items():
        try:
            read_sheet(sheet_path(leaderboard / path), stated)
        except UserError as e:
            yield str(e)
    known = {sheet_path(leaderboard / path) for path in stating.keys() | reading.refused.keys()}
    for sheet in sheets(leaderboard, *FOLDERS):
        if sheet not in known:
            yield f"{sheet}: expected no such file, as no entry states it; remove it"


def _scenes_of(
    entry: Entry, predictions: Path, scenes: Mapping[str, Path], allow_gaps: bool
) -> tuple[list[Scene], str]:
    """Return the scored scenes of an entry, opened, or none and why the predictions that are there are not its own.

    Neither where there are no predictions of its method.
    """
    record = entry["record"]
    folder = predictions / record["method"]["name"]
    ok = [scene for scene, cell in record["scenes"].items() if cell["status"] == "ok"]
    there = [scene for scene in ok if (folder / scene / SUMS).is_file()]
    if not there:
        return [], ""
    if lacks := [scene for scene in ok if scene not in there]:
        return [], f"no predictions of {', '.join(lacks)}"
    if lacks := [scene for scene in ok if scene not in scenes]:
        return [], f"{', '.join(lacks)} not among --scenes"
    seed = record["method"]["seed"]  # METHOD/ is of one
    if others := {read_info(folder / scene).method.seed for scene in ok} - {seed}:
        return [], f"predictions of seed {', '.join(map(str, others))}, the entry has {seed}"
    opened = open_scenes([scenes[scene] for scene in ok], allow_gaps, record["dataset"]["split"])
    if changed := [s.id for s in opened if s.revision not in revisions_of(s.id, record["dataset"])]:
        return [], f"other revisions of {', '.join(changed)}"
    return opened, ""


def _score_again(
    where: Path, entry: Entry, predictions: Path, scenes: Sequence[Scene], second_renderings: SecondRenderings
) -> list[str]:
    """Score an entry's predictions again, and return the metrics that it says were, and could not be now.

    Raises UserError where its record or its verification says otherwise.
    """
    record, stated = entry["record"], entry["verification"]
    rescored = verify_record(record, where, predictions / record["method"]["name"], scenes, second_renderings)
    if stated["label"] == CLAIMED:
        return []
    hidden = {m for m in stated["unverified"] if METRICS[m].weights is None} - rescored.unverified
    if hidden:
        fix = "submit the record again with --replace"
        raise problem(where, "no unverified metric that these files give", ", ".join(sorted(hidden)), fix)
    before = "carried_over" in stated and not stated["truth"]  # the check is younger than the entry
    if not before and (extra := sorted(rescored.truth.keys() ^ stated["truth"].keys())):
        fix = "submit the record again with --replace"
        raise problem(where, "a check beside the truth of each scored scene", f"not so of {', '.join(extra)}", fix)
    revisions, opened = record["dataset"]["scenes"], {scene.id: scene.revision for scene in scenes}
    for scene, check in stated["truth"].items():
        elsewhere = opened[scene] != revisions[scene]
        _check_truth(f"{where}, scene {scene}", check, rescored.truth[scene], elsewhere)
    truth = {scene: asdict(check) for scene, check in rescored.truth.items()}
    flags = flags_of({**entry, "verification": {**stated, "truth": truth}})
    known = {flag.partition(" (")[0] for flag in flags_of(entry)}
    if new := [flag for flag in flags if flag.partition(" (")[0] not in known]:
        raise problem(where, f"the flags {'; '.join(new)}", "none of them", "submit the record again with --replace")
    if KEY in entry:
        made = make_thumbnails(record, predictions / record["method"]["name"], scenes)
        check_sheet(sheet_path(where), entry[KEY], made)
    return [metric for metric in METRICS if metric in rescored.unverified - set(stated["unverified"])]


def _check_truth(where: str, stated: Mapping[str, Any], found: TruthCheck, elsewhere: bool) -> None:
    """Raise UserError unless an entry states of its predictions beside the truth what was found now.

    Bits are not compared with those of an equivalent scene's truth, `elsewhere`. What takes second renderings is of
    another target each time: its flags are compared, not its values.
    """
    for key in ("images", *(() if elsewhere else ("equal_images", "equal_pixels"))):
        if (value := getattr(found, key)) != stated[key]:
            raise problem(where, f"{key} {value}, as computed again", str(stated[key]), _EDITED)


def _fit_again(where: Path, entry: Entry, scenes: Sequence[Scene], fit_again: FitAgain | None) -> None:
    """Raise UserError where a second fit was not as the label says, or does not come out so now."""
    record, refit = entry["record"], entry["verification"]["refit"]
    claimed = {scene: cell["metrics"]["psnr"] for scene, cell in record["scenes"].items()}
    fix = "the entry was edited: restore it, or submit the record again with --refit and --replace"
    if refit["psnr"].keys() != claimed.keys() or refit["tolerance_db"] != TOLERANCE_DB:
        expected = f"a second fit of {', '.join(sorted(claimed))} within {TOLERANCE_DB} dB"
        raise problem(where, expected, f"{', '.join(sorted(refit['psnr']))} within {refit['tolerance_db']} dB", fix)
    for scene, psnr in refit["psnr"].items():
        least = 0.0 if refit["bit_equal"] else TOLERANCE_DB
        if not same_value(psnr, claimed[scene], max(least, METRICS["psnr"].tolerance)):
            raise problem(f"{where}, scene {scene}", f"a second fit of {claimed[scene]:.2f} dB", f"{psnr:.2f} dB", fix)
    if fit_again:
        fit_again(record, scenes)
