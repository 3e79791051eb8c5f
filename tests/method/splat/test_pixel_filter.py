"""The pixel filter against the integral over a pixel's square, which a sensor and the ground truth take."""

import math

import pytest
import torch

from spike4dgs.method.splat import PixelFilter, Splats, Views, render

SIZE, FOCAL, DEPTH = 24, 20.0, 5.0
PIXEL = PixelFilter(1 / 12, compensated=True)


def view() -> Views:
    K = torch.tensor([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]], dtype=torch.float64)
    return Views(torch.eye(4, dtype=torch.float64)[None], K[None], SIZE, SIZE)


def one(sigma_px: float, u: float, v: float, opacity: float) -> Splats:
    """A round Gaussian of a standard deviation in pixels, off the image's middle by (u, v) px."""
    at = torch.tensor([[u * DEPTH / FOCAL, v * DEPTH / FOCAL, DEPTH]], dtype=torch.float64)
    scales = torch.full((1, 3), sigma_px * DEPTH / FOCAL, dtype=torch.float64)
    quats = torch.tensor([[1.0, 0, 0, 0]], dtype=torch.float64)
    return Splats(at, quats, scales, torch.tensor([opacity], dtype=torch.float64), torch.ones(1, 1).double())


def over_squares(sigma_px: float, u: float, v: float, opacity: float) -> torch.Tensor:
    """The mean of o exp(-r^2 / 2 sigma^2) over each pixel, in closed form."""
    edges = torch.arange(SIZE + 1, dtype=torch.float64) - SIZE / 2

    def along(center: float) -> torch.Tensor:
        primitive = torch.erf((edges - center) / (sigma_px * math.sqrt(2)))
        return sigma_px * math.sqrt(math.pi / 2) * primitive.diff()

    return opacity * along(v)[:, None] * along(u)[None]


def image(splats: Splats, f: PixelFilter, backend: str) -> torch.Tensor:
    out = render(splats, view(), f, backend=backend)  # type: ignore[arg-type]
    return out.image[0, ..., 0].double()


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@pytest.mark.parametrize(("sigma_px", "most"), [(0.5, 0.02), (0.8, 0.005), (2.0, 0.001)])
def test_a_twelfth_compensated_is_the_mean_over_a_pixel(backend: str, sigma_px: float, most: float) -> None:
    """A box of one pixel has the variance 1/12; its shape matters below half a pixel only."""
    for u, v in ((0.0, 0.0), (0.5, 0.0), (0.3, -0.2)):
        truth = over_squares(sigma_px, u, v, 0.9)
        found = image(one(sigma_px, u, v, 0.9), PIXEL, backend)
        shown = truth > 0.02  # what is fainter than 1/255 is left out
        assert float((found - truth)[shown].abs().max()) < 0.9 * most + 1 / 255 * (sigma_px < 0.6)
        customary = image(one(sigma_px, u, v, 0.9), PixelFilter(), backend)
        assert float((customary - truth)[shown].abs().mean()) > 4 * float((found - truth)[shown].abs().mean())


@pytest.mark.parametrize("variance", [1 / 12, 0.3, 1.0])
def test_a_compensated_filter_keeps_the_light(variance: float) -> None:
    """The sum over the image is 2 pi sigma^2 o, whatever the filter; without compensation it grows with the filter."""
    splats, expected = one(1.0, 0.1, 0.2, 0.8), 2 * math.pi * 0.8
    kept = float(image(splats, PixelFilter(variance, True), "reference").sum())
    grown = float(image(splats, PixelFilter(variance), "reference").sum())
    assert kept == pytest.approx(expected, rel=0.03)  # the tails below 1/255 are missing
    assert grown == pytest.approx(expected * (1 + variance), rel=0.03)
