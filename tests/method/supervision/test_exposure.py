"""The supervision `exposure` against closed forms: light that is linear or cubic in time, and images of instants."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from toy_world import ToyWorld

from spike4dgs.method.observations.training_images import Spans
from spike4dgs.method.supervision.base import Sample
from spike4dgs.method.supervision.exposure import Exposure
from spike4dgs.method.supervision.pixel import Pixel, PixelSettings

WORLD, TICKS, TICK = ToyWorld(width=16, height=12, n_ticks=100, travel=0.1), 100, 40
SHAPE = (2, 12, 16)


def polynomial(*coefficients: float) -> Tensor:
    """Polynomials in ticks from TICK, [powers, V, H, W], another at each pixel."""
    texture = torch.rand(SHAPE, generator=torch.Generator().manual_seed(3), dtype=torch.float64) + 0.5
    return torch.stack([c * texture for c in coefficients])


def light(p: Tensor, t: float) -> Tensor:
    ticks = t * TICKS - TICK
    return torch.stack([c * ticks**k for k, c in enumerate(p)]).sum(0)


def mean(p: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """The exact mean over [a, b], ticks from TICK."""
    return torch.stack([c * (b ** (k + 1) - a ** (k + 1)) / (k + 1) for k, c in enumerate(p)]).sum(0) / (b - a)


def loss(p: Tensor, image: Tensor, spans: Tensor | None, half: float = 10.0) -> float:
    over = None if spans is None else Spans(spans, half, TICKS)
    sample = Sample(TICK / TICKS, TICK, (0, 1), image, 0, over)
    supervision = Exposure(PixelSettings(ssim_weight=0.0), WORLD.training)
    return float(supervision(lambda t: light(p, t), sample))


def test_linear_light_is_met_over_any_span_between_the_points() -> None:
    p, generator = polynomial(0.5, 0.01), torch.Generator().manual_seed(0)
    a = -10 + 4 * torch.rand(SHAPE, generator=generator, dtype=torch.float64)
    b = 10 - 4 * torch.rand(SHAPE, generator=generator, dtype=torch.float64)
    assert loss(p, mean(p, a, b), torch.stack([a, b], 1)) < 1e-8
    assert loss(p, light(p, TICK / TICKS), torch.stack([a, b], 1)) > 1e-3, "an instant is another image"


@pytest.mark.parametrize("half", [5.0, 10.0])
def test_cubic_light_is_met_over_the_whole_span(half: float) -> None:
    p, b = polynomial(0.5, 0.01, -2e-3, 1e-4), torch.full(SHAPE, half, dtype=torch.float64)
    assert loss(p, mean(p, -b, b), torch.stack([-b, b], 1), half) < 1e-8


def test_images_of_instants_are_compared_as_pixel_does() -> None:
    p, image = polynomial(0.5, 0.01), torch.rand(SHAPE, dtype=torch.float64)
    sample = Sample(TICK / TICKS, TICK, (0, 1), image, 0)
    expected = Pixel(PixelSettings(ssim_weight=0.0), WORLD.training)(lambda t: light(p, t), sample)
    assert loss(p, image, None) == pytest.approx(float(expected))
