"""The tables of the Spike4DGS paper: which methods on which worlds, the published numbers, and ranks beside ranks.

The published scenes are not available, so the published values never mix with measured ones: they have columns of
their own, and the order of the methods is compared.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.metrics.measure import mean, measure
from spike4dgs.benchmark.metrics.metric import Metric
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.reports.console import seeds_of_methods
from spike4dgs.benchmark.runs.record import COSTS, Record
from spike4dgs.benchmark.runs.refinement import is_refined
from spike4dgs.benchmark.scene.scene import Scene

SCHEMA = "spike4dgs-table/1"
POSES = ("given", "estimated")  # are methods given the rig's poses?
UNCALIBRATED_NOTE = (
    "The paper takes its own method's poses from MSDI and says that the other rows begin with DUSt3R's points: "
    "the same values stand here and where the poses are given."
)
MEAN = "mean"  # column of rows that are published without their scenes
ALSO = ("psnr", "ssim", "psnr_dynamic", "ssim_dynamic", "flip")  # measured beside the published metrics


@dataclass(frozen=True)
class PublishedTable:
    """A table of the paper. `rows`: method -> column -> values, one for each of `metrics`.

    Columns are worlds, or, where the table compares numbers of views, `splits` of its worlds. A row that is published
    as a mean over the worlds has the one column MEAN; a row that we add has none.
    """

    number: int
    title: str
    source: str
    note: str
    worlds: tuple[str, ...]
    metrics: tuple[str, ...]  # ids in our metric table
    names: tuple[str, ...]  # what the paper calls them
    rows: Mapping[str, Mapping[str, tuple[float, ...]]]
    splits: tuple[str, ...] = ()

    def value(self, method: str, column: str, metric: str) -> float | None:
        """Return a published value; None where there is none."""
        values = self.rows.get(method, {}).get(column)
        return values[self.metrics.index(metric)] if values and metric in self.metrics else None

    def mean(self, method: str, metric: str) -> float | None:
        """Return the mean over the table's columns, or the published mean."""
        if (published_mean := self.value(method, MEAN, metric)) is not None:
            return published_mean
        return mean(self.value(method, column, metric) for column in self.splits or self.worlds)


@cache
def published(number: int, poses: str = POSES[0]) -> PublishedTable:
    """Return a table as published; with `poses` "estimated" its rows are methods that estimate them themselves.

    Raises UserError for a number that is none of those in `published_tables.json`, and for a table without such rows.
    """
    text = (package_files("spike4dgs.benchmark.reports") / "published_tables.json").read_text(encoding="utf-8")
    tables = json.loads(text)
    if str(number) not in tables:
        known = [f"{n} ({tables[n]['title'].lower()})" for n in tables if n.isdecimal()]
        fix = "choose one of them; `spike4dgs speed images` makes table 6, images from spikes"
        raise problem("--table", ", ".join(known), str(number), fix)
    table = tables[str(number)]
    ids, names = zip(*table["metrics"], strict=True)
    rows = {m: {w: tuple(v) for w, v in r.items()} for m, r in table["rows"].items()}
    worlds, splits = tuple(table["worlds"]), tuple(table.get("splits", ()))
    title, note = table["title"], table["note"]
    if poses != POSES[0]:
        rows = _without_poses(number, poses, rows, tables["uncalibrated"])
        title, note = f"{title}, poses estimated", f"{note} {UNCALIBRATED_NOTE}"
    return PublishedTable(number, title, tables["source"], note, worlds, ids, names, rows, splits)


def _without_poses(
    number: int, poses: str, rows: Mapping[str, Any], partners: Mapping[str, str | None]
) -> dict[str, Any]:
    """Return the rows whose poses are estimated, each with the published values of its partner."""
    if poses not in POSES:
        raise problem("--poses", f"one of {', '.join(POSES)}", repr(poses), "correct the name")
    if not set(partners.values()) - {None} <= set(rows):
        fix = "each of its rows states its own poses; use --table 1 or 2"
        raise problem("--poses", f"given for table {number}", poses, fix)
    return {name: rows[partner] if partner else {} for name, partner in partners.items()}


def table_scenes(table: PublishedTable, data: Path, profile: str) -> tuple[Path, ...]:
    """Return the scene folders of a table: variant 0 of its worlds. Raises UserError where one is missing."""
    paths = tuple(data / f"{world}-0-{profile}" for world in table.worlds)
    if missing := [p.name for p in paths if not p.is_dir()]:
        fix = f"spike4dgs make-dataset {' '.join(table.worlds)} --profile {profile} --out {data}"
        raise problem(data, f"the scenes of table {table.number}", f"no {', '.join(missing)}", fix)
    return paths


def table_columns(table: PublishedTable) -> tuple[str, ...]:
    """Return the metric ids of a table's columns: the published ones, then those that are measured besides."""
    return (*table.metrics, *(m for m in ALSO if m not in table.metrics))


