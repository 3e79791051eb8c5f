"""Result records as a pandas DataFrame. pandas is optional: the extra `pandas` installs it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.metrics.table import METRICS
from spike4dgs.benchmark.runs.record import COSTS, Record, read_record

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
