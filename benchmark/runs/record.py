"""The result record, format `spike4dgs-result/1`: one method on all scenes of a dataset.

The JSON Schema states the form of a record; `check_record` also checks its numbers: means are the means of their parts,
and a scene without a value makes the mean null, never smaller.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.environment import command_line, environment, harness, utc_now
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import read_json, write_json
from spike4dgs.benchmark.metrics.measure import Values, mean, scene_means
from spike4dgs.benchmark.metrics.table import MAIN, METRICS
from spike4dgs.benchmark.runs.predictions import MethodInfo
from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.benchmark.screen.shown import Shown
from spike4dgs.benchmark.untrusted import matches

IDEAL, PARTLY, NOISY, RECORDED = "ideal", "partly noisy", "noisy", "recorded"
SENSORS = (IDEAL, PARTLY, NOISY, RECORDED)  # as in result.schema.json
TERMS = ("gain_map", "dark_map", "photons_per_spike")  # of the simulated noise; false or null where it is off


def sensor_of(meta: Mapping[str, Any]) -> str | None:
    """Return the sensor that scene.json states: one of `SENSORS`, or None where it does not say.

    A simulated one is noisy with all `TERMS`, ideal without any, and partly noisy between.

    >>> sensor_of({"sensor": {"gain_map": True, "dark_map": True, "photons_per_spike": None}, "source": {"kind": "x"}})
    'partly noisy'
    """
    if meta["source"]["kind"] == "recorder":
        return RECORDED
    if not all(term in meta["sensor"] for term in TERMS):
        return None
    on = sum(bool(meta["sensor"][term]) for term in TERMS)
    return IDEAL if not on else NOISY if on == len(TERMS) else PARTLY


SCHEMA = "spike4dgs-result/1"
PROTOCOL: dict[str, Any] = {"name": "held-out-views", "version": 1}  # raise the version when a score would change
Record = dict[str, Any]
Cell = dict[str, Any]


class ShownRecord(Shown, Record):
    """A record that shows its scenes and scores, not every value."""

    _kind = "Record"
    __repr__ = Shown.__repr__

    def _about(self) -> str:
        method, scenes = self["method"], self["scenes"]
        failed = sum(cell["status"] != "ok" for cell in scenes.values())
        values = [f"{m} {METRICS[m].format(self['mean'][m])}" for m in MAIN if self["mean"].get(m) is not None]
        number = f"{len(scenes)} scene{'s' * (len(scenes) > 1)}" + (f", {failed} without scores" if failed else "")
        seed = "" if method["seed"] is None else f", seed {method['seed']}"
        return f"{method['name']}{seed}: {', '.join([number, *values])}"

    def _repr_html_(self) -> str:
        metrics = [m for m in MAIN if any(cell["metrics"].get(m) is not None for cell in self["scenes"].values())]
        rows = {scene: cell["metrics"] for scene, cell in self["scenes"].items()}
        if len(rows) > 1:
            rows["mean"] = self["mean"]
        head = "".join(f"<th>{escape(METRICS[m].title)}</th>" for m in metrics)
        body = "".join(
            f"<tr><th>{escape(name)}</th>"
            + "".join(f"<td>{METRICS[m].format(row.get(m))}</td>" for m in metrics)
            + "</tr>"
            for name, row in rows.items()
        )
        return f"{super()._repr_html_()}<table><tr><th></th>{head}</tr>{body}</table>"


COSTS = {  # of a cell -> title, digits shown to people
    "fit_seconds": ("fit, s", 1),
    "render_fps": ("images/s", 1),
    "peak_memory_mb": ("memory, MB", 0),
    "model_mb": ("model, MB", 1),
}
_AGAIN = "score the predictions again"


def missing_cell(status: str, error: str) -> Cell:
    """Return a cell without values: `status` is failed or skipped, `error` is the reason in one line."""
    nothing = ("gain_aligned", "predictions_sha256", *COSTS, "budget", "device")
    return {
        "status": status,
        "metrics": dict.fromkeys(METRICS),
        "computed": {},
        "notes": {},
        "per_image": {},
        **dict.fromkeys(nothing),
        "fitted_with": {"harness": None, "environment": None},
        "error": " ".join(error.split()) or "no reason given",
    }


def check_scenes(scenes: Sequence[Scene]) -> None:
    """Raise UserError unless scenes can be of one record: each given once, all with one split."""
    if len({s.id for s in scenes}) < len(scenes):
        raise problem("scenes", "distinct scenes", ", ".join(s.id for s in scenes), "give each scene once")
    if len(splits := {s.split for s in scenes}) > 1:
        raise problem("scenes", "one split", ", ".join(sorted(splits)), "score scenes of one dataset together")


def build_record(method: MethodInfo, scenes: Sequence[Scene], cells: Mapping[str, Cell], device: str) -> Record:
    """Put the cells (by scene id) of a method together. `device` is where this process computes."""
    check_scenes(scenes)
    record = {
        "schema": SCHEMA,
        "method": method.as_dict(),
        "dataset": {
            "name": "+".join(sorted(s.id for s in scenes)),
            "scenes": {s.id: s.revision for s in scenes},
            "split": scenes[0].split,
        },
        "sensors": {s.id: sensor for s in scenes if (sensor := sensor_of(s.meta))},
        "protocol": PROTOCOL,
        "scenes": dict(cells),
        "mean": dataset_means(cells),
        "environment": environment(device),
        "harness": harness(),
        "command": command_line(),
        "created": utc_now(),
    }
    check_record(record, f"the record of {method.name}")
    return ShownRecord(record)


def with_earlier_scenes(record: Record, path: Path, is_same_fit: Callable[[str, str], bool]) -> Record:
    """Return a record with the cells of further scenes that the record at `path` has of the same method and split.

    `is_same_fit(scene, revision)` tells whether the scores of a scene are those of a fit like the record's: scores of
    other code or another kind of device are left out. A record of another version, seed, budget or other parameters,
    one with another protocol, and a file that is none are without effect.
    """
    try:
        earlier = read_record(path)
    except UserError:
        return record
    same = all(earlier[key] == record[key] for key in ("method", "protocol"))
    same = same and earlier["harness"]["version"] == record["harness"]["version"]
    budgets = {cell["budget"] for r in (earlier, record) for cell in r["scenes"].values() if cell["status"] == "ok"}
    same = same and len(budgets) <= 1
    revisions = earlier["dataset"]["scenes"]
    added = {
        scene: cell
        for scene, cell in earlier["scenes"].items()
        if scene not in record["scenes"] and (cell["status"] != "ok" or is_same_fit(scene, revisions[scene]))
    }
    if not same or not added or earlier["dataset"]["split"] != record["dataset"]["split"]:
        return record
    return _with_cells(record, {**added, **record["scenes"]}, earlier)


def of_scenes(record: Record, scenes: Collection[str]) -> Record:
    """Return a record of some of its scenes."""
    return _with_cells(record, {scene: cell for scene, cell in record["scenes"].items() if scene in scenes}, record)


def _with_cells(record: Record, cells: Mapping[str, Cell], other: Record) -> Record:
    """Return a record with other cells, whose scenes are of `record` or else of `other`."""
    revisions = {**other["dataset"]["scenes"], **record["dataset"]["scenes"]}
    sensors = {**other.get("sensors", {}), **record.get("sensors", {})}
    dataset = {
        **record["dataset"],
        "name": "+".join(sorted(cells)),
        "scenes": {scene: revisions[scene] for scene in cells},
    }
    return {
        **record,
        "dataset": dataset,
        "sensors": {scene: sensors[scene] for scene in cells if scene in sensors},
        "scenes": dict(cells),
        "mean": dataset_means(cells),
    }


def dataset_means(cells: Mapping[str, Cell]) -> Values:
    """Return the mean over scenes of each metric; None where any scene has no value."""
    return {metric: mean(cell["metrics"].get(metric) for cell in cells.values()) for metric in METRICS}


def is_complete(record: Record) -> bool:
    """Return whether every scene was scored. Only complete records are ranked."""
    return all(cell["status"] == "ok" for cell in record["scenes"].values())


def check_record(record: Record, where: str | Path) -> None:
    """Raise UserError unless the record follows the schema and its numbers agree with each other."""
    check_form(record, where)
    check_agreement(record, where)


def check_agreement(record: Record, where: str | Path) -> None:
    """Raise UserError unless the numbers of a record that follows the schema agree with each other."""
    if record["protocol"] != PROTOCOL:
        raise problem(where, f"protocol {PROTOCOL}", str(record["protocol"]), _AGAIN)
    if set(record["scenes"]) != set(record["dataset"]["scenes"]):
        found = ", ".join(sorted(record["scenes"]))
        raise problem(where, f"cells for {', '.join(sorted(record['dataset']['scenes']))}", found, _AGAIN)
    if unknown := sorted(record.get("sensors", {}).keys() - record["scenes"].keys()):
        raise problem(where, "sensors of its scenes", ", ".join(unknown)[:200], _AGAIN)
    if unknown := sorted(record["dataset"].get("equivalent", {}).keys() - record["scenes"].keys()):
        raise problem(where, "equivalents of its scenes", ", ".join(unknown)[:200], _AGAIN)
    for scene, cell in record["scenes"].items():
        for name, values in (("metrics", cell["metrics"]), *cell["per_image"].items()):
            _check_metric_names(values, f"{where}, scene {scene}, {name}")
        if cell["status"] == "ok":
            _check_computed(cell, f"{where}, scene {scene}")
            _check_means(cell["metrics"], scene_means(cell["per_image"]), f"{where}, scene {scene}")
    _check_metric_names(record["mean"], f"{where}, mean")
    _check_means(record["mean"], dataset_means(record["scenes"]), f"{where}, mean")


def check_form(record: Record, where: str | Path) -> None:
    """Raise UserError unless the record follows the schema."""
    if record.get("schema") != SCHEMA:
        raise problem(where, f"schema '{SCHEMA}'", repr(record.get("schema")), "check that it is a result record")
    check_schema(record, load_schema("spike4dgs.benchmark", "result.schema.json"), where, _AGAIN)


def check_method_name(name: str) -> None:
    """Raise UserError unless a method's name can be part of file names."""
    if not matches("method", name):
        raise problem("method", "a name of letters, digits and + . _ -", repr(name), "rename the method")


