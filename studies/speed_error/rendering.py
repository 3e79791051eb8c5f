"""The renderer's savings: adaptive key frames and samples, and light that is not traced again.

The keys around a few random ticks are rendered with different settings. The radiance that the sensor would receive at
these ticks is compared with full renderings of four times the profile's samples. The time is the mean time of the keys
of each spacing, times their number in a clip of the profile's length.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.scene.images import gray
from spike4dgs.generators.profiles import PROFILES, RATE_HZ, SPLIT_PROFILES, Job, SplitSampling
from spike4dgs.generators.render_tasks import (
    RenderKeys,
    StaticParts,
    cameras_of,
    held_out_view,
    plan_of,
    render_static,
    world_of,
)
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.keyframes import KeyStore
from spike4dgs.generators.rendering.render import MultiViewRenderer
from spike4dgs.generators.truth import errors
from spike4dgs.studies.kit.measurement import TIMES, Column, Point, Request, Role, Series, measurement
from spike4dgs.studies.kit.timing import by_turns_ms
from spike4dgs.studies.speed_error.keys import GROUP, OF_SIZE

MORE = 4  # times the profile's samples, for the truth
ERRORS = {  # of `audit`, means over the ticks, at the held-out camera
    "mean_percent": "mean error, %",
    "p999_percent": "99.9th percentile, %",
    "mean_percent_moving": "mean error where it moves, %",
    "p999_percent_moving": "99.9th percentile there, %",
    "psnr_db": "PSNR, dB",
    "psnr_db_moving": "PSNR where it moves, dB",
}


def _job(request: Request, world: str) -> Job:
    name = request.pick("tiny", "tiny", "small")
    profile = replace(PROFILES[name], views=(4,))
    return Job(world, 0, request.seed, name, profile, profile.seconds)


@measurement(
    "rendering",
    GROUP,
    "Rendering: adaptive keys and samples",
    (Column("minutes", "time of a clip's keys, min"), *(Column(*e) for e in ERRORS.items())),
    ("mean_percent", "mean_percent_moving"),
    least="quick",  # Mitsuba alone takes longer than the whole size tiny
)
def savings(request: Request) -> Iterator[Series]:
    """Only what changes is traced, as often as its motion asks, with the profile's samples per pixel.

    Mitsuba's own loop: every pixel at every tick, 4 times the samples. Its own noise counts as error.

    Where nothing moves the background has more samples than any key. At moving pixels the noise of the samples counts:
    four times as many halve it, for up to four times the time.

    tests/generators/test_truth.py
    """
    for world in OF_SIZE[request.size]:
        yield saved(_job(request, world))


def settings(job: Job) -> dict[str, Job]:
    """Return the settings that are compared, the profile's own first."""
    p = job.profile
    jobs = {
        f"as shipped: {p.spp} samples, {p.max_key_px:g} px": job,
        f"keys 2x sparser: {2 * p.max_key_px:g} px": replace(job, profile=replace(p, max_key_px=2 * p.max_key_px)),
        f"keys 4x sparser: {4 * p.max_key_px:g} px": replace(job, profile=replace(p, max_key_px=4 * p.max_key_px)),
        "every tick": replace(job, adaptive=False),
        "whole frames": replace(job, whole_frames=True),
    }
    for factor in (0.25, 0.5, 4):
        spp = int(factor * p.spp)
        samples = replace(p, spp=spp, background_spp=max(p.background_spp, spp))
        jobs[f"{spp} samples"] = replace(job, profile=samples)
    return jobs


def saved(job: Job) -> Series:
    """Return the time and the errors of each setting for one job; the exact point's time is estimated."""
    p = job.profile
    ticks = sorted(int(t) for t in np.random.default_rng(job.seed).choice(job.n_ticks, 3, replace=False))
    truth_at(job, ticks[:1])  # compilation is not part of a frame's time, nor is the loading of the world
    times = []
    for some in (ticks[:1], ticks):
        start = time.perf_counter()
        truth, moving = truth_at(job, some)
        times.append(time.perf_counter() - start)
    minutes = (times[1] - times[0]) / (len(ticks) - 1) * job.n_ticks / 60 * len(p.views)
    none = {name: 0.0 if "percent" in name else None for name in ERRORS}
    points = [Point(f"every tick whole, {MORE * p.spp} samples", {"minutes": minutes, **none}, "exact")]
    static: dict[int, StaticParts] = {}
    for name, changed in settings(job).items():
        spp = changed.profile.spp
        if spp not in static:
            with tempfile.TemporaryDirectory() as folder:
                static[spp] = render_static(changed, Path(folder))
        values = measure(changed, static[spp], ticks, truth, moving)
        points.append(Point(name, values, "chosen" if changed is job else ""))
    name = f"{job.world}, {p.width}x{p.height}, {job.seconds * 1e3:g} ms, {len(p.views)} view{'s' * (len(p.views) > 1)}"
    return Series(name, tuple(points))


