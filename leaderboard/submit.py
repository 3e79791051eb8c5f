"""`submit`: check a result record, compute it again from the files where they are at hand, and rank it.

    LEADERBOARD/entries/DATASET/METHOD.json         one record per method, labelled verified or self-reported
    LEADERBOARD/entries/DATASET/METHOD@SPLIT.json   the same on another split than the default one
    LEADERBOARD/leaderboard.json                    ranked rows, made from the entries alone

DATASET is the ids of the scenes, joined by "+".

Fit time, speed and memory are taken from prediction.json: they cannot be computed again. Metrics whose weights this
machine lacks are kept as claimed, and the entry lists them as unverified.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from spike4dgs.benchmark.environment import utc_now
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import read_json, write_json
from spike4dgs.benchmark.metrics.selection import select_metrics
from spike4dgs.benchmark.metrics.table import METRICS, PRIMARY
from spike4dgs.benchmark.results.record import COSTS, Cell, Record, check_record, is_complete, read_record, same_value
from spike4dgs.benchmark.results.score import open_for, prediction_folders, score_scene
from spike4dgs.benchmark.scene.scene import Scene, open_scenes
from spike4dgs.benchmark.scene.splits import DEFAULT_SPLIT
from spike4dgs.benchmark.schemas import check_schema, load_schema

ENTRY, BOARD = "spike4dgs-entry/1", "spike4dgs-leaderboard/1"
GAIN_TOLERANCE = 1e-6  # relative: between machines the last bits of a mean differ
Entry = dict[str, Any]


def submit(
    result: Positional[Path],
    *,
    predictions: Path | None = None,
    scenes: tuple[Path, ...] = (),
    leaderboard: Path = Path("leaderboard"),
    replace: bool = False,
    allow_gaps: bool = False,
) -> int:
    """Check a result record and enter it into the leaderboard.

    With predictions and scenes, every hash and every score is computed again and the entry is labelled verified;
    scores whose weights are not on this machine are listed as unverified. Without predictions and scenes the entry is
    labelled self-reported. Submitting a record twice changes nothing.

    Args:
        result: Result record, as written by score or run-benchmark.
        predictions: The method's predictions folder, or the folder of one per scene id.
        scenes: Scene folders of the record's dataset.
        leaderboard: Leaderboard folder.
        replace: Replace another record of the same method.
        allow_gaps: Accept recordings with gaps.
    """
    record = read_record(result)
    opened = open_scenes(scenes, allow_gaps, record["dataset"]["split"]) if scenes else []
    missing = _missing(record, predictions, opened)
    unverified = {metric for cell in record["scenes"].values() for metric in cell["computed"]}
    if predictions is not None and not missing:
        unverified = verify_record(record, result, predictions, opened)
    label = "self-reported" if missing else "verified"
    entry = _write_entry(leaderboard, record, label, [m for m in METRICS if m in unverified], replace)
    board = write_leaderboard(leaderboard)
    name = record["method"]["name"]
    why = f" ({missing})" if missing and entry["label"] == label else ""
    if entry["label"] == "verified" and entry["unverified"]:
        why = f" (as claimed, for lack of weights: {', '.join(entry['unverified'])})"
    print(f"{name}: {entry['label']}{why}, {_standing(board, record)}")
    return 0


def _missing(record: Record, predictions: Path | None, scenes: Sequence[Scene]) -> str:
    """What keeps the record from being verified; empty if nothing does."""
    if predictions is not None and not predictions.is_dir():
        raise problem(predictions, "a predictions folder", "no such folder", "check the path of --predictions")
    if predictions is None:
        return "no --predictions"
    if absent := sorted(set(record["scenes"]) - {s.id for s in scenes}):
        return f"no --scenes for {', '.join(absent)}"
    if all(cell["status"] != "ok" for cell in record["scenes"].values()):
        return "nothing was scored"
    return ""


def verify_record(record: Record, where: Path, predictions: Path, scenes: Sequence[Scene]) -> set[str]:
    """Hash and score the predictions of every scored scene again. Returns the metrics that could not be computed.

    Raises UserError where a scene, a hash, the method or a score differs from the record.
    """
    used = [s for s in scenes if s.id in record["scenes"]]
    for scene in used:
        revision = record["dataset"]["scenes"][scene.id]
        if scene.revision != revision:
            fix = "give the scene that was scored, or score again"
            raise problem(scene.root, f"scene revision {revision[:16]}...", f"{scene.revision[:16]}...", fix)
    folders = prediction_folders(predictions, used)
    available, unverified = select_metrics(), set[str]()
    for scene in used:
        cell = record["scenes"][scene.id]
        if cell["status"] != "ok":
            continue
        found = open_for(folders[scene.id], scene)
        if found.sha256 != cell["predictions_sha256"]:
            expected = f"predictions {cell['predictions_sha256'][:16]}..."
            raise problem(found.root, expected, f"{found.sha256[:16]}...", "give the predictions that were scored")
        if found.info.method.as_dict() != record["method"]:
            expected = f"predictions of {record['method']['name']} as in the record"
            raise problem(found.root, expected, f"{found.info.method}"[:200], "score the predictions again")
        computed = score_scene(found, scene, available.among(cell["computed"]))
        # The same weights, or none: another MetaIQA says nothing about a claim.
        shared = {m for m, sha256 in computed["computed"].items() if cell["computed"][m] == sha256}
        _check_same(cell, computed, shared, f"{where}, scene {scene.id}")
        unverified |= cell["computed"].keys() - shared
    return unverified


def _check_same(claimed: Cell, computed: Cell, metrics: Collection[str], where: str) -> None:
    fix = "score the predictions again with this version"
    gain = (claimed["gain_aligned"], computed["gain_aligned"])
    if not same_value(*gain, GAIN_TOLERANCE * (gain[1] or 1)):
        raise problem(where, f"gain_aligned {gain[1]}", str(gain[0]), fix)
    if set(claimed["per_image"]) != set(computed["per_image"]):
        found = f"{len(claimed['per_image'])} images"
        raise problem(where, f"scores of the {len(computed['per_image'])} targets", found, fix)
    for name, values in computed["per_image"].items():
        for metric in metrics:
            value = values[metric]
            if not same_value(claimed["per_image"][name][metric], value, METRICS[metric].tolerance):
                found = str(claimed["per_image"][name][metric])
                raise problem(f"{where}, {name}", f"{metric} = {value} as computed from the files", found, fix)
    for key in (*COSTS, "budget", "device", "fitted_with"):
        if claimed[key] != computed[key]:
            raise problem(where, f"{key} {computed[key]} as in prediction.json", str(claimed[key]), fix)


def _write_entry(leaderboard: Path, record: Record, label: str, unverified: list[str], replace: bool) -> Entry:
    """Write the entry, or keep the one that says the same; a better label or fewer unverified scores are taken over."""
    path = leaderboard / "entries" / f"{entry_name(record)}.json"
    checked = {"label": label, "unverified": unverified}
    entry: Entry = {"schema": ENTRY, **checked, "submitted": utc_now(), "record": record}
    if path.is_file():
        old = read_entry(path)
        if _claim(old["record"]) == _claim(record):
            if _confidence(entry) <= _confidence(old):
                return old
            entry = {**old, **checked}
        elif not replace:
            fix = "pass --replace to put the new record in its place"
            raise problem(path, "no entry of this method, or the same record", "another record", fix)
    write_json(path, entry)
    return entry


def _confidence(entry: Entry) -> tuple[bool, int]:
    return entry["label"] == "verified", -len(entry["unverified"])


def entry_name(record: Mapping[str, Any]) -> str:
    """Where a record's entry is, without suffix: the dataset, the method, and the split unless it is the default."""
    name, split = str(record["method"]["name"]), record["dataset"]["split"]
    return f"{record['dataset']['name']}/{name if split == DEFAULT_SPLIT else f'{name}@{split}'}"


