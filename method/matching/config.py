"""Sizes of the matching network, and the numbers of its training."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MatcherConfig:
    """Widths in channels; coarse cells are 4 px wide, fine ones 2 px."""

    name: str = "bottleneck"
    widths: tuple[int, int, int, int] = (16, 32, 64, 96)  # at the image's size, and at half, a quarter, an eighth
    fine: int = 32  # of the fine features
    hidden: int = 64  # of the layer that refines a match
    reach: int = 3  # fine cells to each side among which a match is refined: a coarse cell, and half of its neighbours


BOTTLENECK = MatcherConfig()
TINY = MatcherConfig("bottleneck-tiny", (4, 6, 8, 8), 6, 8)  # for tests
CONFIGS = {config.name: config for config in (BOTTLENECK, TINY)}


@dataclass(frozen=True)
class MatcherTraining:
    """Hyper-parameters."""

    samples: int = 2  # of a step, each from another burst
    views: int = 3  # of a sample; all pairs are matched
    lr: float = 1e-3  # Adam's, after the warm-up
    warm_up: int = 200  # steps
    hold: int = 1000  # steps, after which the rate falls with the root of the step: a schedule without an end
    average: float = 0.998  # of the weights that are used: the mean over about 500 steps, in place of a rate's end
    jitter: float = 0.3  # share of the matches that are refined from a neighbouring cell
    unknown_sensors: float = 0.3  # of the samples
    longest: int = 400  # ticks of a window, where nothing moves

    def learning_rate(self, step: int, warm_steps: int) -> float:
        """Return Adam's learning rate at a step; Adam itself has seen `warm_steps`."""
        return self.lr * min(1.0, (warm_steps + 1) / self.warm_up) * (self.hold / max(step, self.hold)) ** 0.5
