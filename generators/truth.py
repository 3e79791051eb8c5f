"""Ground truth on disk, and `make-dataset --audit`: errors of the radiance that the sensors received, noise of both.

At random ticks, mostly between keys, Mitsuba's own render loop renders some views whole with up to four times the
samples of a key; they are compared with the interpolated radiance of that instant. The reference's noise counts as
error too. Where cameras have a lens or a blur, which that loop does not know, ours traces every pixel.

Noise alone is known from two further renderings A and B with other random numbers: of an image I, the mean of
(I - A)(I - B) is the variance of its noise, without bias and without theirs. A and B are made as ground truth is: what
its procedure changes in the mean is no noise, and is found by A and B of whole paths, whose samples may be few.
"""

from __future__ import annotations

import secrets
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_opening

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.images import gray, read_exr, read_mask, write_exr, write_geometry, write_mask
from spike4dgs.benchmark.scene.scene import Scene, Target
from spike4dgs.generators.profiles import RATE_HZ, TARGET_EVERY, Job
from spike4dgs.generators.render_tasks import (
    Truth,
    cameras_of,
    held_out_view,
    path_of,
    recorded_job,
    renderer_of,
    world_of,
)
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.keyframes import KeyStore, finite
from spike4dgs.generators.rendering.moving_array.renderer import MovingArrayRenderer, along
from spike4dgs.generators.rendering.render import MultiViewRenderer, SoftStatic

WholePaths = MultiViewRenderer | MovingArrayRenderer
_MASK_GROW_PX = 2
_MASK_CHANGE = 0.1  # relative change of radiance that counts as moving light


def mask_file(scene: Path, target: Target) -> Path:
    """Return the path of a target's moving region: the file that `write_truth` writes last."""
    return scene / f"masks/{target.name}.png"


def write_truth(
    scene: Path,
    target: Target,
    truth: Truth,
    background: NDArray[np.float32],
    light_range: Callable[[], tuple[NDArray[np.float32], NDArray[np.float32]]],
    light: float = 1.0,
) -> None:
    """Write image, geometry and mask of one target. `background` [H, W] is the gray background of its camera.

    `light_range` returns the smallest and largest radiance [H, W] of each pixel over the clip, in steady light; `light`
    is the factor of flickering light at this instant.
    """
    t_us = target.tick * 1e6 / RATE_HZ
    write_exr(scene / f"images/{target.name}.exr", truth.rgb * np.float32(light), t_us)
    write_geometry(scene / f"geometry/{target.name}.exr", truth.depth, truth.ids, truth.flow, t_us)
    low, high = light_range()
    varies = high - low > _MASK_CHANGE * high
    write_mask(mask_file(scene, target), moving_region(truth.mask, gray(truth.rgb), background, varies))


