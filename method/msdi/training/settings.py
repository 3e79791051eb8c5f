"""The numbers of MSDI's training, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass

from spike4dgs.method.gaussians.optimizer import WarmCosine

PUBLISHED: dict[str, float] = {"lr_points": 1e-4}  # the publication states no more of its training than the losses


@dataclass(frozen=True)
class TrainingSettings:
    """Hyper-parameters."""

    steps: int = 20_000
    views: int = 8  # of a step: samples times views of a sample
    most_views: int = 8  # of a sample; at least two
    lr_points: float = PUBLISHED["lr_points"]  # Adam's, after the warm-up; it falls to 0 with the cosine
    lr_images: float = 1e-3  # the same of extractor and generator, which are small
    warm_up: int = 500  # steps
    unknown_share: float = 0.2  # of the steps, without intrinsics
    raw_share: float = 0.2  # of the steps, without sensors
    score_every: int = 1000  # steps

    def learning_rates(self, step: int) -> dict[str, float]:
        """Return Adam's learning rates of the two groups at a step."""
        peaks = {"images": self.lr_images, "points": self.lr_points}
        return {name: WarmCosine(peak, self.warm_up, self.steps).at(step) for name, peak in peaks.items()}
