"""`export-ply`: the Gaussians of a fitted model at several times, as files for other viewers."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.environment import choose_device
from spike4dgs.method.viewing.ply import write_ply


def export_ply(model: Positional[Path], out: Path, *, times: int = 30, device: str = "cpu") -> int:
    """Write the Gaussians of a fitted model at equally spaced times as .ply files, which splat viewers open.

    Each file is named by its tick. Colour is the sRGB-encoded gray radiance, as degree 0 of the spherical harmonics. If
    the model was fitted with another pixel filter than viewers' 0.3 px^2, opacities are scaled to preserve its light.
    Gaussians that have faded at a time are left out of its file. Radiance fields have no Gaussians, and a .ply cannot
    hold colours that a network decodes (the motion `spacetime`), so both are refused.

    Args:
        model: A model saved by run-benchmark, OUT/models/METHOD/SCENE.safetensors, or by fit, OUT/model.safetensors.
        out: New folder to write.
        times: Number of files; the clip is divided into as many equal parts, and each file is at the middle of one.
        device: auto, cpu or cuda.
    """
    saved, ticks = write_ply(model, out, times, choose_device(device))
    rate = f"{saved.provenance.rate_hz:g} ticks/s"
    print(f"{out}: {times} files of the ticks {ticks[0]} to {ticks[-1]}, {rate} ({saved.title})")
    return 0
