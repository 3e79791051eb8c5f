"""`report dark-poses`: which poses are found in less and less light, from clips of several lengths.

Arrays of eight cameras see worlds at rest: bursts of the variants that no network was trained on. At each light and
length every estimator gets the same spikes and the cameras' calibrations. The matching network and SIFT's features in
the same images of `adaptive` go through the same geometry; COLMAP sees images of `adaptive`, of the means of all ticks
(TFP) and of one interval (TFI), of equal exposure. A pair of cameras counts where both have poses: the angle between
its rotations, and between its directions.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tyro.conf import Positional

from spike4dgs.baselines.images.tfi import tfi_image
from spike4dgs.benchmark.arrays import Float32, Float64
from spike4dgs.benchmark.environment import command_line, cpu_name, harness
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import read_json, write_json, write_text
from spike4dgs.benchmark.metrics.pose_error import pose_errors
from spike4dgs.benchmark.reports.figure import new_figure, save_figure
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.training_bursts import Burst, BurstFile, open_folder
from spike4dgs.method.matching.matches import learned_matches
from spike4dgs.method.matching.poses import solve
from spike4dgs.method.matching.tracks import Matches
from spike4dgs.method.matching.training.data import at_light, record, seen_by_network
from spike4dgs.method.matching.weights import WEIGHTS, load_matcher
from spike4dgs.method.matching.window_inputs import light_of
from spike4dgs.method.starts.structure_from_motion import map_views
from spike4dgs.studies.kit.checkout import code_now
from spike4dgs.studies.kit.timing import markdown, show_table, write_csv
from spike4dgs.studies.poses.sift import sift_matches

LIGHTS = (1.0, 1 / 4, 1 / 16)
TICKS = (41, 101, 401)  # 2, 5 and 20 ms
VIEWS = 8
ROTATION_DEG, DIRECTION_DEG = 1.0, 5.0  # a pair's bars
EXPOSURE = 0.25  # mean radiance of the images that COLMAP and the plane sweep see
_NONE = 180.0  # degrees, of pairs without poses


@dataclass(frozen=True, eq=False)
class Sight:
    """An array's view of a world in one condition: what every estimator gets."""

    cameras: tuple[Camera, ...]
    inputs: Float32  # [V, 4, H, W] of the matching network; the first channel is `adaptive`'s image
    means: Float32  # [V, H, W] spikes per tick over the clip, corrected
    intervals: Float32  # [V, H, W] of the interval in the middle, corrected


def dark_poses(
    data: Positional[Path] = Path("data/matching"),
    *,
    bursts: int = 2,
    seed: int = 0,
    out: Path = Path("runs/dark-poses"),
) -> int:
    """Estimate arrays' poses at three lights from clips of three lengths: OUT/poses.md, .csv, .json and .png.

    OUT/arrays/ has the rows of each array, so a killed run resumes.

    Args:
        data: Folder of shards of `make-msdi-data --resting 16`; those of the hidden variants are taken.
        bursts: Arrays of each shard.
        seed: Seed of the sensors' noise and of the estimators.
        out: Folder for the results.
    """
    rows: list[dict[str, Any]] = []
    for file, number in with_progress(resting_arrays(data, bursts)):
        rows += _kept(file, number, seed, out / "arrays")
    write_rows(out / "poses.json", rows, seed)
    _write(rows, out)
    return 0


def resting_arrays(data: Path, count: int) -> list[tuple[BurstFile, int]]:
    """Return `count` arrays at rest of each shard of hidden variants. Raises UserError for a folder without any."""
    if count < 1:
        raise problem("--bursts", "1 or more", str(count), "correct it")
    files = [f for f in open_folder(data) if f.facts.hidden and f.facts.resting and f.facts.views > VIEWS]
    if not files:
        fix = "make them with `spike4dgs make-msdi-data --resting 16`"
        raise problem(data, f"shards of hidden variants with arrays of more than {VIEWS} views at rest", "none", fix)
    return [(file, number) for file in files for number in _resting(file, count)]


def with_progress(arrays: Sequence[tuple[BurstFile, int]]) -> Iterator[tuple[BurstFile, int]]:
    """Yield arrays, and print after each how many are done and how long the others will take."""
    start = time.perf_counter()
    for done, (file, number) in enumerate(arrays, start=1):
        yield file, number
        passed = time.perf_counter() - start
        left = passed / done * (len(arrays) - done)
        print(f"{file.facts.id}: {done}/{len(arrays)} arrays, {passed:.0f} s, about {left:.0f} s left", flush=True)


