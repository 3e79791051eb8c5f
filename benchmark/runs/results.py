"""Records of several methods: as a DataFrame, as one CSV file, and those that earlier runs left in a folder."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spike4dgs.benchmark.environment import device_type
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import visible, write_text
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.runs.predictions import open_predictions
from spike4dgs.benchmark.runs.record import COSTS, Record, of_scenes, read_record
from spike4dgs.benchmark.scene.scene import Scene

if TYPE_CHECKING:
    import pandas


def records_to_dataframe(*records: Record | Path | str, per_image: bool = False) -> pandas.DataFrame:
    """Return result records, or the files that hold them, as a DataFrame with one row per method and scene.

    Columns are `method`, `seed`, `scene`, `split`, `status`, the id of every metric, the costs (`fit_seconds`,
    `render_fps`, `peak_memory_mb`, `model_mb`), `budget`, `device` and `error`. A value that does not exist is NaN.
    With `per_image` a row is one scored image: `camera` and `tick` follow `split`, and costs are left out.

    For example::

        records_to_dataframe("runs/small/results/tfp+4dgs.json")[["method", "scene", "psnr"]]

    Raises UserError where pandas is not installed, and for a file that is no result record.
    """
    try:
        import pandas
    except ImportError:
        fix = "pip install 'spike4dgs[pandas]'"
        raise problem("records_to_dataframe", "the package pandas", "none", fix) from None
    loaded = [read_record(Path(r)) if isinstance(r, (str, Path)) else r for r in records]
    rows = [row for record in loaded for row in (_image_rows(record) if per_image else scene_rows(record))]
    numbers = (*METRICS, *(() if per_image else COSTS))
    columns = (*_IMAGE, *METRICS) if per_image else SCENE_COLUMNS
    return pandas.DataFrame(rows, columns=list(columns)).astype(dict.fromkeys(numbers, float))


_SCENE: Sequence[str] = ("method", "seed", "scene", "split", "status")
_IMAGE: Sequence[str] = ("method", "seed", "scene", "split", "camera", "tick")
_CONTEXT: Sequence[str] = ("budget", "device", "error")
SCENE_COLUMNS: Sequence[str] = (*_SCENE, *METRICS, *COSTS, *_CONTEXT)


def _names(record: Record, scene: str) -> dict[str, Any]:
    method = record["method"]
    return {"method": method["name"], "seed": method["seed"], "scene": scene, "split": record["dataset"]["split"]}


def scene_rows(record: Record) -> Iterator[dict[str, Any]]:
    """Yield a row for each scene of a record, a value for each of `SCENE_COLUMNS`."""
    for scene, cell in record["scenes"].items():
        context = {key: cell[key] for key in ("status", *COSTS, *_CONTEXT)}
        yield {**_names(record, scene), **cell["metrics"], **context}


def _image_rows(record: Record) -> Iterator[dict[str, Any]]:
    for scene, cell in record["scenes"].items():
        for name, values in cell["per_image"].items():
            camera, _, tick = name.rpartition("/")
            yield {**_names(record, scene), "camera": camera, "tick": int(tick), **values}


def record_paths(run: Path) -> list[Path]:
    """Return the records of a run, of all seeds."""
    return [*visible(run, "results/*.json"), *visible(run, "seed-*/results/*.json")]


def earlier_records(folder: Path, records: Sequence[Record], scenes: Collection[str]) -> tuple[list[Record], list[str]]:
    """Return the records of other methods in a run's `folder` on the run's `scenes`, by id, oldest first.

    They are of the revisions and split of the run's `records`, of their budget and kind of device, and have no scene
    that these lack. All seeds of a method come together, each once. Also return what is left out, a file name and a
    reason each: other scenes, another budget or device, or no record that this version reads.
    """
    ours = _ways_to_fit(records)
    names, split = {r["method"]["name"] for r in records}, records[0]["dataset"]["split"]
    revisions = {scene: revision for r in records for scene, revision in r["dataset"]["scenes"].items()}
    found, left_out = [], []
    for path in record_paths(folder):
        if path.stem in names:
            continue
        try:
            record = read_record(path)
        except UserError as e:
            left_out.append(str(e))
            continue
        same = [scene for scene, revision in record["dataset"]["scenes"].items() if revision == revisions.get(scene)]
        if record["dataset"]["split"] != split or not set(scenes) <= set(same):
            left_out.append(f"{path}: other scenes, revisions or split")
            continue
        record = of_scenes(record, same)
        if any(a and b and a != b for a, b in zip(ours, _ways_to_fit([record]), strict=True)):
            left_out.append(f"{path}: another budget or device")
            continue
        found.append(record)
    first: dict[str, str] = {}
    for record in found:
        name, created = record["method"]["name"], str(record["created"])
        first[name] = min(created, first.get(name, created))

    def order(record: Record) -> tuple[str, str, int]:
        method = record["method"]
        return first[method["name"]], method["name"], method["seed"] or 0

    return sorted(of_each_seed(found), key=order), left_out


def _ways_to_fit(records: Sequence[Record]) -> tuple[set[str], set[str]]:
    """Return the budgets and the kinds of devices that fitted cells state."""
    cells = [cell for record in records for cell in record["scenes"].values() if cell["status"] == "ok"]
    devices = {device_type(cell["device"]) for cell in cells if cell["device"]}
    return {str(cell["budget"]) for cell in cells if cell["budget"] is not None}, devices


def of_each_seed(records: Sequence[Record]) -> list[Record]:
    """Return the first record of each method and seed, in the order of `record_paths`.

    It is the newest one: the folder of the first seed holds a method's last run, those of further seeds also others'.
    """
    return list({(r["method"]["name"], r["method"]["seed"]): r for r in reversed(records)}.values())[::-1]


def of_one_seed(records: Sequence[Record]) -> list[Record]:
    """Return the first record of each method, for images that show one."""
    return list({r["method"]["name"]: r for r in reversed(records)}.values())[::-1]


def is_shown(record: Record, scene: Scene, folder: Path) -> bool:
    """Return whether a sheet can show a record's cell: a missing one, or one whose images `folder` holds undamaged."""
    cell = record["scenes"][scene.id]
    if cell["status"] != "ok":
        return True
    try:
        found = open_predictions(folder, scene.targets)
        found.verify()
        return found.sha256 == str(cell["predictions_sha256"])
    except UserError:
        return False


def write_results(path: Path, records: Sequence[Record]) -> None:
    """Write a tidy CSV file: a row for each method, seed and scene, a column for each metric and cost.

    Text that a spreadsheet would take for a formula gets an apostrophe: records may be of strangers.
    """
    out = io.StringIO()
    writer = csv.DictWriter(out, SCENE_COLUMNS, lineterminator="\n")
    writer.writeheader()
    rows = (row for record in records for row in scene_rows(record))
    writer.writerows({key: _no_formula(value) for key, value in row.items()} for row in rows)
    write_text(path, out.getvalue())


def _no_formula(value: Any) -> Any:
    return f"'{value}" if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")) else value
