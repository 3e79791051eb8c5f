"""`speed render`: the rendering speed of saved models, side by side in one process.

Models take turns at every camera and time, so that other load on the machine affects all of them alike.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from typing import Any

import torch
from tyro.conf import Positional

from spike4dgs.benchmark.environment import choose_device
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.models.saved_model import SavedModel, load_model
from spike4dgs.method.torch_state import one_torch_thread
from spike4dgs.method.viewing.camera_paths import resized
from spike4dgs.studies.kit.timing import show_table


def render(
    models: Positional[tuple[Path, ...]],
    *,
    times: int = 10,
    scale: float = 1.0,
    device: str = "cpu",
    csv: Path | None = None,
) -> int:
    """Time the images of saved models at the training cameras, over the clip.

    Args:
        models: Saved models: OUT/models/METHOD/SCENE.safetensors.
        times: Times of the clip at each camera.
        scale: Size, as a multiple of the training views' each way.
        device: auto, cpu or cuda.
        csv: Write the table here too.
    """
    if not models:
        raise problem("speed render", "saved models", "none", "name OUT/models/METHOD/SCENE.safetensors of a run")
    if times < 1:
        raise problem("--times", "1 or more", str(times), "correct it")
    device = choose_device(device)
    loaded = [load_model(path, device) for path in models]
    shots = [_shots(m, times, scale) for m in loaded]
    with one_torch_thread():
        for m, s in zip(loaded, shots, strict=True):
            m.model.render(*s[0])  # compilation
        taken: list[list[float]] = [[] for _ in loaded]
        for turn in range(max(map(len, shots))):
            for m, of, own in zip(loaded, shots, taken, strict=True):
                start = time.perf_counter()
                m.model.render(*of[turn % len(of)])  # an image in memory of the host: a GPU has finished
                own.append(1e3 * (time.perf_counter() - start))
    rows = [_row(*of) for of in zip(loaded, shots, taken, strict=True)]
    columns = ("model", "pixels", "Gaussians", "min ms", "median ms", "frames/s")
    threads = f"{device}, torch {torch.__version__} on one thread beside the kernels' own"
    show_table(f"Images of saved models; {threads}", columns, rows, csv)
    return 0


def _shots(saved: SavedModel, times: int, scale: float) -> list[tuple[Camera, float]]:
    """Return every training camera at `times` times, the middles of equal parts of the clip; cameras take turns."""
    about = saved.provenance
    cameras = [c if scale == 1 else resized(c, scale) for c in about.cameras]
    return [(c, (i + 0.5) / times * about.duration_us) for i in range(times) for c in cameras]


def _row(saved: SavedModel, shots: list[tuple[Camera, float]], times_ms: list[float]) -> tuple[str, ...]:
    median, (camera, t_us) = statistics.median(times_ms), shots[0]
    splats: Any = getattr(saved.model, "splats", None)  # a radiance field has none
    count = str(len(splats(t_us))) if splats else ""
    size = f"{camera.width}x{camera.height}"
    return saved.title, size, count, f"{min(times_ms):.2f}", f"{median:.2f}", f"{1e3 / median:.0f}"