def write_rows(path: Path, rows: Sequence[Mapping[str, Any]], seed: int) -> None:
    """Write what was measured, and with what."""
    about = {"commit": harness()["commit"], "cpu": cpu_name(), "command": command_line(), "seed": seed}
    write_json(path, {**about, "weights": WEIGHTS.in_use().sha256, "rows": rows})


def _resting(file: BurstFile, count: int) -> Sequence[int]:
    """Return numbers of the arrays that see the world at rest, evenly chosen."""
    f = file.facts
    chosen = np.unique(np.linspace(0, f.resting - 1, min(count, f.resting)).round().astype(int))
    return [f.rigs * f.instants + int(k) for k in chosen]


def _kept(file: BurstFile, number: int, seed: int, folder: Path) -> list[dict[str, Any]]:
    """Return an array's rows: those in `folder` where the same code, weights and conditions made them."""
    path = folder / f"{file.facts.id}-{number}.json"
    by = {"code": code_now(), "shard": file.sha256, "weights": WEIGHTS.in_use().sha256, "seed": seed}
    by |= {"lights": list(LIGHTS), "ticks": list(TICKS)}
    if path.is_file() and (found := read_json(path, "the poses of an array")).get("by") == by:
        return list(found["rows"])
    rows = _measured(file, number, seed)
    write_json(path, {"by": by, "rows": rows})
    return rows


def _measured(file: BurstFile, number: int, seed: int) -> list[dict[str, Any]]:
    burst, rows = file.read(number), []
    for k, light in enumerate(LIGHTS):
        for ticks in TICKS:
            rng = np.random.default_rng([seed, number, k, ticks, *file.facts.id.encode()])
            sight = see(burst, file, light, ticks, rng)
            for name, estimate in ESTIMATORS.items():
                begin = time.perf_counter()
                rotation, direction = errors_of(estimate(sight, seed), sight.cameras)
                rows.append(
                    {
                        "world": file.facts.id,
                        "array": number,
                        "light": light,
                        "ticks": ticks,
                        "poses": name,
                        "rotation_deg": np.round(rotation, 4).tolist(),
                        "direction_deg": np.round(direction, 3).tolist(),
                        "seconds": round(time.perf_counter() - begin, 2),
                    }
                )
    return rows


def see(burst: Burst, file: BurstFile, light: float, ticks: int, rng: np.random.Generator) -> Sight:
    """Return what the first eight cameras of a burst record at a fraction of its light."""
    under = at_light(light, True, ticks)
    streams = record(burst, file.facts.radiance_gain, file.facts.photons_per_spike, under, rng)[:VIEWS]
    made = (
        np.stack([s.counts(0, ticks).astype(np.float32) / np.float32(ticks) for s in streams]),
        np.stack([tfi_image(s, under.instant) for s in streams]),
    )
    gain, dark = burst.gain[:VIEWS], burst.dark[:VIEWS]
    means, intervals = (np.asarray(np.maximum(image - dark, 0) / np.maximum(gain, 1e-3), np.float32) for image in made)
    size = file.facts.width, file.facts.height
    cameras = tuple(
        Camera(f"cam_{v:02d}", *size, K[0, 0], K[1, 1], K[0, 2], K[1, 2], w2c[:3, :3], w2c[:3, 3])
        for v, (K, w2c) in enumerate(zip(burst.K[:VIEWS], burst.w2c[:VIEWS], strict=True))
    )
    return Sight(cameras, seen_by_network(burst, streams, under), means, intervals)


def _network(sight: Sight, seed: int) -> tuple[Camera, ...]:
    return _solved(learned_matches(load_matcher(WEIGHTS.in_use().path, "cpu"), sight.inputs), sight, seed)


def _sift(sight: Sight, seed: int) -> tuple[Camera, ...]:
    return _solved(sift_matches(sight.inputs[:, 0]), sight, seed)


def _solved(matches: Matches, sight: Sight, seed: int) -> tuple[Camera, ...]:
    found = solve(matches, np.stack([c.K for c in sight.cameras]), seed)
    if found is None:
        return ()
    return tuple(replace(c, R=w2c[:3, :3], t=w2c[:3, 3]) for c, w2c in zip(sight.cameras, found.w2c, strict=True))


