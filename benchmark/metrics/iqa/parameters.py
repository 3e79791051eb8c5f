"""The numbers that BRISQUE and NIQE learned: `live_parameters.npz`, published by LIVE (UT Austin; terms in NOTICE)."""

from __future__ import annotations

from importlib.resources import files

import numpy as np

from spike4dgs.benchmark.metrics.iqa.natural_scene_statistics import Float64

_FILE = "live_parameters.npz"


def load_parameters(metric: str) -> dict[str, Float64]:
    """Return the arrays of one metric ("brisque" or "niqe") by name, in float64."""
    with files("spike4dgs.benchmark.metrics.iqa").joinpath(_FILE).open("rb") as f, np.load(f) as arrays:
        return {
            name.removeprefix(f"{metric}_"): arrays[name].astype(np.float64)
            for name in arrays.files
            if name.startswith(f"{metric}_")
        }
