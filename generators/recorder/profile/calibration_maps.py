"""Gain and dark maps of a camera, as `calibrate` writes them and recordings include them."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import problem

Float32 = NDArray[np.float32]


def read_maps(path: Path, width: int, height: int) -> dict[str, Float32]:
    """Return the maps of an .npz, `gain` (mean 1) and `dark` (spikes per tick), each [H, W].

    Raises UserError where the file is missing, damaged, or not of a camera of this size.
    """
    what = f"an .npz of the maps gain and dark, {width}x{height} pixels each"
    fix = "make it with `spike4dgs calibrate`"
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as data:
            maps = {name: np.asarray(data[name], np.float32) for name in ("gain", "dark")}
    except FileNotFoundError:
        raise problem(path, what, "no such file", fix) from None
    except (zipfile.BadZipFile, zlib.error, KeyError, ValueError, TypeError, AttributeError, OSError, EOFError) as e:
        raise problem(path, what, f"damaged data ({e})", fix) from None
    for name, values in maps.items():
        if values.shape != (height, width) or not np.isfinite(values).all():
            found = f"{name} of shape {values.shape}" if values.shape != (height, width) else f"{name} not finite"
            raise problem(path, what, found, fix)
    return maps
