"""Losses and networks: SSIM's fused kernel, HexPlane's lookup and MSDI's image network, against torch in float64."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from spike4dgs.benchmark.metrics.ssim_window import SSIM_SIGMA
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.image_network.inputs import image_inputs
from spike4dgs.method.image_network.network import ImageNetwork, rate_of
from spike4dgs.method.image_network.weights import WEIGHTS, load_image_network
from spike4dgs.method.motion.hexplane import sample_level
from spike4dgs.method.motion.hexplane_cpu import sample_levels
from spike4dgs.method.msdi.network import has_bfloat16
from spike4dgs.method.splat.ssim import C1, C2, RADIUS, ssim, ssim_reference
from spike4dgs.method.torch_state import one_torch_thread
from spike4dgs.studies.kit.measurement import TIMES, Column, Request, Series, compared, max_rms, measurement

GROUP = "Losses and networks"
_TICKS = 100  # of the streams that images are made of


def differentiate(function: Callable[[Tensor, Tensor], Tensor], image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Return the value of a loss and its gradient for the image."""
    leaf = image.detach().clone().requires_grad_()
    value = function(leaf, target)
    return value.detach(), torch.autograd.grad(value, leaf)[0]


def ssim_square(image: Tensor, target: Tensor) -> Tensor:
    """Return SSIM as training code usually writes it: five convolutions with one 11x11 window."""
    at = torch.arange(-RADIUS, RADIUS + 1, dtype=image.dtype)
    line = torch.exp(-0.5 * (at / SSIM_SIGMA) ** 2)
    window = torch.outer(line, line) / line.sum() ** 2

    def blur(x: Tensor) -> Tensor:
        return functional.conv2d(x[:, None], window[None, None], padding=RADIUS)[:, 0]

    m1, m2 = blur(image), blur(target)
    s1, s2, s12 = blur(image**2) - m1**2, blur(target**2) - m2**2, blur(image * target) - m1 * m2
    return ((2 * m1 * m2 + C1) * (2 * s12 + C2) / ((m1**2 + m2**2 + C1) * (s1 + s2 + C2))).mean()


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


@measurement(
    "ssim",
    GROUP,
    "SSIM and its gradient",
    (*TIMES, Column("value", "error of the value"), Column("gradient", "relative L2 error of the gradient")),
    ("value", "gradient"),
)
def fused_ssim(request: Request) -> Iterator[Series]:
    """One fused pass in float32 with a separable 11x11 window.

    Torch in float64 with the same window.

    A loss needs three digits of its value and of its gradient, and has seven on images. Where variances cancel float32
    loses them: some percent of the gradient of two flat images, which is almost zero, and all of it for noise of 0.001
    at radiance 50. Torch in float32 loses as much.

    tests/method/splat/test_ssim.py
    """
    size = request.pick((24, 40), (125, 200), (250, 400))
    functions = {
        "float64, separable": (ssim_reference, torch.float64),
        "torch, 11x11 window": (ssim_square, torch.float32),
        "torch, separable": (ssim_reference, torch.float32),
        "fused kernel": (ssim, torch.float32),
    }

    def errors(found: tuple[Tensor, Tensor], exact: tuple[Tensor, Tensor]) -> dict[str, float]:
        off = (found[1].double() - exact[1]).norm() / exact[1].norm().clamp(min=1e-300)
        return {"value": float((found[0].double() - exact[0]).abs()), "gradient": float(off)}

    for name, pair in images(request.seed, *size).items():
        calls = {k: partial(differentiate, f, *(i.to(dtype) for i in pair)) for k, (f, dtype) in functions.items()}
        with one_torch_thread():
            yield compared(name, calls, errors, request.pick(1, 7, 21), "fused kernel")