def with_later_metrics(record: Record) -> Record:
    """Return a record that follows the schema with the metrics that it is too old to have: they are null."""
    later = [m.id for m in METRICS.values() if m.added_later]

    def complete(values: Values) -> Values:
        return {**values, **{m: None for m in later if m not in values}}

    def complete_cell(cell: Cell) -> Cell:
        older = {m: "not computed: the record is older than the metric" for m in later if m not in cell["metrics"]}
        per_image = {name: complete(values) for name, values in cell["per_image"].items()}
        notes = {**cell["notes"], **older} if cell["status"] == "ok" else cell["notes"]
        return {**cell, "metrics": complete(cell["metrics"]), "notes": notes, "per_image": per_image}

    cells = {scene: complete_cell(cell) for scene, cell in record["scenes"].items()}
    return {**record, "scenes": cells, "mean": complete(record["mean"])}


def _check_metric_names(values: Values, where: str) -> None:
    if set(values) != set(METRICS):
        found = ", ".join(sorted(set(values) ^ set(METRICS)))[:200]
        raise problem(where, "exactly the metrics of the table", f"unknown or missing: {found}", _AGAIN)


def _check_computed(cell: Cell, where: str) -> None:
    """Raise UserError for values of metrics that were not computed, and for metrics without value or note."""
    if unknown := sorted(cell["computed"].keys() - METRICS.keys()):
        raise problem(where, "computed metrics of the table", ", ".join(unknown)[:200], _AGAIN)
    for metric, sha256 in cell["computed"].items():
        weights = METRICS[metric].weights
        if (weights is None) != (sha256 is None) or (weights and weights.sha256 not in (None, sha256)):
            expected = f"{metric} by {weights.description if weights else 'no weights'}"
            raise problem(where, expected, f"weights with sha256 {sha256}", _AGAIN)
    for name, values in cell["per_image"].items():
        for metric, value in values.items():
            if value is not None and metric not in cell["computed"]:
                raise problem(f"{where}, {name}", f"no {metric}, which was not computed", str(value), _AGAIN)
    for metric, value in cell["metrics"].items():
        if value is None and metric not in cell["notes"]:
            raise problem(where, f"a note that says why {metric} is null", "none", _AGAIN)


def _check_means(found: Values, expected: Values, where: str) -> None:
    for metric, value in expected.items():
        if not same_value(found[metric], value, 1e-9):
            raise problem(where, f"{metric} = {value}, the mean of its parts", str(found[metric]), _AGAIN)


def same_value(a: float | None, b: float | None, tolerance: float) -> bool:
    """Return whether two values are both None, or numbers within `tolerance` of each other."""
    return a == b if a is None or b is None else abs(a - b) <= tolerance


def read_record(path: Path | str) -> Record:
    """Read and check a result record. Raises UserError where it is missing, damaged or inconsistent."""
    record = read_json(Path(path), f"a {SCHEMA} record")
    check_form(record, path)
    record = with_later_metrics(record)  # which keeps the form
    check_agreement(record, path)
    return ShownRecord(record)


def write_record(path: Path, record: Record) -> None:
    """Check a record and write it atomically."""
    check_record(record, path)
    write_json(path, record)
