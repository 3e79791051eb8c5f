"""MSDI: multi-view spike-based dense initialisation (the paper's section 3.3, eqs. 5-12)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from spike4dgs.method.msdi.config import MsdiConfig


@dataclass(frozen=True, eq=False)
class Estimate:
    """What MSDI makes of B samples of V views of H x W pixels."""

    points: Tensor  # [B, V, H, W, 3] what each pixel sees, in view 0's camera frame (OpenCV), at an arbitrary scale
    confidence: Tensor  # [B, V, H, W] more than 1
    images: Tensor  # [B, V, H, W] spikes per tick at the middle of the window


class Msdi(nn.Module):
    """The networks of MSDI."""

    def __init__(self, config: MsdiConfig) -> None:
        super().__init__()
        self.config = config

    def forward(self, spikes: Tensor, intrinsics: Tensor | None = None) -> Estimate:
        """Points, confidence and images of `spikes` [B, V, T, H, W] of 0 and 1; see `Estimate`.

        `intrinsics` [B, V, 3, 3] in pixels, pixel centres at +0.5, or None where they are unknown.
        """
        raise NotImplementedError
