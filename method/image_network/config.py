"""Sizes of the image network, and the numbers of its training."""

from __future__ import annotations

from dataclasses import dataclass, replace

from spike4dgs.method.gaussians.optimizer import WarmCosine


@dataclass(frozen=True)
class ImageConfig:
    """Widths in channels."""

    name: str = "images"
    widths: tuple[int, int, int] = (32, 64, 96)  # at the image's size, at half, and at a quarter
    deepest: int = 2  # residual blocks at a quarter of the size
    without: str = ""  # for ablations: a name of `INPUTS` that the network does not see, or `MOVING_LOSS`


INPUTS = {  # channels of what the network sees beside `adaptive`'s image; after those of `inputs` come the spikes
    "error-bar": slice(1, 2),
    "windows": slice(2, 4),
    "beside": slice(4, 6),
    "sensor": slice(6, 8),
    "spikes": slice(8, None),
}
MOVING_LOSS = "moving-loss"  # the second term of the loss, of where things move

IMAGES = ImageConfig()
TINY = ImageConfig("images-tiny", (4, 6, 8), 1)  # for tests
ABLATIONS = tuple(replace(IMAGES, name=f"images-without-{part}", without=part) for part in (*INPUTS, MOVING_LOSS))
CONFIGS = {config.name: config for config in (IMAGES, TINY, *ABLATIONS)}


@dataclass(frozen=True)
class ImageTraining:
    """Hyper-parameters."""

    steps: int = 12_000
    bursts: int = 4  # of a step
    views: int = 2  # of a burst, each a clip of its own
    instants: int = 4  # of a clip
    crop: tuple[int, int] = (64, 96)  # height and width in px; less where images are smaller
    moving: float = 0.75  # share of the clips in which something moves
    # Share of the clips in half of the light to all of it; the others have a sixteenth to all, in stops. So 62.5 % of
    # all clips have at least half.
    well_lit: float = 0.5
    lr: float = 1e-3  # Adam's, after the warm-up; it falls to 0 with the cosine
    warm_up: int = 300  # steps
    average: float = 0.998  # of the weights that are used: the mean over about 500 steps
    unknown_sensors: float = 0.3  # of the bursts
    longest: int = 600  # ticks of a clip

    def learning_rate(self, step: int) -> float:
        """Return Adam's learning rate at a step."""
        return WarmCosine(self.lr, self.warm_up, self.steps).at(step)
