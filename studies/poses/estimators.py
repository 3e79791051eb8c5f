"""`poses`: estimate the training cameras' poses of scenes, and measure them against the calibrated ones."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from tyro.conf import Positional

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.baselines.starts.dust3r import estimate as estimate_dust3r
from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.files import check_file, write_json
from spike4dgs.benchmark.metrics.pose_error import pose_errors
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.scene import TrainingScene, open_scenes
from spike4dgs.method.msdi.pose import solve_poses
from spike4dgs.method.starts.clip import window_means
from spike4dgs.method.starts.matching import match_and_solve, refined_poses
from spike4dgs.method.starts.msdi import DEFAULTS, infer
from spike4dgs.method.starts.rig import rig
from spike4dgs.method.starts.structure_from_motion import FOCAL_PRIOR, clip_means, map_views
from spike4dgs.method.training_views.pinholes import as_pinholes, undistorted
from spike4dgs.studies.kit.timing import show_table

Row = dict[str, float | int | str | None]
CLIP = "clip"  # means of the whole clip, as they are
FLAT = "flat"  # the same, corrected by the cameras' calibrations


class Posed(NamedTuple):
    """Cameras with poses, and the points [N, 3] in metres that came with them."""

    cameras: Sequence[Camera]
    points: Any


def _msdi(scene: TrainingScene, images: Float32, seed: int, calibrated: bool) -> Posed:
    """Return the poses by the network alone: each view's from its own points, by PnP."""
    found, cameras = infer(scene, calibrated=calibrated), []
    known = np.stack([c.K for c in found.cameras]) if calibrated else None
    for camera, pose in zip(scene.cameras, solve_poses(found.points, found.confidence, known, seed), strict=True):
        if pose.w2c is None:
            fix = "use rig or colmap"
            raise problem(f"MSDI on {scene.id}", f"a pose for {camera.id}", f"none ({pose.reason})", fix)
        fx, fy = (camera.fx, camera.fy) if pose.focal_px is None else (pose.focal_px * found.factor,) * 2
        cameras.append(replace(camera, R=pose.w2c[:3, :3], t=pose.w2c[:3, 3], fx=fx, fy=fy))
    return Posed(cameras, found.points[found.sure(DEFAULTS)])


def _matched(scene: TrainingScene, images: Float32, seed: int, calibrated: bool) -> Any:
    if not calibrated:
        raise problem("matched", "known intrinsics", "--unknown-intrinsics", "leave one of them out")
    return refined_poses(scene, seed)


ESTIMATORS: dict[str, Callable[[TrainingScene, Float32, int, bool], Any]] = {  # of what has `cameras` and `points`
    "rig": lambda scene, images, seed, known: rig(scene),
    "colmap": lambda scene, images, seed, known: map_views(
        scene.cameras, images, seed, focal_prior=None if known else FOCAL_PRIOR
    ),
    "dust3r": lambda scene, images, seed, known: estimate_dust3r(scene, images, seed, calibrated=known),
    "msdi": _msdi,
    "matching": lambda scene, images, seed, known: match_and_solve(scene, seed, calibrated=known),
    "matched": _matched,
}
COLUMNS = {  # key of the row -> heading, format
    "registered": ("views", "{}"),
    "points": ("points", "{}"),
    "rotation_deg": ("rotation deg", "{:.3f}"),
    "rotation_max_deg": ("max", "{:.3f}"),
    "translation_m": ("translation m", "{:.4f}"),
    "translation_of_array": ("of array", "{:.1%}"),
    "rra_5": ("RRA@5", "{:.2f}"),
    "rta_5": ("RTA@5", "{:.2f}"),
    "rta_15": ("RTA@15", "{:.2f}"),
    "maa_30": ("mAA30", "{:.3f}"),
    "focal_ratio": ("focal / true", "{:.3f}"),
    "seconds": ("s", "{:.1f}"),
}


