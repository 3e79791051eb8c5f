"""`speed render`: the rendering speed of saved models, side by side in one process, and their error against float64.

Models take turns at every camera and time, so that other load on the machine affects all of them alike. The exact image
is composited in float64 at some patches; the motion of a model's Gaussians is not part of the comparison.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor
from tyro.conf import Positional

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.models.saved_model import SavedModel, load_model
from spike4dgs.method.splat import Splats, Views
from spike4dgs.method.splat.reference import composite_patch, project
from spike4dgs.method.splat.types import PixelFilter
from spike4dgs.method.torch_state import one_torch_thread
from spike4dgs.method.viewing.camera_paths import resized
from spike4dgs.studies.kit.timing import show_table

PATCH = (32, 16)  # px, width and height
PATCHES = ((0.2, 0.3), (0.5, 0.3), (0.8, 0.3), (0.2, 0.7), (0.5, 0.7), (0.8, 0.7))  # their middles, in images


@runtime_checkable
class Splatting(Protocol):
    """A model that renders Gaussians."""

    @property
    def pixel_filter(self) -> PixelFilter:
        """The filter of its images."""
        ...

    def render(self, camera: Camera, t_us: float) -> Float32:
        """Return gray linear radiance [H, W]."""
        ...

    def splats(self, t_us: float) -> Splats:
        """Return the Gaussians to render at `t_us`."""
        ...

    def image(self, image: Tensor, views: Views) -> Tensor:
        """Return gray radiance [V, H, W] from rendered channels [V, H, W, F]."""
        ...


def render(
    models: Positional[tuple[Path, ...]],
    *,
    times: int = 10,
    scale: float = 1.0,
    device: str = "cpu",
    csv: Path | None = None,
) -> int:
    """Time the images of saved models at the training cameras, over the clip, and compare them with float64.

    Args:
        models: Saved models: OUT/models/METHOD/SCENE.safetensors.
        times: Times of the clip at each camera.
        scale: Size, as a multiple of the training views' each way.
        device: cpu or cuda.
        csv: Write the table here too.
    """
    if not models:
        raise problem("speed render", "saved models", "none", "name OUT/models/METHOD/SCENE.safetensors of a run")
    loaded = [load_model(path, device) for path in models]
    shots = [_shots(m, times, scale) for m in loaded]
    with one_torch_thread():
        for m, s in zip(loaded, shots, strict=True):
            m.model.render(*s[0])  # compilation
        taken: list[list[float]] = [[] for _ in loaded]
        for turn in range(max(map(len, shots))):
            for i, m in enumerate(loaded):
                taken[i].append(_time_ms(m, *shots[i][turn % len(shots[i])]))
        rows = [_row(*of) for of in zip(loaded, shots, taken, strict=True)]
    columns = ("model", "pixels", "Gaussians", "min ms", "median ms", "frames/s", "mean error", "largest error")
    threads = f"{device}, torch {torch.__version__} on one thread beside the kernels' own"
    show_table(f"Images of saved models; {threads}; errors against float64", columns, rows, csv)
    return 0


def _shots(saved: SavedModel, times: int, scale: float) -> list[tuple[Camera, float]]:
    """Return every training camera at `times` times, the middles of equal parts of the clip; cameras take turns."""
    about = saved.provenance
    cameras = [c if scale == 1 else resized(c, scale) for c in about.cameras]
    return [(c, (i + 0.5) / times * about.duration_us) for i in range(times) for c in cameras]


def _time_ms(saved: SavedModel, camera: Camera, t_us: float) -> float:
    start = time.perf_counter()
    saved.model.render(camera, t_us)  # an image in memory of the host: a GPU has finished
    return 1e3 * (time.perf_counter() - start)


def _row(saved: SavedModel, shots: list[tuple[Camera, float]], times_ms: list[float]) -> tuple[str, ...]:
    median, camera = statistics.median(times_ms), shots[0][0]
    shown = (f"{min(times_ms):.2f}", f"{median:.2f}", f"{1e3 / median:.0f}")
    name = (saved.title, f"{camera.width}x{camera.height}")
    if not isinstance(saved.model, Splatting):
        return *name, "", *shown, "", ""
    differences = np.concatenate([d.ravel() for shot in shots[:: max(1, len(shots) // 3)][:3]
                                  for d in errors(saved.model, *shot)])  # fmt: skip
    count = str(len(saved.model.splats(shots[0][1])))
    return *name, count, *shown, f"{differences.mean():.1e}", f"{differences.max():.1e}"


@torch.no_grad()
def errors(model: Splatting, camera: Camera, t_us: float) -> Iterator[Float32]:
    """Yield absolute differences [h, w] of a model's image from the exact one, at patches of it."""
    image = model.render(camera, t_us)
    width, height = min(PATCH[0], camera.width), min(PATCH[1], camera.height)
    for u, v in PATCHES:
        x = min(max(int(u * camera.width) - width // 2, 0), camera.width - width)
        y = min(max(int(v * camera.height) - height // 2, 0), camera.height - height)
        exact = exact_patch(model, camera, t_us, (x, y), (width, height))
        yield np.abs(image[y : y + height, x : x + width] - exact)


@torch.no_grad()
def exact_patch(
    model: Splatting, camera: Camera, t_us: float, corner: tuple[int, int], size: tuple[int, int]
) -> Float32:
    """Return a part [h, w] of a model's image, composited in float64: `size` (width, height) px from `corner` (x, y).

    The Gaussians are projected as for the whole image; those that cannot reach the patch are left out.
    """
    splats, views = model.splats(t_us), Views.from_cameras([camera])
    wide = Splats(*(t.double().cpu() for t in splats.tensors))
    whole = (camera.width, camera.height)
    f = model.pixel_filter
    seen = project(wide, views.w2c[0], views.K[0], whole, f)
    image, _ = composite_patch(seen, wide.colors, corner, size)
    K = views.K.clone()
    K[:, :2, 2] -= torch.tensor(corner, dtype=K.dtype)
    device = splats.means.device
    cut = Views(views.w2c.to(device), K.to(device), *size)
    gray = model.image(image[None].to(splats.colors), cut)
    return gray[0].clamp(min=0).cpu().numpy()