@measurement(
    "msdi",
    GROUP,
    "MSDI: numbers of its image network",
    (*TIMES, Column("rms", "RMS error, spikes per tick"), Column("max", "largest error, spikes per tick")),
    ("rms",),
    least="quick",  # loading the network takes longer than the others of tiny
)
def msdi_images(request: Request) -> Iterator[Series]:
    """Weights are kept as half floats; convolutions are bfloat16 where the processor multiplies it.

    The same weights in float64.

    Convolutions in bfloat16 change an image less than one spike in a window does. On processors without its
    instructions it is slower, and float32 is chosen.

    tests/method/image_network
    """
    network = load_image_network(WEIGHTS.in_use().path, "cpu")
    height, width = request.pick((16, 24), (40, 64), (125, 200))
    rng = np.random.default_rng(request.seed)
    rates = {"random light": rng.random((height, width)), "dark": np.full((height, width), 0.01)}
    exact = deepcopy(network).double()
    chosen = "convolutions in bfloat16" if has_bfloat16(torch.device("cpu")) else "float32"
    for name, rate in rates.items():
        spikes = rng.random((_TICKS, height, width)) < 0.6 * rate
        found = image_inputs(SpikeStream(pack(spikes), width, height, 20_000.0), _TICKS // 2)
        channels, seen = (torch.from_numpy(a)[None] for a in (found.channels, found.spikes))
        calls = {
            "float64": partial(_rates, exact, channels.double(), seen, found.unit),
            "float32": partial(_rates, network, channels, seen, found.unit),
            "convolutions in bfloat16": partial(_rates, network, channels, seen, found.unit, half=True),
        }
        with torch.inference_mode(), one_torch_thread():
            yield compared(f"{name}, {width}x{height}", calls, max_rms, request.pick(1, 2, 5), chosen)


def _rates(network: ImageNetwork, channels: Tensor, spikes: Tensor, unit: float, *, half: bool = False) -> Tensor:
    with torch.autocast("cpu", torch.bfloat16, enabled=half):
        return rate_of(network(channels, spikes), unit)


@measurement(
    "hexplane-lookup",
    GROUP,
    "HexPlane: lookup and its gradient",
    (*TIMES, Column("max", "largest error of a feature"), Column("gradient", "relative L2 error of the slope")),
    ("max", "gradient"),
)
def lookup(request: Request) -> Iterator[Series]:
    """Numba kernels in float32; the time planes are lines, as a step has one time.

    Torch's `grid_sample` in float64.

    Features keep six digits. On the border of a cell the slope has two values, and either is a gradient.

    tests/method/motion/test_hexplane.py
    """
    n, sides, features = request.pick((50, (8, 4), 4), (20_000, (33, 67), 16), (50_000, (67, 133), 16))
    g = torch.Generator().manual_seed(request.seed)
    space = [torch.rand(3, r, r, features, generator=g, dtype=torch.float64) for r in sides]
    lines = [torch.rand(3, r, features, generator=g, dtype=torch.float64) for r in sides]
    inside = torch.rand(n, 3, generator=g, dtype=torch.float64)
    places = {
        "inside the box": inside,
        "outside of it": 3 * inside - 1,
        "on the cells' borders": (inside * 8).round() / 8,
    }

    def features_and_gradient(sample: Callable[..., Tensor], dtype: torch.dtype, at: Tensor) -> Any:
        unit = at.to(dtype).requires_grad_()
        out = sample(unit, [x.to(dtype) for x in lines], [x.to(dtype) for x in space])
        return out.detach(), torch.autograd.grad(out.sum(), unit)[0]

    def plain(unit: Tensor, lines: list[Tensor], space: list[Tensor]) -> Tensor:
        return torch.cat([sample_level(unit, s, x) for s, x in zip(space, lines, strict=True)], -1)

    def errors(found: Any, exact: Any) -> dict[str, float]:
        slope = (found[1] - exact[1]).norm() / exact[1].norm()
        return {"max": float((found[0] - exact[0]).abs().max()), "gradient": float(slope)}

    for name, at in places.items():
        calls = {
            "torch, float64": partial(features_and_gradient, plain, torch.float64, at),
            "torch, float32": partial(features_and_gradient, plain, torch.float32, at),
            "kernels": partial(features_and_gradient, sample_levels, torch.float32, at),
        }
        with one_torch_thread():
            yield compared(f"{n} points {name}", calls, errors, request.pick(1, 5, 9), "kernels")
