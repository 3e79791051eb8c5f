"""The numbers of MSDI's training, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass

from spike4dgs.method.gaussians.optimizer import WarmCosine

PUBLISHED: dict[str, float] = {"rate": 1e-4}  # all that the publication says of its training, besides the losses


@dataclass(frozen=True)
class TrainingSettings:
    """Hyper-parameters."""

    steps: int = 20_000
    views: int = 8  # of a step: samples times views of a sample
    most_views: int = 8  # of a sample; at least two
    rate: float = PUBLISHED["rate"]  # Adam's, after the warm-up; it falls to nothing with the cosine
    image_rate: float = 1e-3  # the same of extractor and generator, which are small
    warm_up: int = 500  # steps
    unknown_share: float = 0.2  # of the steps do not tell the intrinsics
    raw_share: float = 0.2  # of the steps do not tell the sensors
    score_every: int = 1000  # steps

    def rates(self, step: int) -> dict[str, float]:
        """Adam's learning rates of the two groups at a step."""
        peaks = {"images": self.image_rate, "points": self.rate}
        return {name: WarmCosine(peak, self.warm_up, self.steps).at(step) for name, peak in peaks.items()}