def truth_scores(scene: Scene, metrics: Sequence[Metric]) -> dict[str, float | None]:
    """Return the ground truth's own scores by the no-reference metrics among `metrics`: means over a scene's targets.

    The measure of such a metric on a scene: methods that score better than the truth did not come nearer to it.
    """
    found: dict[str, list[float | None]] = {m.id: [] for m in metrics if m.blind}
    for target in scene.targets if found else ():
        truth = scene.ground_truth(target)
        pair = ImagePair(truth, truth, scene.moving(target), f"{scene.id}, {target.name}")
        values = measure(pair, None, [METRICS[m] for m in found]).values
        for metric, gathered in found.items():
            gathered.append(values[metric])
    return {metric: mean(gathered) for metric, gathered in found.items()}


def build_table(
    table: PublishedTable,
    records: Sequence[Record],
    worlds: Mapping[str, str],
    truths: Mapping[str, Mapping[str, float | None]] | None = None,
) -> dict[str, Any]:
    """Return a table's content: every cell a number or a reason, published values beside.

    worlds: scene id -> column; truths: scene id -> its `truth_scores`.
    """
    rows = [_row(table, record, worlds) for record in records]
    for metric in table_columns(table):
        measured = [None if is_refined(r["method"]) else r["mean"][metric]["value"] for r in rows]
        printed = [r["mean"][metric]["published"] for r in rows]
        both = [p if v is not None else None for v, p in zip(measured, printed, strict=True)]
        ours, theirs = ranks(measured, METRICS[metric]), ranks(both, METRICS[metric])
        for row, rank, published_rank in zip(rows, ours, theirs, strict=True):
            row["mean"][metric] |= {"rank": rank, "published_rank": published_rank}
    return {
        "schema": SCHEMA,
        "table": table.number,
        "title": table.title,
        "published_source": table.source,
        "published_note": table.note,
        "scenes": {scene: worlds[scene] for scene in records[0]["scenes"]},
        "dataset": records[0]["dataset"],
        "metrics": [
            {"id": m, "title": METRICS[m].title, "higher_is_better": METRICS[m].higher_is_better}
            for m in table_columns(table)
        ],
        "agreement": {m: kendall_tau(rows, m) for m in table.metrics},
        "rows": rows,
        "truth": {scene: dict(values) for scene, values in (truths or {}).items()},
        "harness": records[0]["harness"],
        "environment": records[0]["environment"],
    }


def _row(table: PublishedTable, record: Record, worlds: Mapping[str, str]) -> dict[str, Any]:
    name, columns = record["method"]["name"], table_columns(table)
    scenes = {}
    for scene, cell in record["scenes"].items():
        values = {}
        for metric in columns:
            value = cell["metrics"][metric]
            reason = None if value is not None else cell["error"] or cell["notes"].get(metric, "no value")
            values[metric] = {
                "value": value,
                "reason": reason,
                "published": table.value(name, worlds[scene], metric),
            }
        scenes[scene] = {"status": cell["status"], "values": values, **{k: cell.get(k) for k in COSTS}}
    means = {m: {"value": record["mean"][m], "published": table.mean(name, m)} for m in columns}
    costs = {k: mean(c[k] for c in scenes.values()) for k in COSTS}
    return {"method": name, "scenes": scenes, "mean": means, "costs": costs}


def over_seeds(records: Sequence[Record]) -> list[Record]:
    """Return one record for each method: the means over its seeds. A cell that failed with a seed is that seed's."""
    return [_mean_of(seeds) for seeds in seeds_of_methods(records)]


def _mean_of(seeds: Sequence[Record]) -> Record:
    found = {}
    for scene, first in seeds[0]["scenes"].items():
        cells = [r["scenes"][scene] for r in seeds if scene in r["scenes"]]
        metrics = {metric: mean(cell["metrics"][metric] for cell in cells) for metric in first["metrics"]}
        costs = {cost: mean(cell.get(cost) for cell in cells) for cost in COSTS}
        failed = [cell for cell in cells if cell["status"] != "ok"]
        found[scene] = failed[0] if failed else {**first, "metrics": metrics, **costs}
    means = {metric: mean(r["mean"][metric] for r in seeds) for metric in seeds[0]["mean"]}
    return {**seeds[0], "scenes": found, "mean": means}


def ranks(values: Sequence[float | None], metric: Metric) -> list[int | None]:
    """Return ranks: 1 for the best; equal values share the better rank; None has none.

    >>> ranks([20.0, None, 30.0, 20.0], METRICS["psnr"])
    [2, None, 1, 2]
    """
    sign = -1 if metric.higher_is_better else 1
    order = sorted(sign * v for v in values if v is not None)
    return [None if v is None else order.index(sign * v) + 1 for v in values]


def kendall_tau(rows: Sequence[Mapping[str, Any]], metric: str) -> float | None:
    """Return Kendall's tau-b between the measured and the published order of the methods; see `tau_of`."""
    return tau_of((r["mean"][metric]["value"], r["mean"][metric]["published"]) for r in rows)


def tau_of(pairs: Iterable[tuple[float | None, float | None]]) -> float | None:
    """Return Kendall's tau-b of the pairs without None; None for fewer than two, and where all are equal."""
    from scipy.stats import kendalltau

    known = [(a, b) for a, b in pairs if a is not None and b is not None]
    if len(known) < 2:
        return None
    tau = float(kendalltau(*zip(*known, strict=True)).statistic)
    return None if tau != tau else tau
