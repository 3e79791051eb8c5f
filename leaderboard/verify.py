"""Verify a record, or a whole leaderboard.

The predictions of a record are hashed and scored again, and every value is compared with the record's.

Fit time, speed and memory cannot be computed again: they must equal those in prediction.json. Metrics whose weights
or files are not here are not compared. The predictions are compared with the truth and its noise (`truth_check`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import read_json
from spike4dgs.benchmark.metrics.measure import select_metrics
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.runs.held_out import has_truth
from spike4dgs.benchmark.runs.predictions import SUMS, read_info
from spike4dgs.benchmark.runs.record import COSTS, Cell, Record, same_value, sensor_of
from spike4dgs.benchmark.runs.score import open_for, prediction_folders, score_scene
from spike4dgs.benchmark.scene.scene import Scene, open_scenes
from spike4dgs.benchmark.untrusted import printable
from spike4dgs.leaderboard.entry import CLAIMED, FOLDERS, RE_FITTED, Entry, check_folder
from spike4dgs.leaderboard.rank import FILES, flags_of, make_boards
from spike4dgs.leaderboard.reading import Reading, read_all
from spike4dgs.leaderboard.thumbnails import KEY, check_sheet, make_thumbnails, read_sheet, sheet_path, sheets
from spike4dgs.leaderboard.tracks import match_release
from spike4dgs.leaderboard.truth_check import SecondRenderings, TruthCheck, check_truth, no_renderings, once_a_scene

GAIN_TOLERANCE = 1e-6  # relative: between machines the last bits of a mean differ
# Of an equivalent scene's scores on the release: dB, and of other metrics relative. On `tiny` scenes with 8 and with 16
# lanes, the scores of an image by six methods differed by 0.0074 dB and 0.0017 at most.
ELSEWHERE_DB, ELSEWHERE = 0.02, 5e-3
CEILING_DB = 0.1  # of a noise ceiling that was rendered on another processor
# Fits on two CPUs differ by their last bits, which a fit amplifies: by 0.24 dB in a scene's mean PSNR at most, between
# two CPUs and six methods on car and turntable.
TOLERANCE_DB = 0.3
_EDITED = "the entry was edited: restore it, or submit the record again with --replace"
FitAgain = Callable[[Record, Sequence[Scene]], object]  # raises UserError where the scores are not reached


@dataclass(frozen=True)
class Rescored:
    """What came of scoring again: the metrics that could not be computed, and by scene the check beside the truth."""

    unverified: frozenset[str]
    truth: Mapping[str, TruthCheck]


def verify_record(
    record: Record,
    where: Path,
    predictions: Path,
    scenes: Sequence[Scene],
    second_renderings: SecondRenderings = no_renderings,
    fitted: Mapping[str, str] | None = None,
) -> Rescored:
    """Hash and score the predictions of every scored scene again, and check them beside the truth.

    `fitted`: scene id -> revision of the training part that the method was given instead of the scene. Raises
    UserError where a scene, a hash, the method or a score differs from the record.
    """
    used = [s for s in scenes if s.id in record["scenes"]]
    for scene in used:
        _check_scene(scene, record["dataset"])
        sensor = sensor_of(scene.meta)
        if (claimed := record.get("sensors", {}).get(scene.id, sensor)) != sensor:
            raise problem(f"{where}, scene {scene.id}", f"sensor {sensor or 'not stated'}", claimed, "score again")
    folders = prediction_folders(predictions, used)
    available, unverified, truth = select_metrics(), set[str](), dict[str, TruthCheck]()
    for scene in used:
        cell = record["scenes"][scene.id]
        if cell["status"] != "ok":
            continue
        revision = record["dataset"]["scenes"][scene.id]
        elsewhere = scene.revision != revision  # made and scored on an equivalent scene
        found = open_for(folders[scene.id], scene, {scene.id: revision} if elsewhere else fitted)
        if found.sha256 != cell["predictions_sha256"]:
            expected = f"predictions {cell['predictions_sha256'][:16]}..."
            raise problem(found.root, expected, f"{found.sha256[:16]}...", "give the predictions that were scored")
        method, claimed = found.info.method.as_dict(), record["method"]
        if "given" not in method:  # older predictions do not have the key
            claimed = {k: v for k, v in claimed.items() if k != "given"}
        if method != claimed:
            expected = f"predictions of {record['method']['name']} as in the record"
            raise problem(found.root, expected, f"{found.info.method}"[:200], "score the predictions again")
        computed = score_scene(found, scene, available.among(cell["computed"]))
        # The same weights, or none: another MetaIQA says nothing about a claim.
        shared = {m for m, sha256 in computed["computed"].items() if cell["computed"][m] == sha256}
        _check_same(cell, computed, shared, f"{where}, scene {scene.id}", elsewhere)
        unverified |= cell["computed"].keys() - shared
        if has_truth(scene):
            truth[scene.id] = check_truth(found, scene, second_renderings)
    return Rescored(frozenset(unverified), truth)


def _check_scene(scene: Scene, dataset: Mapping[str, Any]) -> None:
    """Raise UserError unless a scene is the one of a record's dataset, or the release's that this is equivalent to."""
    revision, *equivalent = _revisions(scene.id, dataset)
    if scene.revision not in (revision, *equivalent):
        fix = "give the scene that was scored, or score again"
        raise problem(scene.root, f"scene revision {revision[:16]}...", f"{scene.revision[:16]}...", fix)
    if equivalent and scene.revision == revision:
        match = match_release(scene)
        if match is None or not match.is_equivalent or match.revision != equivalent[0]:
            found = next(iter(match.reasons), match.revision[:16]) if match else "no fingerprint to compare with"
            expected = f"a scene that is equivalent to revision {equivalent[0][:16]}..."
            raise problem(scene.root, expected, found, "submit the record again, with its scenes")


def _check_same(claimed: Cell, computed: Cell, metrics: Collection[str], where: str, elsewhere: bool) -> None:
    """Raise UserError at the first value of `metrics`, gain or cost that differs from the computed one.

    `elsewhere`: the scores were computed on an equivalent scene.
    """
    fix = "score the predictions again with this version"
    gain = (claimed["gain_aligned"], computed["gain_aligned"])
    if not same_value(*gain, (ELSEWHERE if elsewhere else GAIN_TOLERANCE) * (gain[1] or 1)):
        raise problem(where, f"gain_aligned {gain[1]}", str(gain[0]), fix)
    if set(claimed["per_image"]) != set(computed["per_image"]):
        found = f"{len(claimed['per_image'])} images"
        raise problem(where, f"scores of the {len(computed['per_image'])} targets", found, fix)
    for name, values in computed["per_image"].items():
        for metric in metrics:
            value = values[metric]
            tolerance = METRICS[metric].tolerance
            if elsewhere:
                tolerance = ELSEWHERE_DB if METRICS[metric].unit == "dB" else ELSEWHERE * max(abs(value or 0), 1)
            if not same_value(claimed["per_image"][name][metric], value, tolerance):
                found = str(claimed["per_image"][name][metric])
                raise problem(f"{where}, {name}", f"{metric} = {value} as computed from the files", found, fix)
    for key in (*COSTS, "budget", "device", "fitted_with"):
        if claimed[key] != computed[key]:
            raise problem(where, f"{key} {computed[key]} as in prediction.json", str(claimed[key]), fix)


@dataclass(frozen=True)
class Findings:
    """What came of checking a leaderboard: how many entries it has, how many were scored and fitted again, and the
    problems. `not_fitted` counts the entries that are labelled re-fitted, which scores alone do not bear out."""

    entries: int
    scored: int
    not_fitted: int
    problems: tuple[str, ...]


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
    problems += [*_stale_boards(leaderboard, make_boards(reading)), *_wrong_sheets(leaderboard, reading)]
    scored = not_fitted = 0
    if predictions is not None:
        by_id = {open_scenes([scene], allow_gaps)[0].id: scene for scene in scenes}
        rendered = once_a_scene(second_renderings)
        for path, entry in entries.items():
            try:
                if opened := _scenes_of(entry, predictions, by_id, allow_gaps):
                    _score_again(leaderboard / path, entry, predictions, opened, rendered)
                    scored += 1
                    if entry["verification"]["label"] == RE_FITTED:
                        not_fitted += fit_again is None
                        _fit_again(leaderboard / path, entry, opened, fit_again)
            except UserError as e:
                problems.append(str(e))
    return Findings(len(entries), scored, not_fitted, tuple(problems))


def _stale_boards(leaderboard: Path, boards: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line for each board file that is not as the entries give it."""
    for folder, name in FILES.items():
        path = leaderboard / name
        if folder not in boards:
            if path.exists():
                yield f"{path}: expected no such file, as there are no entries in {folder}/; remove it"
            continue
        try:
            found: Mapping[str, object] | None = read_json(path, "a board")
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


