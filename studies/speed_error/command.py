"""`report speed-error`: the plan of measurements, in the order of the page."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Literal

from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.errors import problem
from spike4dgs.studies.kit.measurement import Measurement, Request, Size
from spike4dgs.studies.kit.runner import in_order, run_study


def plan() -> Sequence[Measurement]:
    """Return all measurements. Raises ValueError where two have one id."""
    from spike4dgs.studies.speed_error import (
        cuts,
        fits,
        growth,
        images,
        keys,
        networks,
        rendering,
        scores,
        sensor,
        splat,
    )

    return in_order(
        (
            *(splat.precision, splat.gradients, cuts.exponential, cuts.extent, cuts.transmittance, cuts.pixel_filter),
            *(splat.background, splat.beside_torch, networks.fused_ssim, networks.lookup, networks.msdi_images),
            *(images.makers, images.half_floats, *fits.FITS),
            *(sensor.integration, sensor.other_program, keys.keys, rendering.savings, rendering.soft_light),
            *(scores.scores, scores.flip_score, scores.decoding),
            *(growth.pixels, growth.gaussians, growth.views, growth.threads),
            *(growth.sensor_pixels, growth.sensor_clip, growth.sensor_threads, growth.metrics),
        )
    )


def speed_error(
    *,
    out: Path = Path("runs/speed-error"),
    size: Size = "whole",
    quick: bool = False,
    only: tuple[str, ...] = (),
    scene: Path | None = None,
    seed: int = 0,
    device: Literal["auto", "cpu", "cuda"] = "cpu",
    again: bool = False,
) -> int:
    """Measure every approximation of the project beside its exact twin, and how costs grow, in one run.

    Writes OUT/index.html, a page with plots that opens from the disk, and OUT/speed_error.json. Each measurement is
    kept in OUT/measurements as soon as it is done, with its table as CSV: the same command resumes a killed one. Use a
    machine that does nothing else: other programs change the times, never the errors.

    Args:
        out: Folder for the page, the JSON and the scene.
        size: whole (about an hour on two cores), quick (ten minutes), or tiny (seconds, to try the command).
        quick: The same as --size quick.
        only: Measure these alone, by the ids in the page's sections, such as splat ssim; splat-torch and
            sensor-spikezoo, which compare with other programs, are measured only so.
        scene: A scene folder for the fits and the images; without it, OUT/scenes has a new one of the world car.
        seed: Seed of all random inputs.
        device: cpu, cuda, or auto: cuda where there is one. Most twins are measured on the CPU in any case.
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

    request = Request(size, seed, choose_device(device), made)
    return run_study(measurements, request, out, {"scene": str(scene or "")}, again)
