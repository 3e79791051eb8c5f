"""The renderer's savings: key frames with interpolation between them, samples, and light that is not traced again."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console

from spike4dgs.benchmark.scene.images import gray
from spike4dgs.generators.profiles import PROFILES, RATE_HZ, Job
from spike4dgs.generators.render_tasks import RenderStatic, StaticParts, cameras_of, held_out_view, world_of
from spike4dgs.generators.rendering.render import MultiViewRenderer
from spike4dgs.generators.worlds import WORLDS
from spike4dgs.studies.spacing import compare, render_every_tick
from spike4dgs.studies.speed.timing import by_turns_ms
from spike4dgs.studies.speed_error.measurement import (
    MEDIAN_MS,
    MS,
    Column,
    Measurement,
    Point,
    Request,
    Series,
)
from spike4dgs.studies.tradeoff import MORE, measure, settings, truth_at

GROUP = "Sensor and rendering"
_WORLDS = {"quick": ("car",), "whole": ("car", "turntable", "bricks")}


def _job(request: Request, world: str) -> Job:
    name = request.pick("tiny", "tiny", "small")
    profile = replace(PROFILES[name], views=(4,))
    return Job(world, 0, request.seed, name, profile, profile.seconds)


def _spacing(request: Request) -> Iterator[Series]:
    width, height, spp, ticks = request.pick(None, (64, 40, 16, 64), (200, 125, 64, 256))
    for world in _WORLDS[request.size]:
        built = WORLDS[world].build(request.seed, 0, ticks / RATE_HZ)
        console = Console(quiet=True)
        frames, speed, seconds = render_every_tick(built, (width, height), ticks, spp, request.seed, console)
        rows = [
            r for r in compare(frames, speed, seconds, [2**k for k in range(1, 7)], request.seed) if r.spacing_ticks
        ]
        zero = dict.fromkeys(("tick", "worst", "integral", "counts"), 0.0)
        every = Point("every tick", {"render": RATE_HZ / 1000 * seconds, "px": speed / RATE_HZ, **zero}, "exact")
        limit = max((r.spacing_ticks for r in rows if r.motion_px <= PROFILES["small"].max_key_px), default=0)
        for name in ("Catmull-Rom", "linear"):
            points = [every]
            for r in (r for r in rows if r.interpolation == name):
                values = {
                    "render": r.render_s_per_ms,
                    "px": r.motion_px,
                    "tick": r.tick_error_mean,
                    "worst": r.tick_error_p999,
                    "integral": r.integral_error_mean,
                    "counts": r.counts_off,
                }
                chosen: Any = "chosen" if name == "Catmull-Rom" and r.spacing_ticks == limit else ""
                points.append(Point(f"{r.spacing_ticks} ticks", values, chosen))
            yield Series(f"{world}, {name}", tuple(points))


def _savings(request: Request) -> Iterator[Series]:
    for world in _WORLDS[request.size]:
        job = _job(request, world)
        p = job.profile
        ticks = sorted(int(t) for t in np.random.default_rng(request.seed).choice(job.n_ticks, 3, replace=False))
        truth_at(job, ticks[:1])  # compilation is not part of a frame's time, nor is the loading of the world
        times = []
        for some in (ticks[:1], ticks):
            start = time.perf_counter()
            truth, moving = truth_at(job, some)
            times.append(time.perf_counter() - start)
        minutes = (times[1] - times[0]) / (len(ticks) - 1) * job.n_ticks / 60
        zero = dict.fromkeys(("mean", "worst", "moving"), 0.0)
        points = [Point(f"every tick whole, {MORE * p.spp} samples", {"minutes": minutes, **zero}, "exact")]
        jobs = {name.partition(":")[0]: changed for name, changed in settings(job).items()}
        for factor in (0.25, 4):
            samples = replace(p, spp=int(factor * p.spp), background_spp=max(p.background_spp, int(factor * p.spp)))
            jobs[f"{samples.spp} samples"] = replace(job, profile=samples)
        static: dict[int, StaticParts] = {}
        for name, changed in jobs.items():
            spp = changed.profile.spp
            if spp not in static:
                static[spp] = RenderStatic(changed)(None)
            row = measure(name, changed, static[spp], ticks, truth, moving)
            errors = {"mean": row.mean_percent, "worst": row.p999_percent, "moving": row.mean_percent_moving}
            role: Any = "chosen" if changed is job else ""
            points.append(Point(name, {"minutes": row.keys_minutes, **errors}, role))
        yield Series(f"{world}, {p.width}x{p.height}, {job.seconds * 1e3:g} ms, one view", tuple(points))


def _soft_light(request: Request) -> Iterator[Series]:
    for world in _WORLDS[request.size]:
        job = _job(request, world)
        p, t_s = job.profile, 0.5 * job.seconds
        view = held_out_view(job)
        renderer = MultiViewRenderer(
            world_of(job), cameras_of(job)[view : view + 1], seed=job.seed, spp=p.spp, background_spp=p.background_spp
        )
        traced, changed = renderer.traced(t_s), renderer.changed(t_s)
        soft = changed & ~traced  # where only the light changes

        def without(renderer: MultiViewRenderer = renderer, t_s: float = t_s, traced: Any = traced) -> Any:
            return np.where(traced, renderer.keys(t_s), renderer.background)

        calls = [partial(renderer.crn_frames, t_s), partial(renderer.keys, t_s)]
        times = by_turns_ms(calls, request.pick(1, 3, 5))
        exact, keys = (call() for call in calls)
        noise = gray(renderer.static.first) - renderer.background  # of the samples, where nothing but light changes
        points = []
        for name, image, time_ms, role in (
            ("every pixel traced", exact - noise, times[0], "exact"),
            ("light as a ratio", keys, times[1], "chosen"),
            ("background unchanged", without(), (None, None), ""),
        ):
            off = image - (exact - noise)  # pixel by pixel what is left of the samples' noise would hide it
            values = {"ms": time_ms[0], "median_ms": time_ms[1], "traced": 100 * float(traced.mean())}
            for key, where in (("all", ~traced), ("soft", soft)):
                values[key] = float(100 * abs(off[where].mean()) / exact[where].mean()) if where.any() else None
            points.append(Point(name, values, role))  # type: ignore[arg-type]
        yield Series(f"{world}, {p.width}x{p.height}, {soft.mean():.0%} of the pixels softly lit", tuple(points))


SPACING = Measurement(
    id="keys",
    group=GROUP,
    title="Key frames: spacing and interpolation",
    approximation="Radiance is rendered at keys; the simulator follows a clamped Catmull-Rom curve between them.",
    exact="A key at every tick.",
    reason="The widest spacing at which the fastest point moves half a pixel at most: `make-dataset` chooses it for "
    "each pixel (a quarter in the profile `paper`). Wider keys lose edges; closer ones render what hardly changes.",
    columns=(
        Column("render", "render time, s per ms of clip and view"),
        Column("px", "motion between keys, px"),
        Column("tick", "mean error at moving pixels, %"),
        Column("worst", "99.9th percentile of it, %"),
        Column("integral", "error of the light over 32 ticks, %"),
        Column("counts", "32-tick counts that are off, %"),
    ),
    x="render",
    y=("tick", "counts"),
    run=_spacing,
    seconds={"quick": 40, "whole": 900},
    sizes=("quick", "whole"),  # Mitsuba alone takes longer than the whole size tiny
    held_by="tests/generators/test_reports.py",
)
SAVINGS = Measurement(
    id="rendering",
    group=GROUP,
    title="Rendering: adaptive keys and samples",
    approximation="Only what changes is traced, as often as its motion asks, with the profile's samples per pixel.",
    exact=f"Mitsuba's own loop: every pixel at every tick, {MORE} times the samples. Its own noise counts as error.",
    reason="Where nothing moves the background has more samples than any key. At moving pixels the noise of the "
    "samples counts: four times as many halve it, for up to four times the time.",
    columns=(
        Column("minutes", "time of a clip's keys, min"),
        Column("mean", "mean error, %"),
        Column("worst", "99.9th percentile, %"),
        Column("moving", "mean error where it moves, %"),
    ),
    x="minutes",
    y=("mean", "moving"),
    run=_savings,
    seconds={"quick": 60, "whole": 1500},
    sizes=("quick", "whole"),  # Mitsuba alone takes longer than the whole size tiny
    held_by="tests/generators/test_audit.py",
)
SOFT_LIGHT = Measurement(
    id="soft-light",
    group=GROUP,
    title="Rendering: bounced light as a ratio",
    approximation="Outside of the traced pixels, light that moving objects add is a smooth ratio on the background.",
    exact="Every pixel traced at that time, with the same random numbers; the background's known noise is taken off.",
    reason="Bounced light varies slowly over the image and in time; a ratio keeps the background's low noise.",
    columns=(
        MS,
        MEDIAN_MS,
        Column("all", "error of the mean light outside of traced pixels, %"),
        Column("soft", "error of the mean light where only light changes, %"),
        Column("traced", "pixels traced, %"),
    ),
    x="ms",
    y=("all", "soft"),
    run=_soft_light,
    seconds={"quick": 20, "whole": 200},
    sizes=("quick", "whole"),  # Mitsuba alone takes longer than the whole size tiny
    held_by="tests/generators/rendering",
)
