"""The trainer's numbers, each with its reason. A recipe overrides them by name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

from spike4dgs.benchmark.errors import problem


@dataclass(frozen=True)
class TrainSettings:
    """Hyper-parameters of a fit. Learning rates are Adam's; `*_last` is reached log-linearly at a stage's end."""

    # Steps. One step renders several views at one time, where 4DGS takes one image: 1 step here is 4 there.
    coarse_steps: int = 300  # static stage (4DGS: 3000 single images)
    fine_steps: int = 1200  # deforming stage (4DGS: 14000 single images)
    piece_steps: int = 800  # the same of each further piece of a long clip, where the motion model has pieces
    views_per_step: int = 4  # they share one time and one deformation; of 8 views only half as many steps fit the time
    ramp: float = 0.3  # share of the fine stage in which the times open up from the middle to the whole clip

    # Times at which images are made from the spikes.
    time_spacing_ticks: int = 10  # 0.5 ms at 20 kHz: half a ground-truth interval
    edge_ticks: int = 10  # windows nearer to the clip's ends are cut, and their images belong to a later time
    max_times: int = 256  # bounds memory: 256 times x 8 views of 250x400 are 0.8 GB
    coarse_share: float = 0.2  # middle share of the clip (or its middle piece) that a moving scene's coarse stage sees
    flat_field: bool = False  # correct the images by each camera's calibrated gain n(x, y) and dark rate, if known

    # Poses of the training cameras.
    refine_poses: bool = False  # fit them too; for starts that estimated them
    pose_rate: float = 2e-4  # radians, and translations by the scene's scale: 0.05 px a step at 225 px
    pose_rate_last: float = 2e-6

    # Model only what moves.
    freeze_still: bool = False  # after the static stage, Gaussians where nothing changes become a background

    # Loss.
    ssim_weight: float = 0.2  # 3DGS's lambda; 4DGS publishes 0, which blurs

    # Gaussians.
    initial_opacity: float = 0.5  # points from a plane sweep lie on surfaces; 0.1 suits sparse clouds
    initial_scale: float = 1.0  # x the mean distance of a point's 3 nearest ones, 3DGS's
    means_rate: float = 1.6e-4  # x scene scale, as 3DGS
    means_rate_last: float = 1.6e-5
    scales_rate: float = 1e-2
    quats_rate: float = 2e-3
    logits_rate: float = 0.05
    colors_rate: float = 5e-3
    beta1: float = 0.9
    beta2: float = 0.99  # 1000 steps in all: 0.999 would average over the whole fit

    # Density control.
    refine_every: int = 100
    refine_until: float = 0.6  # share of a stage
    grow_gradient: float = 2e-4  # mean screen-space gradient (half-image units) above which a Gaussian is densified
    split_scale: float = 0.01  # x scene scale: larger ones are split, smaller ones cloned
    min_opacity: float = 0.005  # fainter ones are removed
    max_per_pixel: float = 0.8  # Gaussians per pixel of one view; 0.5 costs 0.6 dB and saves a fifth of the time
    max_moving_per_pixel: float = 0.4  # the same of those before a background, which is not counted
    max_gaussians: int = 1_000_000  # whatever the images' size; half as many before a background

    # Deformation.
    cell_px: float = 3.0  # finest spatial cell, in pixels of a view across the box
    levels: int = 2  # multires 1, 2
    cell_ticks: float = 16.0  # time cell
    features: int = 16  # per plane and level, 4DGS's dynerf preset
    mlp_width: int = 32  # 4DGS: 128; 32 takes 0.4 of the time of 64
    grid_rate: float = 1e-2
    grid_rate_last: float = 1e-3
    deformation_rate: float = 1e-3
    deformation_rate_last: float = 1e-4
    tv_weight: float = 2e-4  # the three weights of 4DGS's dynerf preset
    smooth_weight: float = 1e-3
    sparse_weight: float = 1e-4

    # Losses on spikes.
    spike_ticks: int = 40  # ticks of a recorded window, as many as TFP's has
    neuron_ticks: int = 256  # for which a neuron sees a rendered image: SpikeNeRF's; closed form, so they cost nothing
    phi_rate: float = 1e-2
    noise_rate: float = 1e-3
    noise_weight: float = 30.0  # of the noise embedding's mean square; with 0.1 it takes the images' edges: 7 dB lost

    # Spacetime Gaussians. Published rates in brackets, for 30,000 steps.
    static_life: float = 4.0  # of the clip: a Gaussian that fades by 1 % towards the clip's ends [1]
    moving_life: float = 0.3
    moving_change: float = 0.03  # standard deviation over time, in white, above which pixels count as moving (TFP's)
    moving_copies: int = 3  # times at which a moving point is laid down
    guided_rounds: int = 2  # of guided sampling, after the second and the following refinements
    times_rate: float = 1e-3  # [1e-4]
    lives_rate: float = 0.03  # [0.03]
    spins_rate: float = 1e-3  # [1e-4]
    paths_rate: float = 1.4e-3  # of `paths`, in scene scales a clip
    paths_rate_last: float = 1.4e-4
    features_rate: float = 5e-3  # [2.5e-3 and 1e-3]
    decoder_rate: float = 1e-3  # [1e-4]

    def scaled(self, scale: float) -> TrainSettings:
        """The same settings with the step counts multiplied by a budget's scale."""
        return replace(
            self,
            coarse_steps=max(1, round(self.coarse_steps * scale)),
            fine_steps=max(1, round(self.fine_steps * scale)),
            piece_steps=max(1, round(self.piece_steps * scale)),
        )


S = TypeVar("S")


def make_settings(overrides: Mapping[str, Any], where: str, defaults: S) -> S:
    """Settings with `overrides` by name. Raises UserError for an unknown name or a value of another type."""
    known = {f.name for f in fields(defaults)}  # type: ignore[arg-type]
    for name, value in overrides.items():
        if name not in known:
            raise problem(where, f"settings among {', '.join(sorted(known))}", repr(name), "correct the name")
        kind = type(getattr(defaults, name))
        if isinstance(value, bool) != (kind is bool) or not isinstance(value, (int, float) if kind is float else kind):
            raise problem(where, f"{name} as {kind.__name__}", repr(value), "correct the value")
    return replace(defaults, **overrides)  # type: ignore[type-var]
