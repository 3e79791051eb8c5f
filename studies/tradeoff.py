"""`tradeoff`: error and time of each saving of the renderer, for one world and profile.

The keys around a few random ticks are rendered with different settings. The radiance that the sensor would receive at
these ticks is compared with full renderings of four times the profile's samples. The time is the mean time of the keys
of each spacing, times their number in a clip of the profile's length.
"""

from __future__ import annotations

import csv
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tyro.conf import Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path
from spike4dgs.generators.profiles import PROFILES, RATE_HZ, Job
from spike4dgs.generators.render_tasks import (
    RenderKeys,
    RenderStatic,
    StaticParts,
    cameras_of,
    held_out_view,
    plan_of,
    world_of,
)
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.keyframes import KeyStore
from spike4dgs.generators.rendering.render import MultiViewRenderer
from spike4dgs.generators.truth import errors

_TICKS = 3
MORE = 4  # times the profile's samples, for the truth


@dataclass(frozen=True)
class Row:
    """One setting. Errors are those of `audit`, means over the ticks, at the held-out camera."""

    setting: str
    keys_minutes: float  # for all views and the whole clip
    psnr_db: float
    mean_percent: float
    p999_percent: float
    psnr_db_moving: float
    mean_percent_moving: float
    p999_percent_moving: float


def settings(job: Job) -> dict[str, Job]:
    """Return the settings that are compared, the profile's own first."""
    p = job.profile
    return {
        f"as shipped: {p.spp} samples, {p.max_key_px:g} px": job,
        f"keys 2x sparser: {2 * p.max_key_px:g} px": replace(job, profile=replace(p, max_key_px=2 * p.max_key_px)),
        f"keys 4x sparser: {4 * p.max_key_px:g} px": replace(job, profile=replace(p, max_key_px=4 * p.max_key_px)),
        f"half the samples: {p.spp // 2}": replace(job, profile=replace(p, spp=p.spp // 2)),
        "every tick": replace(job, adaptive=False),
        "whole frames": replace(job, whole_frames=True),
    }


def tradeoff(
    world: Positional[str] = "car",
    *,
    profile: str = "paper",
    out: Path = Path("runs/tradeoff"),
    seed: int = 0,
    variant: int = 0,
) -> int:
    """Report render time against error for several settings: OUT/WORLD.csv and OUT/WORLD.png.

    Args:
        world: Name of a world.
        profile: Size and sampling: tiny, small or paper.
        out: Folder for the table and the plot.
        seed: Seed of the world and the rendering.
        variant: Variant of the world.
    """
    from rich.console import Console

    from spike4dgs.generators.worlds import WORLDS

    if world not in WORLDS or profile not in PROFILES:
        names = f"one of {', '.join(WORLDS)}, and of {', '.join(PROFILES)}"
        raise problem("world and --profile", names, f"{world}, {profile}", "correct the name")
    p = PROFILES[profile]
    job, console = Job(world, variant, seed, profile, p, p.seconds), Console(width=120)
    ticks = sorted(int(t) for t in np.random.default_rng(seed).choice(job.n_ticks, _TICKS, replace=False))
    console.print(f"truth at ticks {ticks}, {MORE * p.spp} samples a pixel")
    truth, moving = truth_at(job, ticks)
    rows: list[Row] = []
    static: dict[int, StaticParts] = {}
    for name, changed in settings(job).items():
        spp = changed.profile.spp
        if spp not in static:
            static[spp] = RenderStatic(changed)(None)
        rows.append(measure(name, changed, static[spp], ticks, truth, moving))
        console.print(f"{name}: {rows[-1].keys_minutes:.1f} min, {rows[-1].mean_percent:.2f} %", markup=False)
        _write(rows, out / f"{world}.csv")  # after every setting: the last ones take longest
        title = f"{world}, {profile}: {p.width}x{p.height}, {p.seconds * 1e3:g} ms, {len(p.views)} views"
        _plot(rows, out / f"{world}.png", title)
    print(f"table and plot: {out / world}.csv, .png")
    return 0


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
    name: str,
    job: Job,
    static: StaticParts,
    ticks: Sequence[int],
    truth: NDArray[np.float32],
    moving: NDArray[np.bool_],
) -> Row:
    """Return the row of one setting: the time of its keys, and its errors at ticks whose truth is known."""
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
    total = sum(
        float(np.mean(s)) * sum(plan.level(t) == level for t in plan.ticks) for level, s in seconds.items() if s
    )
    means = {f.name: float(np.mean([e[f.name] for e in found])) for f in fields(Row) if f.name in found[0]}
    return Row(name, total / 60, **means)


def _write(rows: Sequence[Row], path: Path) -> None:
    with atomic_path(path) as part, open(part, "w", newline="") as f:
        writer = csv.DictWriter(f, [x.name for x in fields(Row)])
        writer.writeheader()
        writer.writerows({k: v if isinstance(v, str) else f"{v:.4g}" for k, v in asdict(r).items()} for r in rows)


def _plot(rows: Sequence[Row], path: Path, title: str) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 5), layout="constrained")
    markers = "os^vDPX"  # settings of equal cost lie on each other
    for axes, kind, where in zip(
        figure.subplots(1, 2), ("", "_moving"), ("whole image", "where it moves"), strict=True
    ):
        for row, marker in zip(rows, markers, strict=False):
            values: Any = (row.keys_minutes, getattr(row, f"mean_percent{kind}"))
            axes.plot(*values, marker, label=row.setting, linestyle="none", alpha=0.8)
        axes.set(xscale="log", xlabel="time of the keys, min", ylabel="mean error, %", title=where)
        axes.margins(0.25, 0.15)
        axes.grid(True, color="0.9")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    figure.suptitle(title)
    with atomic_path(path) as part:
        figure.savefig(part, dpi=100)
