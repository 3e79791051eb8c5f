"""The training loss SSIM: the fused kernel against torch in float32 and float64."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor

from spike4dgs.method.splat.ssim import ssim, ssim_reference
from spike4dgs.method.torch_state import one_torch_thread
from spike4dgs.studies.speed.splat import differentiate, ssim_square
from spike4dgs.studies.speed.timing import by_turns_ms
from spike4dgs.studies.speed_error.measurement import (
    MEDIAN_MS,
    MS,
    Column,
    Measurement,
    Point,
    Request,
    Series,
)


def images(seed: int, height: int, width: int) -> dict[str, tuple[Tensor, Tensor]]:
    """Return pairs of images [1, H, W] in float32, by name: random ones, and those where SSIM cancels most."""
    g = torch.Generator().manual_seed(seed)

    def noise() -> Tensor:
        return torch.rand(1, height, width, generator=g)

    bright = 50 + 1e-3 * noise()
    flat = torch.full((1, height, width), 0.5)
    return {
        "random images": (noise(), noise()),
        "two flat images": (flat, flat + 1e-4),
        "radiance 50 with noise of 0.001": (bright, bright + 1e-3 * noise()),
        "almost black": (1e-5 * noise(), 1e-5 * noise()),
    }


def _ssim(request: Request) -> Iterator[Series]:
    size = request.pick((24, 40), (125, 200), (250, 400))
    functions = {
        "float64, separable": (ssim_reference, torch.float64),
        "torch, 11x11 window": (ssim_square, torch.float32),
        "torch, separable": (ssim_reference, torch.float32),
        "fused kernel": (ssim, torch.float32),
    }
    for name, pair in images(request.seed, *size).items():
        calls = [partial(differentiate, f, *(i.to(dtype) for i in pair)) for f, dtype in functions.values()]
        with one_torch_thread():
            times = by_turns_ms(calls, request.pick(1, 7, 21))
            found = [call() for call in calls]
        points = []
        for title, (best, median), (value, gradient) in zip(functions, times, found, strict=True):
            error = float((value.double() - found[0][0]).abs())
            off = float((gradient.double() - found[0][1]).norm() / found[0][1].norm().clamp(min=1e-300))
            role = {"float64, separable": "exact", "fused kernel": "chosen"}.get(title, "")
            values = {"ms": best, "median_ms": median, "value": error, "gradient": off}
            points.append(Point(title, values, role))  # type: ignore[arg-type]
        yield Series(name, tuple(points))


SSIM = Measurement(
    id="ssim",
    group="Losses and networks",
    title="SSIM and its gradient",
    approximation="One fused pass in float32 with a separable 11x11 window.",
    exact="Torch in float64 with the same window.",
    reason="A loss needs three digits of its value and of its gradient, and has seven on images. Where variances "
    "cancel float32 loses them: some percent of the gradient of two flat images, which is almost zero, and all of it "
    "for noise of 0.001 at radiance 50. Torch in float32 loses as much.",
    columns=(
        MS,
        MEDIAN_MS,
        Column("value", "error of the value"),
        Column("gradient", "relative L2 error of the gradient"),
    ),
    x="ms",
    y=("value", "gradient"),
    run=_ssim,
    seconds={"tiny": 3, "quick": 10, "whole": 40},
    held_by="tests/method/splat/test_ssim.py",
)
