"""The schedule of a fit: stages of steps, each on a part of the clip that opens up while the stage goes on.

Step counts are for 20 ms. A longer clip has `piece_steps` more for each further 20 ms, whatever the motion. It may be
fitted in pieces, each with Gaussians of its own: the middle one first, from the static stage; then, outwards, every
other one from where its neighbour ends. A motion without pieces fits the whole clip in one longer stage.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from spike4dgs.benchmark.errors import problem
from spike4dgs.method.settings import Settings, check_numbers
from spike4dgs.method.splat.types import EPS2D, PixelFilter
from spike4dgs.method.torch_state import seeded
from spike4dgs.method.training_views.changes import POINTS


@dataclass(frozen=True)
class TrainerSettings(Settings):
    """Steps, poses, and how Gaussians begin and learn (prefix `trainer`)."""

    # Steps. One step renders several views at one time, where 4DGS takes one image: a step of four views is 4 there.
    coarse_steps: int = 300  # static stage (4DGS: 3000 single images)
    fine_steps: int = 1200  # deforming stage (4DGS: 15000 single images)
    piece_steps: int = 800  # more of them for each further 20 ms of a long clip
    views_per_step: int = 4  # they share one time and one deformation; of 8 views only half as many steps fit the time
    ramp: float = 0.3  # share of the fine stage in which the times open up from the middle to the whole clip
    coarse_share: float = 0.2  # share of the middle 20 ms of the clip that a moving scene's coarse stage sees

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

    def __post_init__(self) -> None:
        wanted = {
            "coarse_share above 0, at most 1": (self.coarse_share, 0 < self.coarse_share <= 1),
            "beta1 from 0, below 1": (self.beta1, 0 <= self.beta1 < 1),
            "beta2 from 0, below 1": (self.beta2, 0 <= self.beta2 < 1),
            "initial_opacity between 0 and 1": (self.initial_opacity, 0 < self.initial_opacity < 1),
            "initial_scale above 0": (self.initial_scale, self.initial_scale > 0),
            "views_per_step of 1 or more": (self.views_per_step, self.views_per_step >= 1),
            "ramp from 0 to 1": (self.ramp, 0 <= self.ramp <= 1),
        }
        check_numbers("trainer", wanted)

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


GOLDEN = 0.6180339887498949  # multiples of it, modulo 1, cover an interval evenly at every length

RENEWED = (0.3, 0.5, 0.75)  # shares of a deforming stage: first when it sees its whole span

Interval = tuple[float, float]  # of the clip, which is [0, 1]


@dataclass(frozen=True)
class Stage:
    """A stretch of steps with its own optimiser and schedule."""

    first: int
    steps: int
    deforms: bool
    span: Interval = (0.0, 1.0)  # the part of the clip that the stage fits
    begin: Interval = (0.0, 1.0)  # the part of that which it sees at its first step
    piece: int = 0
    neighbour: int | None = None  # the piece that this one continues

    def fraction(self, step: int) -> float:
        """Return the position of a step within the stage, in [0, 1)."""
        return (step - self.first) / self.steps

    @property
    def renewals(self) -> tuple[int, ...]:
        """At which of the stage's steps means over time are corrected anew; nothing moves in a static one."""
        return tuple(round(share * self.steps) for share in RENEWED if self.deforms)

    def renewed_after(self, step: int) -> int:
        """Return the next step after one at which corrections are renewed, or the stage ends."""
        return self.first + min((r for r in self.renewals if self.first + r > step), default=self.steps)

    def within(self, t: float) -> float:
        """Return a time of the clip as a time of the stage's span, which is [0, 1]."""
        return (t - self.span[0]) / (self.span[1] - self.span[0])


def stages(
    settings: TrainerSettings, moves: bool, rests_first: bool = True, pieces: int = 1, parts: float = 1.0
) -> list[Stage]:
    """Return the static stage, followed by deforming ones where the motion model moves; or one that deforms throughout.

    A moving scene begins with the middle of the clip, which gives sharp canonical Gaussians. `pieces` is odd, and about
    as many as the clip has `parts` of 20 ms, or 1. Raises UserError where a background is to be frozen after a static
    stage that there is not.
    """
    s = settings
    share, middle = s.coarse_share / (pieces if pieces > 1 else parts), pieces // 2
    center = (0.5 - share / 2, 0.5 + share / 2)
    further = round((parts - 1) * s.piece_steps) if pieces == 1 else 0
    if not moves:
        return [Stage(0, s.coarse_steps + further, deforms=False)]
    if not rests_first:
        if s.freeze_background:
            expected = "trainer.freeze_background false, as the motion has no static stage"
            raise problem("settings", expected, "true", "leave it out, or choose another motion")
        return [Stage(0, s.coarse_steps + s.fine_steps + further, deforms=True, begin=center)]
    plan = [Stage(0, s.coarse_steps, deforms=False, span=center, begin=center)]
    for piece in sorted(range(pieces), key=lambda p: abs(p - middle)):
        first, low, high = plan[-1].first + plan[-1].steps, piece / pieces, (piece + 1) / pieces
        if piece == middle:
            plan.append(Stage(first, s.fine_steps + further, True, (low, high), center, piece))
            continue
        begin, neighbour = ((low, low + share), piece - 1) if piece > middle else ((high - share, high), piece + 1)
        plan.append(Stage(first, s.piece_steps, True, (low, high), begin, piece, neighbour))
    return plan


def choose_time(settings: TrainerSettings, stage: Stage, step: int, times: int) -> int:
    """Return the index of a step's time among `times`: in the stage's first interval, which opens up to its span.

    Motion is followed from known into unknown times. A static scene sees all times throughout.
    """
    opened = min(1.0, stage.fraction(step) / settings.ramp) if settings.ramp else 1.0
    low, high = (a + (b - a) * opened for a, b in zip(stage.begin, stage.span, strict=True))
    at = low + (high - low) * ((step * GOLDEN) % 1.0)
    return min(times - 1, int(at * times))


def choose_views(settings: TrainerSettings, step: int, count: int, seed: int) -> list[int]:
    """Return a step's views among `count`, ascending."""
    if settings.views_per_step >= count:
        return list(range(count))
    return sorted(torch.randperm(count, generator=seeded(seed, step))[: settings.views_per_step].tolist())