def _claim(record: Mapping[str, Any]) -> str:
    """What a record claims, without when and where it was scored: equal claims are the same record."""
    context = ("created", "command", "environment", "harness")
    return json.dumps({k: v for k, v in record.items() if k not in context}, sort_keys=True)


def read_entry(path: Path) -> Entry:
    """Read an entry. Raises UserError where it is damaged, invalid, or its file name is not its record's."""
    entry = read_json(path, "a leaderboard entry")
    check_schema(entry, load_schema("spike4dgs.leaderboard", "entry.schema.json"), path, "submit the record again")
    check_record(entry["record"], path)
    found = f"{path.parent.name}/{path.stem}"
    if (name := entry_name(entry["record"])) != found:
        raise problem(path, f"the entry of {found}", name, "rename the file or its folder")
    return entry


def write_leaderboard(folder: Path) -> dict[str, Any]:
    """Make leaderboard.json from the entries: same entries, same bytes. Returns its content."""
    entries = [read_entry(p) for p in sorted((folder / "entries").glob("*/*.json"))]
    boards: dict[str, list[Entry]] = {}
    for entry in entries:
        contest = {"dataset": entry["record"]["dataset"], "protocol": entry["record"]["protocol"]}
        boards.setdefault(json.dumps(contest, sort_keys=True), []).append(entry)
    keys = ("id", "title", "definition", "higher_is_better", "implementation", "takes", "unit", "digits")
    board = {
        "schema": BOARD,
        "primary": PRIMARY,
        "metrics": [{key: getattr(m, key) for key in keys} for m in METRICS.values()],
        "boards": [{**json.loads(contest), "rows": rank(boards[contest])} for contest in sorted(boards)],
    }
    path = folder / "leaderboard.json"
    check_schema(board, load_schema("spike4dgs.leaderboard", "leaderboard.schema.json"), path, "restore the entries")
    write_json(path, board)
    return board


def rank(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """Rows of one board, best first: complete records are ranked, the others follow without a rank.

    Of equal values the one submitted first is first.
    """
    sign = -1.0 if METRICS[PRIMARY].higher_is_better else 1.0

    def order(entry: Entry) -> tuple[float, str, str]:
        value = entry["record"]["mean"][PRIMARY] if is_complete(entry["record"]) else None
        name = entry["record"]["method"]["name"]
        return (math.inf if value is None else sign * value, entry["submitted"], name)

    rows = []
    for position, entry in enumerate(sorted(entries, key=order), start=1):
        record = entry["record"]
        seconds = [cell["fit_seconds"] for cell in record["scenes"].values()]
        rows.append(
            {
                "rank": None if order(entry)[0] == math.inf else position,
                "method": record["method"]["name"],
                "label": entry["label"],
                "unverified": entry["unverified"],
                "submitted": entry["submitted"],
                "entry": f"entries/{entry_name(record)}.json",
                "mean": record["mean"],
                "status": {scene: cell["status"] for scene, cell in record["scenes"].items()},
                "fit_seconds": None if None in seconds else math.fsum(seconds),
            }
        )
    return rows


def _standing(board: Mapping[str, Any], record: Record) -> str:
    dataset = record["dataset"]
    where = dataset["name"] + ("" if dataset["split"] == DEFAULT_SPLIT else f", split {dataset['split']}")
    for contest in board["boards"]:
        for row in contest["rows"]:
            if row["entry"] == f"entries/{entry_name(record)}.json":
                place = "not ranked" if row["rank"] is None else f"rank {row['rank']} of {len(contest['rows'])}"
                return f"{place} on {where}"
    return "not listed"