def _scenes_of(entry: Entry, predictions: Path, scenes: Mapping[str, Path], allow_gaps: bool) -> list[Scene]:
    """Return the scored scenes of an entry, opened; none unless all are among those given, with its seed."""
    record = entry["record"]
    folder = predictions / record["method"]["name"]
    ok = [scene for scene, cell in record["scenes"].items() if cell["status"] == "ok"]
    if not ok or any(not (folder / scene / SUMS).is_file() or scene not in scenes for scene in ok):
        return []
    if any(read_info(folder / scene).method.seed != record["method"]["seed"] for scene in ok):  # METHOD/ is of one seed
        return []
    opened = open_scenes([scenes[scene] for scene in ok], allow_gaps, record["dataset"]["split"])
    return opened if all(scene.revision in _revisions(scene.id, record["dataset"]) for scene in opened) else []


def _revisions(scene: str, dataset: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the revision of a record's scene, and the release's that it is equivalent to."""
    equivalent = dataset.get("equivalent", {}).get(scene)
    return dataset["scenes"][scene], *([equivalent["revision"]] if equivalent else [])


def _score_again(
    where: Path, entry: Entry, predictions: Path, scenes: Sequence[Scene], second_renderings: SecondRenderings
) -> None:
    """Score an entry's predictions again. Raises UserError where its record or its verification says otherwise."""
    record, stated = entry["record"], entry["verification"]
    rescored = verify_record(record, where, predictions / record["method"]["name"], scenes, second_renderings)
    if stated["label"] == CLAIMED:
        return
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


def _check_truth(where: str, stated: Mapping[str, Any], found: TruthCheck, elsewhere: bool) -> None:
    """Raise UserError unless an entry states of its predictions beside the truth what was found now.

    What takes second renderings is compared where there were and are some; another processor renders other last bits.
    So bits are not compared with those of an equivalent scene's truth, `elsewhere`.
    """
    allowed = {"noise_share": found.noise_share_error, "noise_share_error": found.noise_share_error}
    allowed["ceiling_db"] = CEILING_DB
    for key, value in asdict(found).items():
        if (elsewhere and key.startswith("equal")) or (key in allowed and (value is None or stated[key] is None)):
            continue
        if abs(value - stated[key]) > (allowed.get(key) or 0.0):
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
