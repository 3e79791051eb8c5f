"""Enter result records into the leaderboard, each verified as far as its files allow."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from spike4dgs.benchmark.environment import environment, harness, utc_now
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import sha256_json, user_cache
from spike4dgs.benchmark.method import PAPER, Budget, Method, choose_device_for, get_method
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.benchmark.runs.apart.fit import Apart
from spike4dgs.benchmark.runs.cell import Job
from spike4dgs.benchmark.runs.record import COSTS, Record, read_record
from spike4dgs.benchmark.runs.refinement import SUFFIX
from spike4dgs.benchmark.runs.run import Settings, run_matrix
from spike4dgs.benchmark.scene.scene import Scene, open_scenes
from spike4dgs.leaderboard.entry import (
    CLAIMED,
    RE_FITTED,
    RE_SCORED,
    check_folder,
    check_no_oracle,
    check_numbers,
    entry_path,
    lock,
    remove_parts,
    write_entry,
)
from spike4dgs.leaderboard.rank import FILES, standing, write_boards
from spike4dgs.leaderboard.thumbnails import Thumbnails, make_thumbnails
from spike4dgs.leaderboard.tracks import LOCAL, place_of, with_equivalents
from spike4dgs.leaderboard.truth_check import SecondRenderings, no_renderings
from spike4dgs.leaderboard.verify import TOLERANCE_DB, verify_record


@dataclass(frozen=True)
class Refit:
    """The second fit: PSNR and costs by scene, and whether its predictions equal the first ones in every bit."""

    psnr: Mapping[str, float]
    tolerance_db: float
    bit_equal: bool
    costs: Mapping[str, Mapping[str, float | None]]
    apart: str  # what kept the fit to the training parts: PROCESS or CONTAINER


PROCESS, CONTAINER = "process", "container"


def fit_again(record: Record, scenes: Sequence[Scene], work: Path, console: Console, apart: Apart) -> Refit:
    """Fit a record's method on its scenes with its seed, budget and device, and compare the scores.

    Each fit has a process that sees the training part of its scene alone; `apart` may start it in a container.
    The run in `work` resumes after a kill and is removed at the end. Raises UserError where the installed method is
    another one than the record's, where a fit fails, and where a scene's PSNR differs by more than the tolerance.
    """
    name = record["method"]["name"]
    method = get_method(name.removesuffix(SUFFIX))
    out = work / sha256_json([record["method"], record["dataset"]])[:16]
    psnr, costs, bit_equal = dict[str, float](), dict[str, Mapping[str, float | None]](), True
    for scene in (s for s in scenes if s.id in record["scenes"]):
        claimed = record["scenes"][scene.id]
        again = _fit_scene(record, claimed, method, scene, out / scene.id, console, apart)
        psnr[scene.id], costs[scene.id] = again["metrics"]["psnr"], {cost: again[cost] for cost in COSTS}
        if abs(psnr[scene.id] - claimed["metrics"]["psnr"]) > TOLERANCE_DB:
            expected = f"a second fit within {TOLERANCE_DB} dB of the claimed {claimed['metrics']['psnr']:.2f} dB"
            fix = "submit what this version of the method gives"
            raise problem(f"{name} on {scene.id}", expected, f"{psnr[scene.id]:.2f} dB", fix)
        bit_equal = bit_equal and again["predictions_sha256"] == claimed["predictions_sha256"]
    shutil.rmtree(out)
    return Refit(psnr, TOLERANCE_DB, bit_equal, costs, CONTAINER if apart.container else PROCESS)


def _fit_scene(
    record: Record,
    claimed: Mapping[str, Any],
    method: Method,
    scene: Scene,
    out: Path,
    console: Console,
    apart: Apart,
) -> Mapping[str, Any]:
    wanted, where = record["method"], f"{record['method']['name']} on {scene.id}"
    if claimed["status"] != "ok" or claimed["budget"] is None or wanted["seed"] is None:
        fix = "submit without --refit"
        raise problem(where, "a scored cell with budget and seed", "none", fix)
    budget = Budget(published=True) if claimed["budget"] == PAPER else Budget(float(claimed["budget"]))
    device = choose_device_for([method], claimed["device"] or "cpu")
    variants = {v.name: v for v in Job(method, scene, wanted["seed"], device, budget).variants}
    found = variants[wanted["name"]].as_dict() if wanted["name"] in variants else {}
    if other := sorted(k for k in {*found, *wanted} if found.get(k) != wanted.get(k)):
        fix = "install the version that made the record, or submit without --refit"
        raise problem(where, "the installed method as in the record", f"another {', '.join(other)}", fix)
    settings = Settings(out, seed=wanted["seed"], device=device, budget=budget, metrics=("psnr",), apart=apart)
    records = {r["method"]["name"]: r for r in run_matrix([scene], [method], settings, console)}
    cell: Mapping[str, Any] = records[wanted["name"]]["scenes"][scene.id]
    if cell["status"] != "ok" or cell["metrics"]["psnr"] is None:
        raise problem(where, "a second fit that ends", cell["error"] or "no PSNR", f"see {out}")
    return cell


def refits_of(leaderboard: Path) -> Path:
    """Return the folder of a leaderboard's second fits: the user's, as a sent leaderboard may hold any predictions."""
    return user_cache() / "refits" / sha256_json(str(leaderboard.resolve()))[:16]


@dataclass(frozen=True)
class Files:
    """The files that a record is verified from, and how far."""

    predictions: Path | None
    scenes: tuple[Path, ...]
    allow_gaps: bool = False
    second_renderings: SecondRenderings = no_renderings
    refit: bool = False
    container: str = ""  # the command that starts the process of a second fit; see `Apart`


@dataclass(frozen=True)
class Verified:
    """A record, what was verified of it, why nothing was (an empty text otherwise), and thumbnails if it was."""

    record: Record
    verification: Mapping[str, Any]
    missing: str
    thumbnails: Thumbnails | None = None


@dataclass(frozen=True)
class Submitted:
    """What came of records, in lines: where they stand, what the boards do not list, and why some were refused."""

    standings: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)


def submit(result: Path, files: Files, leaderboard: Path, replace: bool = False) -> Submitted:
    """Verify a record as far as its files are given, and enter it. Raises UserError where it is refused."""
    check_folder(leaderboard)
    return _enter([_verify(result, files, leaderboard)], leaderboard, replace, None)


def submit_all(
    results: Mapping[Path, Path | None],
    *,
    scenes: tuple[Path, ...],
    leaderboard: Path,
    replace: bool = False,
    allow_gaps: bool = False,
) -> Submitted:
    """Enter several records, each with its predictions if there are some, and make the boards once.

    A record that is refused does not stop the others.
    """
    check_folder(leaderboard)
    verified, refused = [], list[str]()
    for result, predictions in results.items():
        try:
            verified.append(_verify(result, Files(predictions, scenes, allow_gaps), leaderboard))
        except UserError as e:
            refused.append(str(e))
    return _enter(verified, leaderboard, replace, refused)


def _verify(result: Path, files: Files, leaderboard: Path) -> Verified:
    record = read_record(result)
    check_no_oracle(record, result)
    check_numbers(record, result)
    entry_path(record)  # names that cannot be file names are refused before the work
    opened = open_scenes(files.scenes, files.allow_gaps, record["dataset"]["split"]) if files.scenes else []
    record = with_equivalents(record, opened)
    missing = _reason_not_to_verify(record, files.predictions, opened)
    if files.refit and missing:
        raise problem("--refit", "predictions and scenes of a scored record", missing, "give them")
    computed = {metric for cell in record["scenes"].values() for metric in cell["computed"]}
    if files.predictions is None or missing:
        nothing: dict[str, Any] = {"by": None, "truth": {}, "refit": None}
        unverified = [m for m in METRICS if m in computed]
        return Verified(record, {"label": CLAIMED, "unverified": unverified, **nothing}, missing)
    rescored = verify_record(record, result, files.predictions, opened, files.second_renderings)
    refit = None
    if files.refit:
        refit = fit_again(record, opened, refits_of(leaderboard), make_console(), Apart(files.container))
    verification = {
        "label": RE_FITTED if refit else RE_SCORED,
        "unverified": [m for m in METRICS if m in rescored.unverified],
        "by": {"when": utc_now(), "harness": harness(), "environment": environment("cpu")},
        "truth": {scene: asdict(check) for scene, check in rescored.truth.items()},
        "refit": asdict(refit) if refit else None,
    }
    return Verified(record, verification, "", make_thumbnails(record, files.predictions, opened))


def _enter(verified: Sequence[Verified], leaderboard: Path, replace: bool, refused: list[str] | None) -> Submitted:
    """Write entries and boards under the leaderboard's lock. Without `refused` the first refusal raises UserError."""
    entered = []
    with lock(leaderboard):
        remove_parts(leaderboard)
        for one in verified:
            try:
                entry = write_entry(leaderboard, one.record, one.verification, replace, one.thumbnails)
                entered.append((one, entry))
            except UserError as e:
                if refused is None:
                    raise
                refused.append(str(e))
        boards = write_boards(leaderboard)
    found, ranked = Submitted(refused=refused or []), False
    for one, entry in entered:
        v = entry["verification"]
        why = f" ({one.missing})" if one.missing and v["label"] == CLAIMED else ""
        if v["label"] != CLAIMED and v["unverified"]:
            why = f" (as claimed, not computed again: {', '.join(v['unverified'])})"
        at = standing(boards, entry_path(one.record))
        ranked = ranked or at.startswith("place")
        found.standings.append(f"{one.record['method']['name']}: {v['label']}{why}, {at}")
    if ranked:  # an interval, which takes a comparison with all others
        found.standings.append(f"ranks, with their intervals: spike4dgs leaderboard --leaderboard {leaderboard}")
    places = [place_of(one.record) for one, _ in entered]
    for folder, reason in dict.fromkeys((p.folder, p.why) for p in places if not p.is_public):
        found.standings.append(f"local board, in {leaderboard / FILES[LOCAL]}, not on a track: {folder}: {reason}")
    for board in boards.values():
        found.warnings.extend(f"not listed: {leaderboard / i['entry']}: {i['reason']}" for i in board["refused"])
    return found


def _reason_not_to_verify(record: Record, predictions: Path | None, scenes: Sequence[Scene]) -> str:
    """Return the reason why the record cannot be verified, or an empty string."""
    if predictions is not None and not predictions.is_dir():
        raise problem(predictions, "a predictions folder", "no such folder", "check the path of --predictions")
    if predictions is None:
        return "no --predictions"
    if absent := sorted(set(record["scenes"]) - {s.id for s in scenes}):
        return f"no --scenes for {', '.join(absent)}"
    if all(cell["status"] != "ok" for cell in record["scenes"].values()):
        return "nothing was scored"
    return ""
