"""The inputs and the output of a renderer, and the constants that all back ends share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from spike4dgs.benchmark.errors import UserError, problem
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.method.splat.lens import lens_rows

ALPHA_MIN = 1.0 / 255.0  # a Gaussian fainter than this at a pixel is skipped there
ALPHA_MAX = 0.999  # no Gaussian is more opaque than this, so that T never becomes 0
T_MIN = 1e-4  # a pixel is finished before the Gaussian that would bring T down to this

NEAR = 0.01  # Gaussians whose centre is nearer than this (in world units) are not rendered
EPS2D = 0.3  # variance of the customary pixel filter, px^2


@dataclass(frozen=True)
class PixelFilter:
    """The filter that a model is fitted and rendered with: a Gaussian of this variance, added to every projection.

    A sensor's pixel is a box of one pixel: variance 1/12 px^2. A compensated filter keeps a Gaussian's total light
    (Mip-Splatting, Yu et al. 2024); without compensation, as customary, it makes small ones brighter.
    """

    variance: float = EPS2D  # px^2
    compensated: bool = False


CUSTOMARY = PixelFilter()


@dataclass(frozen=True, eq=False)
class Splats:
    """N Gaussians as a renderer needs them. F is any number of colour channels."""

    means: Tensor  # [N, 3] world coordinates
    quats: Tensor  # [N, 4] wxyz, any length but 0
    scales: Tensor  # [N, 3] standard deviations, after exp
    opacities: Tensor  # [N] after sigmoid
    colors: Tensor  # [N, F]

    def __post_init__(self) -> None:
        n = self.means.shape[0] if self.means.ndim else 0
        channels = self.colors.shape[1] if self.colors.ndim == 2 else 0
        wanted = {
            "means": (n, 3),
            "quats": (n, 4),
            "scales": (n, 3),
            "opacities": (n,),
            "colors": (n, max(channels, 1)),
        }
        for name, shape in wanted.items():
            value = getattr(self, name)
            if tuple(value.shape) != shape:
                raise problem(
                    f"Splats.{name}", f"shape {shape}", str(tuple(value.shape)), "pass N rows in every tensor"
                )
            if not value.is_floating_point() or value.device != self.means.device:
                found = f"{value.dtype} on {value.device}"
                raise problem(f"Splats.{name}", f"floats on {self.means.device}", found, "convert it first")

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def tensors(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """All five, in the order of the fields."""
        return (*self.geometry, self.colors)

    @property
    def geometry(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The four tensors that decide where a Gaussian is seen: means, quats, scales, opacities."""
        return self.means, self.quats, self.scales, self.opacities


@dataclass(frozen=True, eq=False)
class Views:
    """C cameras of one image size: OpenCV world-to-camera poses, pixel centres at +0.5."""

    w2c: Tensor  # [C, 4, 4]
    K: Tensor  # [C, 3, 3]
    width: int
    height: int
    lenses: Tensor | None = None  # [C, 10], see lens.py; None: pinholes

    def __post_init__(self) -> None:
        n = self.w2c.shape[0] if self.w2c.ndim else 0
        for name, shape in (("w2c", (n, 4, 4)), ("K", (n, 3, 3)), ("lenses", (n, 10))):
            if (value := getattr(self, name)) is None:
                continue
            found = tuple(value.shape)
            if found != shape or n == 0:
                raise problem(
                    f"Views.{name}", f"shape {shape} with at least one camera", str(found), "stack the cameras"
                )
        if self.width < 1 or self.height < 1:
            raise problem(
                "Views", "a positive image size", f"{self.width}x{self.height}", "give width and height in px"
            )

    def __len__(self) -> int:
        return self.w2c.shape[0]

    @classmethod
    def from_cameras(cls, cameras: Sequence[Camera], device: torch.device | str = "cpu") -> Views:
        """Stack calibrated cameras. float64 costs nothing here and keeps worlds far from their origin sharp.

        Raises UserError for cameras of several sizes, and for a lens whose model does not hold up to the corners.
        """
        sizes = sorted({(c.width, c.height) for c in cameras})
        if len(sizes) != 1:
            raise problem("cameras", "one image size", f"{sizes}", "render the cameras of each size on their own")
        w2c = torch.stack([torch.as_tensor(c.w2c, dtype=torch.float64) for c in cameras]).to(device)
        K = torch.stack([torch.as_tensor(c.K, dtype=torch.float64) for c in cameras]).to(device)
        return cls(w2c, K, *sizes[0], lens_rows(cameras, device))

    def some(self, chosen: Sequence[int]) -> Views:
        """Return some of the views, in the order of `chosen`."""
        # Not w2c[list(chosen)]: that list would be copied to a device, which waits.
        w2c, K = (torch.stack([matrices[view] for view in chosen]) for matrices in (self.w2c, self.K))
        lenses = None if self.lenses is None else torch.stack([self.lenses[view] for view in chosen])
        return replace(self, w2c=w2c, K=K, lenses=lenses)

    def to(self, device: torch.device | str) -> Views:
        """Return the same views on a device."""
        lenses = None if self.lenses is None else self.lenses.to(device)
        return replace(self, w2c=self.w2c.to(device), K=self.K.to(device), lenses=lenses)


@dataclass(frozen=True, eq=False)
class RenderOutput:
    """Images of C views, and the N Gaussians' statistics in each, which densification uses.

    `means2d` holds the projected centres in pixels (0 where invisible). Where the render is differentiated,
    `means2d.grad` is dLoss/dmeans2d in the same units after `backward()`, on every back end.
    """

    image: Tensor  # [C, H, W, F]
    alpha: Tensor  # [C, H, W] 1 - transmittance
    depth: Tensor | None  # [C, H, W] sum of weight * z (not divided by alpha), or None if not requested
    radii: Tensor  # [C, N] px, larger half side of the visible ellipse's bounding box; 0 where invisible
    means2d: Tensor  # [C, N, 2] px

    @property
    def visible(self) -> Tensor:
        """[C, N] bool: near enough, opaque enough, and its ellipse covers at least one pixel centre."""
        return self.radii > 0


def require_finite(splats: Splats) -> None:
    """Raise UserError if any parameter is NaN or infinite."""
    for name in ("means", "quats", "scales", "opacities", "colors"):
        bad = torch.nonzero(~torch.isfinite(getattr(splats, name).detach()))
        if len(bad):
            raise not_finite(name, int(bad[0, 0]))


def require_finite_cameras(views: Views) -> None:
    """Raise UserError if a pose or an intrinsic is NaN or infinite: such a camera would see nothing."""
    for name in ("w2c", "K"):
        bad = torch.nonzero(~torch.isfinite(getattr(views, name).detach()))
        if len(bad):
            found = f"NaN or infinity at camera {int(bad[0, 0])}"
            raise problem(f"Views.{name}", "finite numbers", found, "check the poses and the calibration")


def not_finite(name: str, index: int) -> UserError:
    """Return the error for a parameter that is NaN or infinite."""
    fix = "check for a diverging learning rate or a division by 0"
    return problem(f"Splats.{name}", "finite numbers", f"NaN or infinity at Gaussian {index}", fix)
