"""`make-dataset`: render worlds, simulate their spike cameras, write scene folders."""

from __future__ import annotations

from dataclasses import fields
from dataclasses import replace as replaced
from pathlib import Path

import tyro
from tyro.conf import OmitArgPrefixes, Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.cli.options import RENDERERS, Renderers
from spike4dgs.generators import make_dataset as scenes
from spike4dgs.generators.make_dataset import SceneSettings
from spike4dgs.generators.physics import PhysicsOptions
from spike4dgs.generators.rendering.mitsuba_variant import choose_device

DEFAULTS = SceneSettings()


def make_dataset(
    worlds: Positional[tuple[str, ...]] = (),
    *,
    all: bool = False,
    out: Path = Path("data"),
    settings: OmitArgPrefixes[SceneSettings] = DEFAULTS,
    also: tuple[str, ...] = (),
    renderers: OmitArgPrefixes[Renderers] = RENDERERS,
    audit: bool = False,
    replace: bool = False,
    check: Path | None = None,
    track: str | None = None,
) -> int:
    """Render worlds and simulate their spike cameras: one scene folder OUT/WORLD-VARIANT-PROFILE for each world.

    Give the same command again to resume a killed run. Existing scenes are checked and kept. OUT/ID.report.json lists
    the time of each stage. Equal arguments give equal bytes, with any number of workers.

    Args:
        worlds: Names of worlds, such as car turntable.
        all: Make all worlds except those that are hard by design: appear, beads, blank, flash, mirror, rain.
        out: Folder for the scene folders.
        also: Camera and light options of further scenes of each world, such as light=0.25 lens=-0.2,0.03
            "read-noise=0.006 dead-ticks=1". Scenes that differ only in sensors, light, lost ticks or given poses are
            rendered once.
        audit: Compare random ticks with full renderings of 4 times the samples, and measure the noise; see the report.
        replace: Make existing scenes again, even undamaged ones.
        check: A folder of reference scenes, such as a release, or one scene folder. Missing scenes are made in OUT,
            and each scene is compared with its reference of the same id: equal, rendering noise, or a change of the
            world. A scene that is not equal is rendered again with other noise. Reports: OUT/check.md, .json, .png.
        track: Make the scenes of a track of release 2: small, dev-small, ideal or paper. It sets the profile, variants
            and camera. If no world is named, all nine are made.
    """
    from spike4dgs.generators.worlds import WORLDS  # it loads other packages' worlds

    if all and worlds:
        raise problem("worlds", "names or --all", "both", "leave one out")
    names = list(WORLDS.all_names if all or (track and not worlds) else dict.fromkeys(worlds))
    if not names:
        raise problem("worlds", "at least one world, or --all", "none", f"choose among {', '.join(WORLDS)}")
    chosen = list(names)
    if track and also:
        raise problem("--also", "no --track, which has its own camera", "both", "leave one out")
    every = [settings, *(replaced(settings, physics=physics_of(options)) for options in also)]
    jobs = scenes.track_jobs(track, chosen, settings) if track else [one.job(name) for name in chosen for one in every]
    choose_device(renderers.device)
    workers, scheduler = renderers.workers, renderers.scheduler
    return scenes.make_dataset(
        jobs, out, workers=workers, scheduler=scheduler, audit=audit, replace=replace, check=check
    )


def physics_of(options: str) -> PhysicsOptions:
    """Return options of camera and light that stand in one argument of --also: "NAME=VALUE NAME=VALUE,VALUE".

    Raises UserError for what is none.
    """
    known = {field.name.replace("_", "-") for field in fields(PhysicsOptions)}
    arguments = []
    for option in options.split():
        name, is_given, values = option.partition("=")
        if name not in known:
            raise problem("--also", "options of camera and light, such as light=0.25", repr(option), "correct it")
        arguments += [f"--{name}", *(values.split(",") if is_given else [])]
    return tyro.cli(PhysicsOptions, prog="make-dataset --also", args=arguments)
