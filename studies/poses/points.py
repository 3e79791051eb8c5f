"""`report dark-points`: how far points are off in less and less light, at true poses.

Arrays of eight cameras see worlds at rest, as for `report dark-poses`. The first camera's depth is found twice, over
the same planes, on the same spikes: by a cost volume of the matching network's features, and by the plane sweep on
`adaptive`'s images that first points of fits come from. Errors are relative to a point's distance; a pixel of
parallax between the outermost cameras is stated beside them, as many of the arrays are narrow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import spearmanr
from tyro.conf import Positional

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.files import write_text
from spike4dgs.benchmark.scene.training_bursts import BurstFile
from spike4dgs.method.matching.adjust import Array
from spike4dgs.method.matching.network import FINE
from spike4dgs.method.matching.weights import WEIGHTS, load_matcher
from spike4dgs.method.matching.window_inputs import light_of
from spike4dgs.method.starts.plane_sweep import full_range, inverse_depth_step, sweep
from spike4dgs.studies.kit.timing import markdown, show_table
from spike4dgs.studies.poses.cost_volume import cell_depths
from spike4dgs.studies.poses.dark import EXPOSURE, LIGHTS, Sight, named, resting_arrays, see, with_progress, write_rows

TICKS = (101, 401)  # 5 and 20 ms

Depths = tuple[Float32, Float32]  # inverse depth [H, W] of the first camera's pixels, and how sure it is


def dark_points(
    data: Positional[Path] = Path("data/matching"),
    *,
    bursts: int = 1,
    seed: int = 0,
    out: Path = Path("runs/dark-points"),
) -> int:
    """Find the depth of arrays' first views at three lights from clips of two lengths: OUT/points.md and .json.

    Args:
        data: Folder of shards of `make-msdi-data` with arrays at rest; those of the hidden variants are taken.
        bursts: Arrays of each shard.
        seed: Seed of the sensors' noise.
        out: Folder for the results.
    """
    rows = [row for file, number in with_progress(resting_arrays(data, bursts)) for row in measured(file, number, seed)]
    write_rows(out / "points.json", rows, seed)
    table = [_line(rows, light, ticks) for light in LIGHTS for ticks in TICKS]
    scores = ("error", "surer half", "rank")
    columns = ("light", "clip, ms", *(f"{name}: {what}" for name in FINDERS for what in scores))
    write_text(out / "points.md", "\n".join([*markdown(columns, table), ""]))
    parallax = np.array([row["pixel"] for row in rows])
    ends = f"{parallax.min():.0%} to {parallax.max():.0%}"
    show_table(f"Medians over arrays; a pixel of parallax is {ends} of the distance", columns, table, None)
    print(f"written: {out}/points.md, .json")
    return 0


def measured(file: BurstFile, number: int, seed: int) -> list[dict[str, Any]]:
    """Return the errors of an array's first view in each condition, by each finder."""
    burst, rows = file.read(number), []
    true = burst.depth[0].astype(np.float64)
    for k, light in enumerate(LIGHTS):
        for ticks in TICKS:
            rng = np.random.default_rng([seed, number, k, ticks, *file.facts.id.encode()])
            sight = see(burst, file, light, ticks, rng)
            pixel = inverse_depth_step(sight.cameras) * float(np.median(true[np.isfinite(true)]))
            facts = {"world": file.facts.id, "array": number, "light": light, "ticks": ticks, "pixel": round(pixel, 4)}
            for name, find in FINDERS.items():
                rows.append({**facts, "points": name, **errors_of(find(sight), true)})
    return rows


def errors_of(found: Depths, true: Float64) -> dict[str, float]:
    """Return the median error in distances, that of the surer half, and the rank correlation of sureness and error."""
    inverse, sure = found
    seen = np.isfinite(true)
    error = np.abs(1 / np.maximum(inverse[seen].astype(np.float64), 1e-9) / true[seen] - 1)
    half = error[sure[seen] >= np.median(sure[seen])]
    values = {"error": np.median(error), "surer": np.median(half), "rank": spearmanr(sure[seen], -error).statistic}
    return {name: round(float(value), 4) for name, value in values.items()}


@torch.inference_mode()
def _network(sight: Sight) -> Depths:
    network = load_matcher(WEIGHTS.in_use().path, "cpu")
    fine = torch.cat([network.extractor(torch.from_numpy(view[None])).fine for view in sight.inputs])
    R, centers, K = (np.stack([getattr(c, name) for c in sight.cameras]) for name in ("R", "center", "K"))
    rows, columns = sight.inputs.shape[2:]
    cells = cell_depths(fine, (rows, columns), Array(R, centers, K), 0, full_range(sight.cameras))
    cell = np.ones((FINE, FINE), np.float32)
    inverse, sure = (np.kron(x, cell)[:rows, :columns] for x in (cells.inverse, cells.confidence))
    return inverse, sure


def _sweep(sight: Sight) -> Depths:
    found = sweep(sight.cameras, light_of(sight.inputs[:, 0]) * np.float32(EXPOSURE), 0, full_range(sight.cameras))
    return found.inverse, found.score


FINDERS = {"network's cost volume": _network, "plane sweep": _sweep}


def _line(rows: Sequence[Mapping[str, Any]], light: float, ticks: int) -> list[str]:
    line = [named(light), f"{ticks // 20}"]
    for name in FINDERS:
        mine = [r for r in rows if (r["light"], r["ticks"], r["points"]) == (light, ticks, name)]
        error, surer, rank = (float(np.median([r[key] for r in mine])) for key in ("error", "surer", "rank"))
        line += [f"{error:.1%}", f"{surer:.1%}", f"{rank:.2f}"]
    return line
