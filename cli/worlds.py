"""`worlds`: one table of all worlds: speed, share of moving pixels, depth, key spacing, time to make."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from tyro.conf import Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import check_file, read_json, write_text
from spike4dgs.generators.make_dataset import SceneSettings
from spike4dgs.generators.profiles import RATE_HZ, Job
from spike4dgs.generators.render_tasks import cameras_of, held_out_view, plan_of, world_of
from spike4dgs.generators.rendering.image_motion import max_image_speed
from spike4dgs.generators.rendering.render import MultiViewRenderer
from spike4dgs.generators.worlds import WORLDS
from spike4dgs.studies.kit.timing import markdown, show_table

COLUMNS = (
    "world",
    "speed, m/s",
    "length, m",
    "fastest point, px/ms",
    "moving pixels, %",
    "depth, m",
    "key spacing, ticks",
    "made in, s",
)
_TIMES = 5


def worlds(
    names: Positional[tuple[str, ...]] = (),
    *,
    profile: str = "small",
    variant: int = 0,
    seed: int = 0,
    reports: Path | None = None,
    out: Path = Path("runs/worlds.md"),
) -> int:
    """Describe worlds in one table, and write it as Markdown.

    Speeds are exact, from the geometry. Moving pixels and depths come from rays of the held-out camera at five times.

    Args:
        names: Names of worlds; all if left out.
        profile: Size and length of the clips: tiny, small or paper.
        variant: Variant of the worlds.
        seed: Seed of the worlds.
        reports: Folder of scenes made with this profile, for the last column (WORLD-VARIANT-PROFILE.report.json).
        out: Markdown file.
    """
    check_file(out)
    jobs = [SceneSettings(profile, seed, variant).job(name) for name in names or WORLDS]
    if reports is not None and not reports.is_dir():
        raise problem("--reports", "a folder with reports of scenes", str(reports), "correct the path")
    rows = [_row(job, reports) for job in jobs]
    note = f"Ticks are {1e6 / RATE_HZ:g} us. Key spacings: of whole keys, then of those for faster parts.\n"
    write_text(out, "\n".join([*markdown(COLUMNS, rows), "", note]))
    show_table("", COLUMNS, rows, None)
    print(f"written: {out}")
    return 0


def _row(job: Job, reports: Path | None) -> list[str]:
    world, views, view = world_of(job), cameras_of(job), held_out_view(job)
    renderer = MultiViewRenderer(world, views[view : view + 1], seed=job.seed, spp=1, background_spp=1)
    depths, moving = [], []
    for t in np.linspace(0, job.seconds, _TIMES):
        moving.append(float(renderer.object_masks(t).mean()))
        depths.append(renderer.depths(t))
    near, far = (float(f(d[np.isfinite(d)])) for f, d in ((np.min, np.stack(depths)), (np.max, np.stack(depths))))
    plan, speed = plan_of(job), max_image_speed(world, views, job.seconds)
    spacing = " / ".join(str(s) for s in plan.chain) + (f", {plan.sub_ticks} a tick" if plan.sub_ticks > 1 else "")
    return [
        job.world,
        f"{world.notes['speed_m_s']:.3g}",
        f"{world.notes['length_m']:.2g}",
        f"{speed / 1000:.2f}",
        f"{100 * np.mean(moving):.1f}",
        f"{near:.1f} to {far:.1f}",
        spacing,
        _made_in(job, reports),
    ]


def _made_in(job: Job, reports: Path | None) -> str:
    path = None if reports is None else reports / f"{job.id}.report.json"
    if path is None or not path.is_file():
        return "-"
    report: dict[str, Any] = read_json(path, "the report of a scene")
    try:
        return f"{report['total_s'] - report['stages_s'].get('audit', 0):.0f}"
    except (KeyError, TypeError, AttributeError):
        found = f"keys {', '.join(report) or 'none'}"
        raise problem(path, "numbers total_s and stages_s", found, "make the scene again") from None
