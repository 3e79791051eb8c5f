"""Training in float32 against a twin in float64, and from seed to seed."""

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from toy_fits import MOTIONS, WORLD, ground, method, request, silent

from spike4dgs.method.gaussians.density import DensitySettings
from spike4dgs.method.gaussians.parameters import Gaussians, from_points
from spike4dgs.method.schedule import TrainerSettings
from spike4dgs.method.splat import RenderOutput, Splats, Views, render
from spike4dgs.method.splat.ssim import ssim_reference
from spike4dgs.method.supervision.base import Render, Sample
from spike4dgs.method.supervision.pixel import Pixel
from spike4dgs.method.torch_state import seeded
from spike4dgs.method.trainer import Trainer

SMALL = replace(WORLD, width=48, height=30)  # the twin takes as long as all pixels times all Gaussians
SETTINGS = TrainerSettings(coarse_steps=15, fine_steps=35, views_per_step=2)


class PixelTwin(Pixel):
    """The pixel loss in the precision of its inputs."""

    def forward(self, render: Render, sample: Sample) -> Tensor:
        image, w = render(sample.t), self.settings.ssim_weight
        return (1 - w) * (image - sample.images).abs().mean() + w * (1 - ssim_reference(image, sample.images))


class TrainerTwin(Trainer):
    """Renders with the slow renderer, which is float64 throughout."""

    def _image(self, splats: Splats, chosen: Sequence[int], views: Views) -> RenderOutput:
        return render(splats, views, backend="reference")


def fifty_steps(motion: str, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Images [3, 2, H, W] near the clip's ends and at its middle, before and after 50 steps of a trainer."""
    start, extent, training_images = ground(SMALL)
    first = from_points(start.points[::54], start.values[::54], opacity=0.5)
    model = MOTIONS[motion](extent, MOTIONS[motion].defaults, seeded(0, -1))
    gaussians = model.initialize(first, training_images)
    twin = dtype == torch.float64
    if twin:
        gaussians = Gaussians.from_tensors({k: v.double() for k, v in gaussians.tensors().items()})
        views = training_images.views
        views = replace(views, w2c=views.w2c.double(), K=views.K.double())
        training_images = replace(training_images, views=views, images=training_images.images.double())
        model = model.double()
    loss, density = (PixelTwin if twin else Pixel)(Pixel.defaults, SMALL.training), DensitySettings()
    kind, size = TrainerTwin if twin else Trainer, {"scale": extent.scale, "seed": 3}
    fit = kind(training_images, gaussians, model, loss, SETTINGS, density, **size)
    assert fit.gaussians.means.dtype == dtype

    def rendered() -> Tensor:
        with torch.no_grad():
            splats = [model.splats(fit.gaussians, t) for t in (0.1, 0.5, 0.9)]
            return torch.stack([fit._image(g, (), training_images.views.some([0, 7])).image[..., 0] for g in splats])

    before = rendered()
    fit.run(silent)
    return before, rendered()


@pytest.mark.parametrize("motion", ["paths", "spacetime-lite"])
def test_fifty_steps_in_float32_are_those_in_float64(motion: str) -> None:
    """To 3e-4 of white in the mean: both follow the sign of differences, which rounding flips here and there.

    Where two Gaussians lie at almost one depth, rounding decides which is in front: a few pixels may differ by more.
    """
    (_, single), (before, double) = (fifty_steps(motion, dtype) for dtype in (torch.float32, torch.float64))
    error = (single - double).abs()
    assert error.mean() < 3e-4 and (error > 0.02).double().mean() < 1e-3
    assert (double - before).abs().mean() > 100 * error.mean()


def test_three_seeds_agree() -> None:
    """Seeds have a standard deviation of 0.1 dB after so few steps."""
    short = method("paths", {"trainer.coarse_steps": 20, "trainer.fine_steps": 30, "trainer.views_per_step": 2})
    fits = [short.fit(WORLD.training, request(seed)) for seed in range(3)]
    scores = [WORLD.psnr(fit, moving=False) for fit in fits]
    assert max(scores) - min(scores) < 0.6
