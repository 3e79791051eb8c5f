"""Gain and dark maps of a camera, as `calibrate` writes them and recordings include them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.untrusted import Expected, read_npz


def read_maps(path: Path, width: int, height: int) -> dict[str, Float32]:
    """Return the maps of an .npz, `gain` (mean 1) and `dark` (spikes per tick), each [H, W].

    Raises UserError where the file is missing, damaged, or not of a camera of this size.
    """
    what = f"an .npz of the maps gain and dark, {width}x{height} pixels each"
    fix = "make it with `spike4dgs calibrate`"
    shapes = dict.fromkeys(("gain", "dark"), Expected("fiu", (height, width)))
    maps = {name: values.astype(np.float32) for name, values in read_npz(path, what, shapes, fix).items()}
    for name, values in maps.items():
        if not np.isfinite(values).all():
            raise problem(path, what, f"{name} not finite", fix)
    return maps