def poses(
    scenes: Positional[tuple[Path, ...]],
    *,
    initialization: tuple[str, ...] = ("colmap",),
    images: str = CLIP,
    unknown_intrinsics: bool = False,
    seed: int = 0,
    split: str | None = None,
    out: Path | None = None,
    allow_gaps: bool = False,
) -> int:
    """Estimate the training cameras of scenes and print a table of pose errors.

    Errors are those after the similarity that fits the estimated cameras to the calibrated ones; RRA and RTA are
    shares of camera pairs. `rig` takes the calibrated poses: its errors are zero, and its points are counted.

    Args:
        scenes: Scene folders.
        initialization: What estimates: rig, colmap, dust3r, msdi (its network alone), matching (the matching network),
            matched (its poses, refined by features).
        images: What colmap and dust3r see: clip (means of the whole clip), flat (those, corrected by the cameras'
            calibrations, as in recipes with flat_field), or images of the clip's middle, such as tfp.
        unknown_intrinsics: Estimate one focal length too, instead of keeping the calibrated intrinsics.
        seed: Seed of everything random.
        split: Split whose training cameras are taken; each scene's default one if left out.
        out: Write the rows to this JSON file.
        allow_gaps: Accept recordings with gaps.
    """
    if unknown := [name for name in initialization if name not in ESTIMATORS]:
        expected = f"names among {', '.join(ESTIMATORS)}"
        raise problem("--initialization", expected, ", ".join(unknown), "correct the names")
    if images not in (CLIP, FLAT, *IMAGES):
        raise problem("--images", f"one of {', '.join((CLIP, FLAT, *IMAGES))}", repr(images), "correct the name")
    opened, rows = open_scenes(scenes, allow_gaps, split), []
    if out:
        check_file(out)
    for scene in (as_pinholes(one.training) for one in opened):
        made = _images(scene, images)
        for name in initialization:
            rows.append(measure_poses(scene, made, name, seed, calibrated=not unknown_intrinsics))
    shown = [[str(row["scene"]), str(row["initialization"]), *_texts(row)] for row in rows]
    headings = ("scene", "poses", *(heading for heading, _ in COLUMNS.values()))
    show_table("", headings, shown, None, [str(row.get("error", "")) for row in rows])
    if out:
        settings = {"images": images, "unknown_intrinsics": unknown_intrinsics, "seed": seed}
        write_json(out, {"settings": settings, "rows": rows})
    return 1 if any("error" in row for row in rows) else 0


def _images(scene: TrainingScene, images: str) -> Float32:
    """Return one image of each training view [C, H, W], linear radiance."""
    if images == CLIP:
        return clip_means(scene)
    if images == FLAT:
        return window_means(scene, 0, scene.n_ticks, flat_field=True)
    made = [IMAGES[images](s, [scene.n_ticks // 2], scene.radiance_gain) for s in scene.streams]
    return undistorted(scene, np.concatenate(made))


def measure_poses(scene: TrainingScene, images: Float32, name: str, seed: int, *, calibrated: bool) -> Row:
    """Return a row of the table: errors (None where fewer than two views have poses) and seconds.

    An estimator's refusal is the row's `error`.
    """
    row: Row = {"scene": scene.id, "initialization": name, **dict.fromkeys(COLUMNS)}
    start = time.perf_counter()
    try:
        found = ESTIMATORS[name](scene, images, seed, calibrated)
    except UserError as e:
        return {**row, "registered": f"0 of {len(scene.cameras)}", "error": str(e)}
    row |= {"registered": f"{len(found.cameras)} of {len(scene.cameras)}", "points": len(found.points)}
    row["seconds"] = time.perf_counter() - start
    if len(found.cameras) < 2:
        return {**row, "error": "fewer than two views have poses"}
    true = {camera.id: camera for camera in scene.cameras}
    partners = [true[camera.id] for camera in found.cameras]
    ratios = [a.fx / b.fx for a, b in zip(found.cameras, partners, strict=True)]
    try:
        errors = pose_errors(found.cameras, partners).summary()
    except UserError as e:  # all at one place: nothing aligns them
        return {**row, "error": str(e)}
    return {**row, **errors, "focal_ratio": float(np.mean(ratios))}


def _texts(row: Row) -> list[str]:
    return ["-" if row[key] is None else text.format(row[key]) for key, (_, text) in COLUMNS.items()]
