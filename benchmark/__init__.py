"""The contract and the judge: spike streams, cameras, scene folders, metrics, results and the runner."""

import os
from typing import TYPE_CHECKING

from spike4dgs.benchmark.lazy import lazy_names
from spike4dgs.benchmark.machine.quota import limit_openmp

# Before torch loads OpenMP, which reads these once: its threads wait asleep. Spinning, they take the cores from one
# another and from our own threads as soon as another program runs.
if "GOMP_SPINCOUNT" not in os.environ:
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
limit_openmp(os.environ)


def _has_avx2() -> bool:
    try:
        with open("/proc/cpuinfo", encoding="ascii", errors="replace") as file:
            flags = next((line for line in file if line.startswith("flags")), "").split()
    except OSError:  # not Linux
        return False
    return {"avx2", "fma"} <= set(flags)


# Before NumPy loads OpenBLAS: its kernels for AVX-512 round otherwise, and poses of scenes would differ by a bit.
if _has_avx2():
    os.environ.setdefault("OPENBLAS_CORETYPE", "Haswell")

if TYPE_CHECKING:
    from spike4dgs.benchmark.errors import UserError
    from spike4dgs.benchmark.method import Budget, FitRequest, Method, Model, Recipe, find_methods, get_method
    from spike4dgs.benchmark.metrics.measure import score_image
    from spike4dgs.benchmark.metrics.table import METRICS
    from spike4dgs.benchmark.runs.predictions import write_predictions
    from spike4dgs.benchmark.runs.record import read_record
    from spike4dgs.benchmark.runs.results import records_to_dataframe
    from spike4dgs.benchmark.runs.score import score_predictions
    from spike4dgs.benchmark.scene.cameras import Camera
    from spike4dgs.benchmark.scene.scene import Scene, Target, TrainingScene, open_scene
    from spike4dgs.benchmark.spikes.stream import SpikeStream, open_stream
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "errors": ("UserError",),
            "method": ("Budget", "FitRequest", "Method", "Model", "Recipe", "find_methods", "get_method"),
            "metrics.measure": ("score_image",),
            "metrics.table": ("METRICS",),
            "runs.results": ("records_to_dataframe",),
            "runs.predictions": ("write_predictions",),
            "runs.record": ("read_record",),
            "runs.score": ("score_predictions",),
            "scene.cameras": ("Camera",),
            "scene.scene": ("Scene", "Target", "TrainingScene", "open_scene"),
            "spikes.stream": ("SpikeStream", "open_stream"),
        },
    )

__all__ = [
    "METRICS",
    "Budget",
    "Camera",
    "FitRequest",
    "Method",
    "Model",
    "Recipe",
    "Scene",
    "SpikeStream",
    "Target",
    "TrainingScene",
    "UserError",
    "find_methods",
    "get_method",
    "open_scene",
    "open_stream",
    "read_record",
    "records_to_dataframe",
    "score_image",
    "score_predictions",
    "write_predictions",
]
