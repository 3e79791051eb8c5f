"""`report speed-error`: the plan of measurements, in the order of the page."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.studies.kit.measurement import Measurement, Request, Size
from spike4dgs.studies.kit.runner import in_order, run_study


def plan() -> Sequence[Measurement]:
    """Return all measurements, which are decorated functions of these modules."""
    from spike4dgs.studies.speed_error import (
        cuts,
        growth,
        images,
        keys,
        networks,
        rendering,
        scores,
        sensor,
        splat,
    )

    modules = (splat, cuts, images, networks, sensor, keys, rendering, scores, growth)
    return in_order(m for module in modules for m in vars(module).values() if isinstance(m, Measurement))


def speed_error(
    *,
    out: Path = Path("runs/speed-error"),
    size: Size = "whole",
    quick: bool = False,
    only: tuple[str, ...] = (),
    scene: Path | None = None,
    seed: int = 0,
    again: bool = False,
) -> int:
    """Measure every approximation of the project beside its exact twin, and how costs grow, in one run.

    Writes OUT/index.html, a page with plots that opens from the disk, and OUT/speed_error.json. Each measurement is
    kept in OUT/measurements as soon as it is done, with its table as CSV: the same command resumes a killed one. Use a
    machine that does nothing else: other programs change the times, never the errors.

    Args:
        out: Folder for the page, the JSON and the scene.
        size: whole (less than an hour on two cores), quick (less than ten minutes), or tiny (to try the command).
        quick: The same as --size quick.
        only: Measure these alone, by the ids in the page's sections, such as splat ssim; splat-torch, which compares
            with another program, is measured only so.
        scene: A scene folder for the images; without it, OUT/scenes has a new one of the world car.
        seed: Seed of all random inputs.
        again: Measure again what OUT has already.
    """
    size = "quick" if quick else size
    measurements = plan()
    known = [m.id for m in measurements]
    if wrong := [name for name in only if name not in known]:
        raise problem("--only", f"ids among {', '.join(known)}", ", ".join(wrong), "correct the id")
    measurements = [m for m in measurements if (m.id in only if only else size in m.sizes)]

    @cache
    def made() -> Path:
        from spike4dgs.generators.make_dataset import SceneSettings, make_dataset

        if scene is not None:
            return scene
        profile = "small" if size == "whole" else "tiny"
        make_dataset([SceneSettings(profile, seed).job("car")], out / "scenes")
        return out / "scenes" / f"car-0-{profile}"

    request = Request(size, seed, made)
    of = {"scene": open_scene(scene).revision if scene else ""}
    return run_study(measurements, request, out, of, again)