def moving_region(
    object_mask: NDArray[np.bool_],
    image: NDArray[np.float32],
    background: NDArray[np.float32],
    varies: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Return the moving region [H, W] of a ground-truth image, over which the `*_dynamic` metrics are computed.

    It has two parts. The first is the moving objects' pixels, grown by 2 px. The second is the pixels whose light the
    objects change by shadow or reflection: their radiance differs from `background` by more than 10 % and also `varies`
    as much over the clip (the shadow of a disc that turns about its axis does not). Specks under 2 px are dropped.
    """
    lit = (np.abs(image - background) > _MASK_CHANGE * background) & varies
    grown = binary_dilation(object_mask, np.ones((3, 3)), iterations=_MASK_GROW_PX)
    return np.asarray(grown | binary_opening(lit, np.ones((2, 2))))


_TICKS, _VIEWS, _PAIRS = 3, 2, 3
_WHOLE = 2  # times at which truth is compared with whole paths
_SEEDS = (3_000_017, 5_000_011)  # added to a scene's seed: far from those of its own files
_SECOND_SEEDS = (1_000_003, 2_000_003)  # the same, of the renderings beside a scored image
_MORE, _MOST = 4, 512  # times the samples of a key, and samples
_FLOOR = 0.02  # relative errors are in units of the true radiance, or of this where it is darker


def audit(job: Job, store: KeyStore, plan: KeyPlan, scene: Path) -> dict[str, Any]:
    """Return the report: errors at random ticks ("ticks"), each and in total, and the `noise`.

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
    some = along(path_of(job))(world_of(job), chosen, seed=job.seed + 2, spp=p.spp, background_spp=p.spp)
    spp = min(_MORE * p.spp, _MOST)
    rendered = _reference(job, some, spp)
    seen = []
    for tick in ticks:
        truth, moving = rendered(tick / RATE_HZ), some.traced(tick / RATE_HZ)
        for view, image, mask in zip(views, truth, moving, strict=True):
            found = errors(store.radiance(view, plan, tick), image, mask)
            seen.append({"tick": tick, "camera": cameras_of(job)[view].id, "is_key": tick in plan.ticks} | found)
    return {
        "samples": {"ticks": spp},
        "ticks": {"total": _total(seen), "each": seen},
        "noise": noise(job, store, plan, scene),
    }


def _reference(job: Job, renderer: WholePaths, spp: int) -> Callable[[float], NDArray[np.float32]]:
    """Return what renders the views of `renderer` whole at a time, with `spp` whole paths a pixel.

    By Mitsuba's own loop for pinholes. It knows neither our lenses nor our blur: there every pixel is traced by ours.
    A world with a flash is loaded anew for each time, with all its lamps as bright as they are then.
    """
    ideal = not any(c.distortion for c in renderer.cameras) and not job.physics.psf_px
    world = renderer.world
    own: dict[str, Any] = {"spp": spp, "background_spp": spp, "psf_px": job.physics.psf_px}

    def loaded(t_s: float) -> WholePaths:
        seed = job.seed + _SEEDS[0]
        make = along(path_of(job))
        return make(world.at_brightness(t_s), renderer.cameras, seed=seed, whole_frames=True, **own)

    if world.flash:
        return lambda t_s: loaded(t_s).reference_frames(t_s, spp) if ideal else loaded(t_s).crn_frames(t_s)
    return (lambda t_s: renderer.reference_frames(t_s, spp)) if ideal else loaded(0.0).crn_frames


def lit_pairs(job: Job) -> list[tuple[int, int]]:
    """Return pairs of targets a millisecond apart at which there is light, by which their truth is divided."""
    lit = [t for t in job.target_ticks if job.light_at(t) > 0]
    first = lit[:: max(1, len(lit) // _PAIRS)][:_PAIRS]
    return [(t, t + TARGET_EVERY) for t in first if t + TARGET_EVERY in lit]


def noise(job: Job, store: KeyStore, plan: KeyPlan, scene: Path) -> dict[str, dict[str, float | None]]:
    """Return the noise of the held-out camera's radiance ("streams") and ground truth ("truth"): PSNR in dB, ceilings.

    Over the whole image ("whole_db"), the moving region ("moving_db") and the moving objects' pixels ("object_db"), at
    pairs of times 1 ms apart; "correlation_moving" is the noise's correlation between them. "truth_against_paths" is
    the same difference to renderings of whole paths, with all that maps of soft light change.
    """
    view = held_out_view(job)
    camera = cameras_of(job)[view]
    pairs = lit_pairs(job)
    ticks = sorted({t for pair in pairs for t in pair})
    own = [second_truth(job, view, job.seed + seed) for seed in _SEEDS]
    objects = renderer_of(job, [camera], truth=True)
    masks = {t: objects.object_masks(t / RATE_HZ)[0] for t in ticks}
    seen = {t: store.radiance(view, plan, t) for t in ticks}
    light = {t: np.float32(job.light_at(t)) for t in ticks}
    truths = {t: read_exr(scene / f"images/{Target(camera.id, t).name}.exr") / light[t] for t in ticks}
    moving = {t: read_mask(mask_file(scene, Target(camera.id, t))) for t in ticks}
    others = {t: [rendered(t / RATE_HZ) for rendered in own] for t in ticks}
    found = {
        "streams": _noise(seen, others, moving, masks) | _correlation(seen, others, moving, pairs),
        "truth": _noise(truths, others, moving, masks) | _correlation(truths, others, moving, pairs),
    }
    if job.profile.soft is not None:
        spp = job.profile.target_spp // 2  # their noise cancels
        paths = [
            MultiViewRenderer(
                world_of(job), [camera], seed=job.seed + s, spp=spp, background_spp=spp, psf_px=job.physics.psf_px
            )
            for s in _SEEDS
        ]
        some = [t for t, _ in pairs[:_WHOLE]]
        whole = {t: [r.crn_frames(t / RATE_HZ)[0] for r in paths] for t in some}
        found["truth_against_paths"] = _noise({t: truths[t] for t in some}, whole, moving, masks)
    return found


Images = Mapping[int, NDArray[np.float32]]  # by tick, [H, W]
Pairs = Mapping[int, Sequence[NDArray[np.float32]]]


def _noise(
    images: Images, others: Pairs, moving: Mapping[int, Any], masks: Mapping[int, Any]
) -> dict[str, float | None]:
    """Return the noise of images in dB, from two further renderings each; None where none is seen."""
    found: dict[str, float | None] = {}
    for name, regions in (("whole", None), ("moving", moving), ("object", masks)):
        squares = []
        for t, image in images.items():
            i, a, b = (np.clip(x.astype(np.float64), 0, 1) for x in (image, *others[t]))
            squares.append(((i - a) * (i - b))[regions[t] if regions else ...].ravel())
        variance = float(np.concatenate(squares).mean()) if sum(map(len, squares)) else 0.0
        found[f"{name}_db"] = round(-10 * float(np.log10(variance)), 3) if variance > 0 else None
    return found


def _correlation(
    images: Images, others: Pairs, moving: Mapping[int, Any], pairs: Sequence[tuple[int, int]]
) -> dict[str, float | None]:
    """Return the correlation of the noise of pairs of images where both move."""
    common = power = 0.0
    for s, t in pairs:
        both = moving[s] & moving[t]
        (sa, sb), (ta, tb) = ([(images[k] - x)[both].astype(np.float64) for x in others[k]] for k in (s, t))
        common += float(np.sum(sa * tb + sb * ta)) / 2  # of renderings with different random numbers
        power += float(np.sum(sa * sb + ta * tb)) / 2
    return {"correlation_moving": round(common / power, 4) if power > 0 else None}


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
    """Return the means over the rows that have a value: where nothing moves there is none of motion."""
    keys = dict.fromkeys(k for r in rows for k, v in r.items() if isinstance(v, float))
    return {k: round(float(np.mean([r[k] for r in rows if k in r])), 5) for k in keys}


def second_renderings(
    scene: Scene, draw: Callable[[Sequence[Target]], Target] = secrets.choice
) -> tuple[Target, NDArray[np.float32], NDArray[np.float32]] | None:
    """Return a target of the simulated held-out camera and two renderings of it, linear radiance [H, W].

    `draw` takes one of the targets at which there is light: nobody knows beforehand which image will be checked. Each
    rendering has the noise of ground truth. None for a scene that no world of this installation made, and for a split
    whose held-out cameras have no such target. Raises UserError where one is not finite.
    """
    job = recorded_job(scene.meta["source"], scene.root)
    if job is None:
        return None
    camera = cameras_of(job)[held_out_view(job)]
    if not (targets := [t for t in scene.targets if t.camera == camera.id and job.light_at(t.tick) > 0]):
        return None
    target, images = draw(targets), []
    print(f"rendering a target of {scene.id} twice more, to know its noise: about half a minute", file=sys.stderr)
    for seed in _SECOND_SEEDS:
        rendered, name = second_truth(job, held_out_view(job), job.seed + seed), f"{scene.id}, {target.name}"
        image = finite(rendered, target.tick / RATE_HZ, name)
        if not np.isfinite(image).all():
            found = f"{np.count_nonzero(~np.isfinite(image))} pixels that are not"
            raise problem(name, "a finite second rendering", found, "submit again")
        images.append(image * np.float32(job.light_at(target.tick)))
    return target, images[0], images[1]


def second_truth(job: Job, view: int, seed: int) -> Callable[[float], NDArray[np.float32]]:
    """Return what renders a view [H, W] at a time in seconds with the noise of ground truth and other random numbers.

    All that is systematic is that of ground truth: where light is split, a background of the rig, and maps that its
    views share. Where paths are whole, views share nothing, and every pixel is traced.
    """
    alike: dict[str, Any] = {"truth": True, "color": False, "seed": seed}
    camera = cameras_of(job)[view : view + 1]
    if job.profile.soft is None:
        whole = renderer_of(job, camera, **alike, whole_frames=True)
        return lambda t_s: whole.crn_frames(t_s)[0]
    every: Any = renderer_of(job, cameras_of(job), **alike)
    soft = SoftStatic(**{name: array[view : view + 1] for name, array in vars(every.soft_static).items()})
    one = renderer_of(job, camera, **alike, soft_static=soft, maps_of=lambda: every)
    return lambda t_s: one.keys(t_s)[0]
