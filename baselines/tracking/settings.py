"""The numbers of the motion `tracking`, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass, replace

from spike4dgs.method.settings import Settings


@dataclass(frozen=True)
class TrackingSettings(Settings):
    """Steps, loss and learning rates (prefix `motion`). One step renders several views at one time.

    The published 10,000 and 2,000 steps of one image are 200,000 images for a clip of 100 times. Here a fit has the
    time of 4DGS: things move by about a pixel between two times, and a few steps follow that. At the first time the
    trainer's and the density's defaults hold.
    """

    first_steps: int = 400
    later_steps: int = 40  # at each further time
    first_move: float = 3.0  # x later_steps at the second time, whose velocity is not known yet
    views_per_step: int = 4

    start: float = 0.5  # where in the clip the first time is: 0 at its beginning, as published, 1 at its end
    clean_background: bool = True  # pixels that never change show their mean over the clip, without the spikes' noise
    margin_px: int = 8  # around what moves, more than half a window of SSIM

    # Loss; the weights are the publication's.
    image_weight: float = 1.0
    silhouette_weight: float = 3.0
    rigidity_weight: float = 4.0
    rotation_weight: float = 4.0
    isometry_weight: float = 2.0
    background_weight: float = 20.0
    color_weight: float = 0.01
    neighbours: int = 20
    freeze_background: bool = True

    # Adam at the further times, from the first to the last step of each; the publication's are constant.
    lr_means: float = 1.2e-3  # x scene scale (1.6e-4 in 2,000 steps)
    lr_means_last: float = 4e-5
    lr_quats: float = 2e-3  # (1e-3)
    lr_colors: float = 2.5e-3  # as published; slower, colours follow wheels and highlights too late
    lr_colors_last: float = 5e-4
    beta1: float = 0.9
    beta2: float = 0.99  # (0.999, which would average over far more steps than a time has)

    def scaled(self, scale: float) -> TrackingSettings:
        """Return the same settings with the step counts multiplied by a budget's scale."""
        first, later = (max(1, round(steps * scale)) for steps in (self.first_steps, self.later_steps))
        return replace(self, first_steps=first, later_steps=later)


PUBLISHED = {"motion.first_steps": 2500, "motion.later_steps": 500}  # 10,000 and 2,000 single images in steps of four
