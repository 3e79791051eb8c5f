"""Hard inputs of the losses and the motion lookup, each beside a float64 twin."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hard_case import HardCase
from numpy.typing import NDArray
from torch import Tensor

from spike4dgs.method.motion.coherence import incoherence, incoherence_reference, neighbours
from spike4dgs.method.motion.hexplane import sample_level
from spike4dgs.method.motion.hexplane_cpu import sample_levels
from spike4dgs.method.splat import Views
from spike4dgs.method.splat.ssim import ssim, ssim_reference
from spike4dgs.method.supervision.spike import encode

Float64 = NDArray[np.float64]
_SSIM_PAIRS: dict[str, tuple[str, Callable[[torch.Generator], tuple[Tensor, Tensor]]]] = {
    "black": ("black against black", lambda g: (torch.zeros(1, 30, 30), torch.zeros(1, 30, 30))),
    "flat": ("0.7 everywhere, twice: variances cancel", lambda g: (_flat(0.7), _flat(0.7))),
    "overexposed": ("20 everywhere against noise in 0..1", lambda g: (_flat(20.0), torch.rand(1, 30, 30, generator=g))),
    "negative": ("an image against its negative", lambda g: (x := torch.rand(2, 25, 31, generator=g), 1 - x)),
    "diagonals": ("crossing diagonals", lambda g: (torch.eye(40)[None], torch.eye(40).flip(0)[None])),
    "one-pixel": ("1x1 pixels", lambda g: (torch.rand(3, 1, 1, generator=g), torch.rand(3, 1, 1, generator=g))),
}


def _flat(level: float) -> Tensor:
    return torch.full((1, 30, 30), level)


@pytest.mark.hard_case(twin="torch convolutions, float64", tolerance=2e-4)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=pytest.mark.hard_case(asked=f"SSIM of training and its gradient: {p[0]}"))
        for n, p in _SSIM_PAIRS.items()
    ],
)
def test_ssim(hard_case: HardCase, name: str) -> None:
    a, b = _SSIM_PAIRS[name][1](torch.Generator().manual_seed(hard_case.seed))
    fast, slow = a.clone().requires_grad_(), a.double().requires_grad_()
    values = ssim(fast, b), ssim_reference(slow, b.double())
    for value in values:
        value.backward()
    hard_case.close(*(v.detach().numpy() for v in values), "value")
    hard_case.close(fast.grad, slow.grad, "gradient")
    # Gradients of ordinary images this size have norms around 0.03; where the truth is 0, float32 leaves 1e-5.
    assert (fast.grad - slow.grad).norm() <= 2e-2 * slow.grad.norm() + 1e-5


@pytest.mark.hard_case(
    asked="slope of the compared scale (rate + 1/256)^(1/2.2) at a rate of 0",
    twin="the derivative in closed form, float64",
    unit="relative",
    tolerance=1e-5,
)
def test_dark_rate(hard_case: HardCase) -> None:
    rate = torch.zeros(3, requires_grad=True)
    encode(rate).sum().backward()
    hard_case.close(rate.grad, np.full(3, (1 / 2.2) * (1 / 256) ** (1 / 2.2 - 1)), relative=True)


@pytest.mark.hard_case(
    asked="lookups on cell borders, at the box's corners and 10,000 boxes outside",
    twin="bilinear lookups by torch, float64",
    unit="relative L2",
    tolerance=2e-5,
)
def test_hexplane(hard_case: HardCase) -> None:
    g = torch.Generator().manual_seed(hard_case.seed)
    steps = torch.tensor([-1e4, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1e4])
    unit = torch.cartesian_prod(steps, steps, steps)  # a plane of 5x5 has its values at multiples of 1/4
    space, lines = torch.randn(3, 5, 5, 4, generator=g), torch.randn(3, 5, 4, generator=g)
    weight = torch.randn(len(unit), 4, generator=g)
    # No gradient of the points: on a border between cells their slope is that of either side.
    results = []
    for fast in (True, False):
        leaves = [x.clone().requires_grad_() for x in (unit, space, lines)]
        out = (
            sample_levels(leaves[0], [leaves[2]], [leaves[1]]) if fast else sample_level(*(x.double() for x in leaves))
        )
        (out * weight).sum().backward()
        outside = ((unit <= 0) | (unit >= 1)) & (leaves[0].grad != 0)
        assert not (fast and outside.any()), "the border has no slope"
        results.append([out.detach(), *(x.grad for x in leaves[1:])])
    names = ("features", "gradient of planes", "gradient of lines")
    for name, fast, slow in zip(names, *results, strict=True):
        hard_case.close(fast, slow, name, relative=True)


@pytest.mark.hard_case(
    asked="pulls on paths that are equal, 1e-6 m apart or 1 km; half of the points coincide",
    twin="plain torch, float64",
    unit="of the largest",
    tolerance=1e-4,
)
def test_coherence(hard_case: HardCase) -> None:
    rng = hard_case.rng()
    means = torch.tensor(rng.uniform(-1, 1, (400, 3)) + [0, 0, 5], dtype=torch.float32)
    means[200:] = means[:200]
    views = Views(torch.eye(4)[None], torch.tensor([[[200.0, 0, 100], [0, 200, 60], [0, 0, 1]]]), 200, 120)
    near = neighbours(means, views)
    for name, spread in (("equal", 0.0), ("1e-6 m", 1e-6), ("1 km", 1e3)):
        paths = rng.normal(size=9) + spread * rng.normal(size=(400, 9))
        fast = torch.tensor(paths, dtype=torch.float32).requires_grad_()
        slow = fast.detach().double().requires_grad_()
        incoherence(fast, near).backward()
        incoherence_reference(slow, near).backward()
        largest = float(near.pixels.max()) / 2
        hard_case.close(fast.grad.numpy() / largest, slow.grad.numpy() / largest, name)
