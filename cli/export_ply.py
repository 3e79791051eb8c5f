"""`export-ply`: the Gaussians of a fitted model at several times, as files for other viewers."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from spike4dgs.method.viewing.ply import write_ply


def export_ply(model: Positional[Path], out: Path, *, times: int = 30, device: str = "cpu") -> int:
    """Write the Gaussians of a fitted model at equally spaced times as .ply files, which splat viewers open.

    A file is named by its tick. Colour is the sRGB-encoded gray radiance at degree 0 of the spherical harmonics. Of a
    model fitted with another pixel filter than viewers' 0.3 px^2, opacities are scaled so that its light stays.
    Gaussians that have faded away at a time are left out of its file. Radiance fields have no Gaussians, and colours
    that a network decodes (the motion `spacetime`) have no place in a .ply: both are refused.

    Args:
        model: A model that run-benchmark has saved: OUT/models/METHOD/SCENE.safetensors.
        out: New folder to write.
        times: Number of files, in the middles of so many equal parts of the clip.
        device: cpu or cuda.
    """
    saved, ticks = write_ply(model, out, times, device)
    rate = f"{saved.provenance.rate_hz:g} ticks/s"
    print(f"{out}: {times} files of the ticks {ticks[0]} to {ticks[-1]}, {rate} ({saved.title})")
    return 0
