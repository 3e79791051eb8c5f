"""The Gaussians of a fitted model at several times, as `.ply` files in the layout of 3DGS.

Floats, binary little endian, one row for each Gaussian (`FIELDS`): position in metres, normal (0), colour, opacity
before the sigmoid, natural logarithms of the standard deviations, unit quaternion wxyz.

Viewers show 0.5 + SH_C0 * f_dc as a display value, clipped to [0, 1]. So f_dc is that of the sRGB-encoded radiance, the
same in all three channels. `srgb` is continued above 1 and below 0, so that no radiance is lost. Our renderer blends
radiance and then encodes; a viewer blends what is encoded. Opaque surfaces look the same, half-transparent edges differ
a little.

Viewers blur each Gaussian by 0.3 px^2 (`types.CUSTOMARY`) and let it grow brighter by that. A model that was fitted
with another filter has its opacities scaled, so that a Gaussian gives as much light as in the model's own images from
the training cameras. Its small Gaussians still look softer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import check_new, write_bytes
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.models.fitted_model import GaussianModel
from spike4dgs.method.models.saved_model import SavedModel, load_model
from spike4dgs.method.splat import PixelFilter, Splats, Views
from spike4dgs.method.splat.reference import project_view
from spike4dgs.method.splat.types import ALPHA_MIN, CUSTOMARY

FIELDS = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
SH_C0 = 0.28209479177387814  # 1 / (2 sqrt(pi)), the spherical harmonic of degree 0
_MOST_OPAQUE = 1 - 1e-6  # whose logit is finite


def write_ply(model: Path, out: Path, times: int, device: str = "cpu") -> tuple[SavedModel, list[int]]:
    """Write the Gaussians of a model file at the middles of equal parts of the clip as OUT/TICK.ply.

    Return the model and the ticks. Raises UserError for a radiance field, and for colours that a network decodes.
    """
    saved = load_model(model, device)
    about, fitted = saved.provenance, saved.model
    if not isinstance(fitted, GaussianModel):
        fix = "`spike4dgs render` makes videos of it"
        raise problem(model, "a model of Gaussians", f"{about.name}, a radiance field", fix)
    if not 1 <= times <= about.n_ticks:
        raise problem("--times", f"1 to {about.n_ticks}, the ticks of the clip", str(times), "correct it")
    ticks = [(2 * i + 1) * about.n_ticks // (2 * times) for i in range(times)]
    check_new(out)
    if (own := fitted.pixel_filter) != CUSTOMARY:
        kind = "compensated" if own.compensated else "plain"
        print(f"{model}: fitted with a {kind} filter of {own.variance:.3g} px^2; opacities are scaled to viewers' 0.3")
    for tick in ticks:
        splats = fitted.splats(tick * 1e6 / about.rate_hz)
        if splats.colors.shape[1] != 1:
            found = f"{about.name}, whose colours a network decodes for each ray"
            raise problem(model, "Gaussians with a gray value", found, "fit the motion spacetime-lite")
        write_bytes(out / f"{tick:06d}.ply", to_ply(for_viewers(splats, about.cameras, own)))
    return saved, ticks


@torch.no_grad()
def for_viewers(splats: Splats, cameras: Sequence[Camera], own: PixelFilter) -> Splats:
    """Return Gaussians that give with the customary filter the light that they give with the filter of their model.

    The light goes as opacity sqrt(|S|), with S the covariance in a camera's image. That includes the filter, but not a
    compensated one: its opacities fall as sqrt(|S|) grows. The median over the cameras that see a Gaussian decides.
    """
    if own == CUSTOMARY:
        return splats
    wide, views = Splats(*(t.double().cpu() for t in splats.tensors)), Views.from_cameras(cameras)
    shares = torch.full((len(cameras), len(splats)), torch.nan, dtype=torch.float64)
    less = CUSTOMARY.variance - (0.0 if own.compensated else own.variance)
    for view, share in enumerate(shares):
        seen = project_view(wide, views, view, CUSTOMARY)
        det = seen.det - less * (seen.cov[:, 0] + seen.cov[:, 2]) + less**2  # of the covariance less a filter
        share[seen.index] = (det.clamp(min=0) / seen.det).sqrt()
    share = shares.nanmedian(0).values.nan_to_num(1.0)
    return replace(splats, opacities=splats.opacities * share.to(splats.opacities))


@torch.no_grad()
def to_ply(splats: Splats) -> bytes:
    """Return the file of gray Gaussians, without those that every rasteriser leaves out."""
    kept = splats.opacities >= ALPHA_MIN

    def of(values: torch.Tensor) -> NDArray[np.float64]:
        return np.asarray(values[kept].double().cpu().numpy())

    means, quats, scales = of(splats.means), of(splats.quats), of(splats.scales)
    opacity = np.minimum(of(splats.opacities), _MOST_OPAQUE)
    columns: list[Any] = [
        means,
        np.zeros_like(means),
        np.repeat((srgb(of(splats.colors)) - 0.5) / SH_C0, 3, axis=1),
        np.log(opacity / (1 - opacity))[:, None],
        np.log(np.maximum(scales, np.finfo(np.float32).tiny)),
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
    ]
    rows = np.ascontiguousarray(np.concatenate(columns, axis=1), "<f4")
    properties = [f"property float {name}" for name in FIELDS]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *properties, "end_header", ""]
    return "\n".join(header).encode() + rows.tobytes()


def srgb(radiance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sRGB encoding of linear radiance, continued beyond [0, 1]: linear below 0, the power above 1."""
    power = 1.055 * np.maximum(radiance, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(radiance <= 0.0031308, 12.92 * radiance, power)