def _colmap(images: Callable[[Sight], Float32]) -> Callable[[Sight, int], tuple[Camera, ...]]:
    def estimate(sight: Sight, seed: int) -> tuple[Camera, ...]:
        rates = images(sight)
        exposed = rates * np.float32(EXPOSURE / max(float(rates.mean()), 1e-6))
        return map_views(sight.cameras, exposed.astype(np.float32), seed).cameras

    return estimate


ESTIMATORS: Mapping[str, Callable[[Sight, int], tuple[Camera, ...]]] = {
    "matching network": _network,
    "SIFT, same geometry": _sift,
    "COLMAP on adaptive": _colmap(lambda sight: light_of(sight.inputs[:, 0])),
    "COLMAP on TFP": _colmap(lambda sight: sight.means),
    "COLMAP on TFI": _colmap(lambda sight: sight.intervals),
}


def errors_of(found: Sequence[Camera], true: Sequence[Camera]) -> tuple[Float64, Float64]:
    """Return the errors in degrees of the rotations and directions of all pairs [P] of `true`; 180 without poses.

    Cameras at one place, as some estimators have them where they see nothing, are no poses.
    """
    number = {camera.id: k for k, camera in enumerate(true)}
    i, j = np.triu_indices(len(true), 1)
    pair = np.zeros((len(true), len(true)), int)
    pair[i, j] = np.arange(len(i))
    rotation, direction = np.full(len(i), _NONE), np.full(len(i), _NONE)
    if len(found) >= 2:
        mine = sorted(found, key=lambda camera: number[camera.id])
        places = np.array([number[camera.id] for camera in mine])
        try:
            errors = pose_errors(mine, [true[k] for k in places])
        except UserError:  # all at one place
            return rotation, direction
        a, b = (places[k] for k in np.triu_indices(len(mine), 1))
        rotation[pair[a, b]], direction[pair[a, b]] = errors.pair_rotation_deg, errors.pair_direction_deg
    return rotation, direction


def _shares(rows: Sequence[Mapping[str, Any]], light: float, ticks: int, name: str) -> tuple[float, float]:
    """Return the shares of pairs within both bars, in percent."""
    mine = [r for r in rows if (r["light"], r["ticks"], r["poses"]) == (light, ticks, name)]
    found = []
    for key, bar in (("rotation_deg", ROTATION_DEG), ("direction_deg", DIRECTION_DEG)):
        found.append(100 * float(np.mean(np.concatenate([np.array(r[key]) for r in mine]) < bar)))
    return found[0], found[1]


def named(light: float) -> str:
    """Return a light as a fraction."""
    return f"1/{1 / light:.0f}" if light < 1 else "1"


def _write(rows: Sequence[Mapping[str, Any]], out: Path) -> None:
    """Write the shares of pairs within 1 and 5 degrees as a table and a plot."""
    columns = ("light", "clip, ms", *ESTIMATORS)
    table = []
    for light in LIGHTS:
        for ticks in TICKS:
            cells = [" / ".join(f"{share:.0f} %" for share in _shares(rows, light, ticks, name)) for name in ESTIMATORS]
            table.append([named(light), f"{ticks // 20}", *cells])
    write_csv(out / "poses.csv", columns, table)
    write_text(out / "poses.md", "\n".join([*markdown(columns, table), ""]))
    show_table("", columns, table, None)
    figure = new_figure((9, 3.2))
    panels = figure.subplots(1, len(TICKS), sharey=True, squeeze=False)[0]
    for axes, ticks in zip(panels, TICKS, strict=True):
        for name in ESTIMATORS:
            axes.plot(LIGHTS, [_shares(rows, light, ticks, name)[1] for light in LIGHTS], "o-", label=name)
        axes.set(xscale="log", title=f"{ticks // 20} ms", xlabel="light")
        axes.set_xticks(LIGHTS, [named(light) for light in LIGHTS])
        axes.minorticks_off()
    panels[0].set_ylabel(f"directions within {DIRECTION_DEG:.0f} degrees, %")
    panels[0].legend(fontsize=7)
    save_figure(figure, out / "poses.png")
    print(f"written: {out}/poses.md, .csv, .json, .png")
