"""`make-dataset --audit`: the error of the radiance that the sensors received, against full renderings.

At random ticks, mostly between keys, Mitsuba's own render loop renders some views whole with four times the samples of
a key; they are compared with the interpolated radiance of that instant. Some ground-truth frames are compared with
renderings of four times their samples. The noise of the reference counts as error too.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.scene.images import read_exr, read_mask
from spike4dgs.benchmark.scene.scene import Target
from spike4dgs.generators.ground_truth import mask_file
from spike4dgs.generators.profiles import RATE_HZ, Job
from spike4dgs.generators.render_tasks import cameras_of, held_out_view, world_of
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.keyframes import KeyStore
from spike4dgs.generators.rendering.render import MultiViewRenderer

_TICKS, _VIEWS, _FRAMES = 4, 3, 3
_MORE = 4  # times the samples of a key or of ground truth
_FLOOR = 0.02  # relative errors are in units of the true radiance, or of this where it is darker


def audit(job: Job, store: KeyStore, plan: KeyPlan, scene: Path) -> dict[str, Any]:
    """Return the report: errors at random ticks ("ticks") and of ground truth ("ground_truth"), each and in total.

    Errors: PSNR (dB, range 1, clipped like the scores), mean and 99.9th percentile of the relative error in percent,
    mean absolute error; over the whole image, and over the pixels with motion or changing light.
    """
    rng = np.random.default_rng([job.seed, 7])
    ticks = sorted(int(t) for t in rng.choice(job.n_ticks, min(_TICKS, job.n_ticks), replace=False))
    held_out, n = held_out_view(job), len(cameras_of(job))
    others = rng.permutation([v for v in range(n) if v != held_out])[: _VIEWS - 1]
    views = sorted([held_out, *(int(v) for v in others)])
    p = job.profile
    chosen = [cameras_of(job)[v] for v in views]
    some = MultiViewRenderer(world_of(job), chosen, seed=job.seed + 2, spp=p.spp, background_spp=p.spp)
    seen = []
    for tick in ticks:
        truth, moving = some.reference_frames(tick / RATE_HZ, _MORE * p.spp), some.traced(tick / RATE_HZ)
        for view, image, mask in zip(views, truth, moving, strict=True):
            found = errors(store.radiance(view, plan, tick), image, mask)
            seen.append({"tick": tick, "camera": cameras_of(job)[view].id, "is_key": tick in plan.ticks} | found)
    camera = cameras_of(job)[held_out]
    one = MultiViewRenderer(world_of(job), [camera], seed=job.seed + 3, spp=p.spp, background_spp=p.spp)
    frames = []
    for tick in job.target_ticks[:: max(1, len(job.target_ticks) // _FRAMES)][:_FRAMES]:
        target = Target(camera.id, tick)
        truth = one.reference_frames(tick / RATE_HZ, _MORE * p.target_spp)[0]
        image, mask = read_exr(scene / f"images/{target.name}.exr"), read_mask(mask_file(scene, target))
        frames.append({"tick": tick, "camera": camera.id} | errors(image, truth, mask))
    return {
        "samples": {"ticks": _MORE * p.spp, "ground_truth": _MORE * p.target_spp},
        "ticks": {"total": _total(seen), "each": seen},
        "ground_truth": {"total": _total(frames), "each": frames},
    }


def errors(image: NDArray[np.float32], truth: NDArray[np.float32], moving: NDArray[np.bool_]) -> dict[str, float]:
    """Return the errors of one image [H, W] against the truth; those named `*_moving` are over `moving` [H, W]."""
    found: dict[str, float] = {}
    for suffix, where in (("", np.ones(moving.shape, bool)), ("_moving", moving)):
        if not where.any():
            continue
        a, b = image[where].astype(np.float64), truth[where].astype(np.float64)
        relative = 100 * np.abs(a - b) / np.maximum(b, _FLOOR)
        square = float(np.mean((np.clip(a, 0, 1) - np.clip(b, 0, 1)) ** 2))
        found |= {
            f"psnr_db{suffix}": float(-10 * np.log10(max(square, 1e-12))),
            f"mean_percent{suffix}": float(relative.mean()),
            f"p999_percent{suffix}": float(np.percentile(relative, 99.9)),
            f"mean_absolute{suffix}": float(np.abs(a - b).mean()),
        }
    return {k: round(v, 5) for k, v in found.items()}


def _total(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Return the means over the rows."""
    keys = [k for k in rows[0] if isinstance(rows[0][k], float)]
    return {k: round(float(np.mean([r[k] for r in rows if k in r])), 5) for k in keys}
