"""`report dark-points`: how far points are off in less and less light, at true poses.

Arrays of eight cameras see worlds at rest, as for `report dark-poses`. The first camera's depth is found twice, over
the same planes, on the same spikes: by a cost volume of the matching network's features, and by the plane sweep on
`adaptive`'s images that first points of fits come from. Errors are relative to a point's distance; a pixel of
parallax between the outermost cameras is stated beside them, as many of the arrays are narrow.

With `--scenes` it is the depth of scenes' first training view in the middle of the clip, which is found a third time:
by the mean of the two scores of each plane.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.stats import spearmanr
from tyro.conf import Positional

from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.files import write_text
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import read_geometry
from spike4dgs.benchmark.scene.scene import Scene, open_scenes
from spike4dgs.benchmark.scene.training_bursts import BurstFile
from spike4dgs.method.matching.adjust import Array
from spike4dgs.method.matching.network import FINE
from spike4dgs.method.matching.weights import WEIGHTS, load_matcher
from spike4dgs.method.matching.window_inputs import light_of
from spike4dgs.method.starts.matching import seen_inputs
from spike4dgs.method.starts.plane_sweep import full_range, inverse_depth_step, sweep
from spike4dgs.method.training_views.pinholes import as_pinholes, nearest_pixels, seen_pixels
from spike4dgs.studies.kit.timing import markdown, show_table
from spike4dgs.studies.poses.cost_volume import best_depths, cell_scores
from spike4dgs.studies.poses.dark import EXPOSURE, LIGHTS, named, resting_arrays, see, with_progress, write_rows

TICKS = (101, 401)  # 5 and 20 ms

Depths = tuple[Float32, Float32]  # inverse depth [H, W] of the first camera's pixels, and how sure it is


def dark_points(
    data: Positional[Path] = Path("data/matching"),
    *,
    scenes: tuple[Path, ...] = (),
    bursts: int = 1,
    seed: int = 0,
    out: Path = Path("runs/dark-points"),
) -> int:
    """Find the depth of arrays' first views at three lights from clips of two lengths: OUT/points.md and .json.

    With scenes, find the depth of their first training views instead: OUT/scenes.md and .json.

    Args:
        data: Folder of shards of `make-msdi-data` with arrays at rest; those of the hidden variants are taken.
        scenes: Scene folders with depth maps, in the place of DATA.
        bursts: Arrays of each shard.
        seed: Seed of the sensors' noise.
        out: Folder for the results.
    """
    if scenes:
        return _of_scenes(open_scenes(scenes), seed, out)
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
                rows.append({**facts, "points": name, **errors_of(find(sight.cameras, sight.inputs), true)})
    return rows


def _of_scenes(scenes: Sequence[Scene], seed: int, out: Path) -> int:
    rows = [row for scene in scenes for row in of_scene(scene)]
    write_rows(out / "scenes.json", rows, seed)
    columns = ("scene", *(f"{name}: {what}" for name in SCENE_FINDERS for what in ("error", "px", "rank")))
    table = []
    for first in range(0, len(rows), len(SCENE_FINDERS)):
        mine = rows[first : first + len(SCENE_FINDERS)]
        cells = [text for r in mine for text in (f"{r['error']:.1%}", f"{r['px']:.1f}", f"{r['rank']:.1f}")]
        table.append([rows[first]["scene"], *cells])
    write_text(out / "scenes.md", "\n".join([*markdown(columns, table), ""]))
    show_table("px: of parallax between the outermost cameras", columns, table, None)
    print(f"written: {out}/scenes.md, .json")
    return 0


def of_scene(scene: Scene) -> list[dict[str, Any]]:
    """Return the errors of a scene's first training view in the middle of the clip, by each finder.

    Raises UserError where the scene has no depth map of it.
    """
    training = as_pinholes(scene.training)
    path = scene.manifest.path(f"geometry/{scene.train[0]}/{scene.n_ticks // 2:06d}.exr")
    depths = [read_geometry(path).depth] * len(training.cameras)  # only the first is of its view
    true = nearest_pixels(training, depths)[0].astype(np.float64)
    if seen := seen_pixels(training):
        true[~seen[0]] = np.inf
    inputs, pixel, rows = seen_inputs(training), inverse_depth_step(training.cameras), []
    for name, find in SCENE_FINDERS.items():
        found = find(training.cameras, inputs)
        off = np.abs(found[0] - 1 / true)[np.isfinite(true)] / pixel
        px = round(float(np.median(off)), 3)
        rows.append({"scene": scene.id, "points": name, **errors_of(found, true), "px": px})
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
def _cell_scores(cameras: Sequence[Camera], inputs: Float32) -> Float32:
    network = load_matcher(WEIGHTS.in_use().path, "cpu")
    fine = torch.cat([network.extractor(torch.from_numpy(view[None])).fine for view in inputs])
    R, centers, K = (np.stack([getattr(c, name) for c in cameras]) for name in ("R", "center", "K"))
    return cell_scores(fine, inputs.shape[2:], Array(R, centers, K), 0, full_range(cameras))


def _network(cameras: Sequence[Camera], inputs: Float32) -> Depths:
    cells = best_depths(_cell_scores(cameras, inputs), full_range(cameras))
    rows, columns = inputs.shape[2:]
    cell = np.ones((FINE, FINE), np.float32)
    inverse, sure = (np.kron(x, cell)[:rows, :columns] for x in (cells.inverse, cells.confidence))
    return inverse, sure


def _sweep(cameras: Sequence[Camera], inputs: Float32) -> Depths:
    found = sweep(cameras, light_of(inputs[:, 0]) * np.float32(EXPOSURE), 0, full_range(cameras))
    return found.inverse, found.score


def _both(cameras: Sequence[Camera], inputs: Float32) -> Depths:
    planes, scores = full_range(cameras), _cell_scores(cameras, inputs)
    images, (rows, columns) = light_of(inputs[:, 0]) * np.float32(EXPOSURE), inputs.shape[2:]
    size, means = (FINE * scores.shape[2], FINE * scores.shape[1]), []
    for plane, cells in zip(planes, np.where(np.isfinite(scores), scores, 0), strict=True):
        of_pixels = cv2.resize(cells, size, interpolation=cv2.INTER_LINEAR)[:rows, :columns]
        alone = sweep(cameras, images, 0, np.repeat(plane, 3)).score  # of one plane: a sweep returns the best one's
        means.append((of_pixels + alone) / 2)
    found = best_depths(np.stack(means), planes)
    return found.inverse, found.confidence


FINDERS: Mapping[str, Callable[[Sequence[Camera], Float32], Depths]] = {
    "network's cost volume": _network,
    "plane sweep": _sweep,
}
SCENE_FINDERS = {**FINDERS, "both": _both}


def _line(rows: Sequence[Mapping[str, Any]], light: float, ticks: int) -> list[str]:
    line = [named(light), f"{ticks // 20}"]
    for name in FINDERS:
        mine = [r for r in rows if (r["light"], r["ticks"], r["points"]) == (light, ticks, name)]
        error, surer, rank = (float(np.median([r[key] for r in mine])) for key in ("error", "surer", "rank"))
        line += [f"{error:.1%}", f"{surer:.1%}", f"{rank:.2f}"]
    return line
