"""The trainer's numbers, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass, replace

from spike4dgs.method.settings import Settings
from spike4dgs.method.splat.types import EPS2D, PixelFilter
from spike4dgs.method.training_views.changes import POINTS


@dataclass(frozen=True)
class TrainerSettings(Settings):
    """Steps, poses, and how Gaussians begin and learn (prefix `trainer`)."""

    # Steps. One step renders several views at one time, where 4DGS takes one image: 1 step here is 4 there.
    coarse_steps: int = 300  # static stage (4DGS: 3000 single images)
    fine_steps: int = 1200  # deforming stage (4DGS: 14000 single images)
    piece_steps: int = 800  # the same of each further piece of a long clip, where the motion model has pieces
    views_per_step: int = 4  # they share one time and one deformation; of 8 views only half as many steps fit the time
    ramp: float = 0.3  # share of the fine stage in which the times open up from the middle to the whole clip
    coarse_share: float = 0.2  # middle share of the clip (or its middle piece) that a moving scene's coarse stage sees

    # Poses of the training cameras.
    refine_poses: bool = False  # fit them too; for initialisations that estimated them
    lr_poses: float = 2e-4  # radians, and translations by the scene's scale: 0.05 px a step at 225 px
    lr_poses_last: float = 2e-6

    # The pixel filter, of the fit and of the fitted model. 0.3 px^2 without compensation is customary, and its blur
    # helps where images are noisy.
    filter_variance: float = EPS2D  # px^2; a pixel, which is a box, has 1/12
    filter_compensated: bool = False  # keep a Gaussian's light where the filter enlarges it

    # Model only what moves.
    freeze_background: bool = False  # after the static stage, Gaussians where nothing changes become a background
    moving_change: float = POINTS.limit  # standard deviation over time, in white, above which points move

    # Gaussians.
    initial_opacity: float = 0.5  # points from a plane sweep lie on surfaces; 0.1 suits sparse clouds
    initial_scale: float = 1.0  # x the mean distance of a point's 3 nearest ones, 3DGS's
    lr_means: float = 1.6e-4  # x scene scale, as 3DGS
    lr_means_last: float = 1.6e-5
    lr_scales: float = 1e-2
    lr_quats: float = 2e-3
    lr_opacities: float = 0.05  # of their logits
    lr_colors: float = 5e-3
    lr_last: float = 1.0  # of scales, rotations, opacities and colours at a stage's end, x their first
    average: float = 0.0  # share of a stage's steps, its last ones, whose parameters are averaged
    beta1: float = 0.9
    beta2: float = 0.99  # 1000 steps in all: 0.999 would average over the whole fit

    @property
    def pixel_filter(self) -> PixelFilter:
        """The filter's two numbers."""
        return PixelFilter(self.filter_variance, self.filter_compensated)

    def scaled(self, scale: float) -> TrainerSettings:
        """Return the same settings with the step counts multiplied by a budget's scale."""
        return replace(
            self,
            coarse_steps=max(1, round(self.coarse_steps * scale)),
            fine_steps=max(1, round(self.fine_steps * scale)),
            piece_steps=max(1, round(self.piece_steps * scale)),
        )
