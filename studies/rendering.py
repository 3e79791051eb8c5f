"""`spacing` and `tradeoff`: the report's measurements of rendering, for one world at a chosen size."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.studies.kit.measurement import Measurement, Request, Series
from spike4dgs.studies.kit.runner import run_study


def spacing(
    world: Positional[str] = "car",
    *,
    out: Path = Path("runs/spacing"),
    width: int = 200,
    height: int = 125,
    ticks: int = 256,
    spp: int = 64,
    seed: int = 0,
    variant: int = 0,
) -> int:
    """Report key-frame spacing against errors and render time, on the page OUT/WORLD/index.html.

    Args:
        world: Name of a world.
        out: Folder; OUT/WORLD has the page, the JSON, and the table as measurements/keys.csv.
        width: Width of the image in pixels.
        height: Height of the image in pixels.
        ticks: Length of the clip, a multiple of 64 ticks; every tick is rendered once.
        spp: Samples per pixel, a power of two.
        seed: Seed of the world and the rendering.
        variant: Variant of the world.
    """
    from spike4dgs.generators.worlds import WORLDS
    from spike4dgs.studies.speed_error import keys

    if world not in WORLDS:
        raise problem("world", f"one of {', '.join(WORLDS)}", repr(world), "correct the name")
    if ticks < 64 or ticks % 64:
        raise problem("--ticks", "a positive multiple of 64", str(ticks), "give 256, for example")

    def run(request: Request) -> Iterable[Series]:
        return keys.spaced(world, (width, height), ticks, spp, seed, variant, limits=True)

    options = {"width": width, "height": height, "ticks": ticks, "spp": spp, "variant": variant}
    return _one(keys.keys, run, out / world, seed, options)


def tradeoff(
    world: Positional[str] = "car",
    *,
    profile: str = "paper",
    out: Path = Path("runs/tradeoff"),
    seed: int = 0,
    variant: int = 0,
) -> int:
    """Report render time against error for several settings, on the page OUT/WORLD/index.html.

    Args:
        world: Name of a world.
        profile: Size and sampling: tiny, small or paper.
        out: Folder; OUT/WORLD has the page, the JSON, and the table as measurements/rendering.csv.
        seed: Seed of the world and the rendering.
        variant: Variant of the world.
    """
    from spike4dgs.generators.profiles import PROFILES, Job
    from spike4dgs.generators.worlds import WORLDS
    from spike4dgs.studies.speed_error import rendering

    if world not in WORLDS or profile not in PROFILES:
        names = f"one of {', '.join(WORLDS)}, and of {', '.join(PROFILES)}"
        raise problem("world and --profile", names, f"{world}, {profile}", "correct the name")
    p = PROFILES[profile]
    job = Job(world, variant, seed, profile, p, p.seconds)
    options = {"profile": profile, "variant": variant}
    return _one(rendering.savings, lambda request: (rendering.saved(job),), out / world, seed, options)


def _one(m: Measurement, run: Any, out: Path, seed: int, options: dict[str, Any]) -> int:
    return run_study([replace(m, run=run)], Request("whole", seed, "cpu", lambda: out), out, options)
