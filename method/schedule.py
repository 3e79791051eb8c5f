"""The schedule of a fit: stages of steps, each on a part of the clip that opens up while the stage goes on.

A long clip may be fitted in pieces, each with Gaussians of its own: the middle one first, from the static stage; then,
outwards, every other one from where its neighbour ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from spike4dgs.method.torch_state import seeded
from spike4dgs.method.trainer_settings import TrainerSettings

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


def stages(settings: TrainerSettings, moves: bool, rests_first: bool = True, pieces: int = 1) -> list[Stage]:
    """Return the static stage, followed by deforming ones where the motion model moves; or one that deforms throughout.

    A moving scene begins with the middle of the clip, which gives sharp canonical Gaussians. `pieces` is odd.
    """
    s = settings
    share, middle = s.coarse_share / pieces, pieces // 2
    center = (0.5 - share / 2, 0.5 + share / 2)
    if not moves:
        return [Stage(0, s.coarse_steps, deforms=False)]
    if not rests_first:
        return [Stage(0, s.coarse_steps + s.fine_steps, deforms=True, begin=center)]
    plan = [Stage(0, s.coarse_steps, deforms=False, span=center, begin=center)]
    for piece in sorted(range(pieces), key=lambda p: abs(p - middle)):
        first, low, high = plan[-1].first + plan[-1].steps, piece / pieces, (piece + 1) / pieces
        if piece == middle:
            plan.append(Stage(first, s.fine_steps, True, (low, high), center, piece))
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