def needed(plan: KeyPlan, ticks: Sequence[int]) -> list[int]:
    """Return the keys from which `KeyStore.radiance` computes the radiance at these ticks.

    They include at least one of every spacing, so that its time can be measured.
    """
    chain, last = plan.chain, plan.ticks[-1]
    seen: set[int] = set()

    def read(tick: int) -> None:
        if tick in seen or not 0 <= tick <= last:
            return
        seen.add(tick)
        finest = tick % chain[-1] == 0
        if finest and plan.level(tick) == 0:
            return
        spacing = chain[plan.level(tick) - 1] if finest else chain[-1]
        for k in range(-1, 3):
            read((tick // spacing + k) * spacing)

    for tick in ticks:
        read(tick)
    keys = {t for t in seen if t % chain[-1] == 0}
    for level in set(range(len(chain))) - {plan.level(t) for t in keys}:
        keys.add(next(t for t in plan.ticks if plan.level(t) == level))
    return sorted(keys)


def truth_at(job: Job, ticks: Sequence[int]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return full renderings [n, H, W] of the held-out view at some ticks, and the pixels that move there."""
    view = held_out_view(job)
    camera, p = cameras_of(job)[view : view + 1], job.profile
    renderer = MultiViewRenderer(world_of(job), camera, seed=job.seed + 2, spp=p.spp, background_spp=p.spp)
    images = [renderer.reference_frames(t / RATE_HZ, MORE * p.spp)[0] for t in ticks]
    return np.stack(images), np.stack([renderer.traced(t / RATE_HZ)[0] for t in ticks])


def measure(
    job: Job, static: StaticParts, ticks: Sequence[int], truth: NDArray[np.float32], moving: NDArray[np.bool_]
) -> dict[str, float]:
    """Return the minutes of a setting's keys for all views and the clip, and its errors at ticks of known truth."""
    plan, task = plan_of(job), RenderKeys(job, static.views)
    seconds: dict[int, list[float]] = {level: [] for level in range(len(plan.chain))}
    with tempfile.TemporaryDirectory() as folder:
        store = KeyStore(Path(folder))
        store.set_static(static.views)
        task(plan.ticks[:1])  # compilation is not part of a key's time
        for tick in needed(plan, ticks):
            start = time.perf_counter()
            ((_, arrays),) = task([tick])
            seconds[plan.level(tick)].append(time.perf_counter() - start)
            store.put(tick, arrays)
        seen = [store.radiance(held_out_view(job), plan, tick) for tick in ticks]
    found = [errors(a, b, m) for a, b, m in zip(seen, truth, moving, strict=True)]
    total = sum(float(np.mean(s)) * sum(plan.level(t) == k for t in plan.ticks) for k, s in seconds.items() if s)
    return {"minutes": total / 60, **{name: float(np.mean([e[name] for e in found])) for name in ERRORS}}


@measurement(
    "soft-light",
    GROUP,
    "Rendering: bounced light as a ratio",
    (
        *TIMES,
        Column("all", "error of the mean light outside of traced pixels, %"),
        Column("soft", "error of the mean light where only light changes, %"),
        Column("traced", "pixels traced, %"),
    ),
    ("all", "soft"),
    least="quick",
)
def soft_light(request: Request) -> Iterator[Series]:
    """Outside of the traced pixels, light that moving objects add is a smooth ratio on the background.

    Every pixel traced at that time, with the same random numbers; the background's known noise is taken off.

    Bounced light varies slowly over the image and in time; a ratio keeps the background's low noise.

    tests/studies/speed_error/test_rendering.py
    """
    for world in OF_SIZE[request.size]:
        job = _job(request, world)
        p, t_s = job.profile, 0.5 * job.seconds
        view = held_out_view(job)
        renderer = MultiViewRenderer(
            world_of(job), cameras_of(job)[view : view + 1], seed=job.seed, spp=p.spp, background_spp=p.background_spp
        )
        traced = renderer.traced(t_s)
        soft = renderer.changed(t_s) & ~traced  # where only the light changes
        calls = [partial(renderer.crn_frames, t_s), partial(renderer.keys, t_s)]
        times = by_turns_ms(calls, request.pick(1, 3, 5))
        noise = gray(renderer.static.first) - renderer.background  # of the samples, where nothing but light changes
        exact, keys = calls[0]() - noise, calls[1]()
        without: Any = np.where(traced, renderer.keys(t_s), renderer.background)
        points = []
        for name, image, (best, median), role in (
            ("every pixel traced", exact, times[0], "exact"),
            ("light as a ratio", keys, times[1], "chosen"),
            ("background unchanged", without, (None, None), ""),
        ):
            off = image - exact  # pixel by pixel what is left of the samples' noise would hide it
            values = {"ms": best, "median_ms": median, "traced": 100 * float(traced.mean())}
            for key, where in (("all", ~traced), ("soft", soft)):
                values[key] = float(100 * abs(off[where].mean()) / exact[where].mean()) if where.any() else None
            points.append(Point(name, values, role))  # type: ignore[arg-type]
        yield Series(f"{world}, {p.width}x{p.height}, {soft.mean():.0%} of the pixels softly lit", tuple(points))


@measurement(
    "split-light",
    GROUP,
    "Rendering: direct light and maps of soft light",
    (
        *TIMES,
        Column("noise", "noise where it moves, dB"),
        Column("object", "noise on moving objects, dB"),
        Column("paths", "difference to whole paths where it moves, dB"),
    ),
    ("noise", "object"),
    least="quick",
)
def split_light(request: Request) -> Iterator[Series]:
    """Direct light is traced; light that comes over more surfaces or from the sky is looked up in a smoothed map.

    Whole paths with 16 times the samples.

    Nearly all the noise of a path is soft light, and that is smooth on every surface once it is divided by the albedo.
    The time is that of a whole image with the most samples in every pixel, and with the maps around it at hand.

    tests/studies/speed_error/test_rendering.py
    """
    for world in OF_SIZE[request.size]:
        yield split_series(_job(request, world), request.pick(1, 3, 5))


def split_series(job: Job, repeats: int) -> Series:
    """Return the time and the noise of each way to render an image of a job's held-out view."""
    from spike4dgs.generators.rendering.split_render import SplitRenderer

    t_s, view, world = (job.n_ticks // 2 + 0.25) / RATE_HZ, held_out_view(job), world_of(job)
    camera, split = cameras_of(job)[view : view + 1], SPLIT_PROFILES[job.profile_name]
    ways: dict[str, tuple[int, SplitSampling | None, Role]] = {
        f"paths, {job.profile.spp} samples": (job.profile.spp, None, ""),
        f"paths, {16 * job.profile.spp} samples": (16 * job.profile.spp, None, "exact"),
        f"maps, {split.spp} samples": (split.spp, split.soft, "chosen"),
        f"maps, {split.target_spp} samples": (split.target_spp, split.target_soft, ""),
    }

    def image(spp: int, soft: SplitSampling | None, seed: int) -> Callable[[], NDArray[np.float32]]:
        make = MultiViewRenderer if soft is None else partial(SplitRenderer, soft=soft)
        renderer = make(world, camera, seed=job.seed + seed, spp=spp, background_spp=spp)
        return lambda: renderer.crn_frames(t_s)[0]

    calls = [[image(spp, soft, seed) for seed in (2, 3)] for spp, soft, _ in ways.values()]
    times = by_turns_ms([pair[0] for pair in calls], repeats)
    images = [[call() for call in pair] for pair in calls]
    geometry = MultiViewRenderer(world, camera, seed=0, spp=1, background_spp=1)
    moving, on_object = geometry.traced(t_s)[0], geometry.object_masks(t_s)[0]
    points = []
    for (name, (_, _, role)), (a, b), (best, median) in zip(ways.items(), images, times, strict=True):
        values: dict[str, float | None] = {"ms": best, "median_ms": median}
        values |= {key: _decibels((a - b)[m] ** 2 / 2) for key, m in (("noise", moving), ("object", on_object))}
        off = (a - images[1][0]) * (b - images[1][1])  # the noise of all four is independent
        points.append(Point(name, {**values, "paths": None if role == "exact" else _decibels(off[moving])}, role))
    return Series(f"{job.world}, {job.profile.width}x{job.profile.height}, {moving.mean():.0%} moving", tuple(points))


def _decibels(squares: NDArray[Any]) -> float | None:
    mean = float(np.mean(squares, dtype=np.float64))
    return -10 * float(np.log10(mean)) if mean > 0 else None
