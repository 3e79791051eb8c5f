"""Networks: MSDI's image generator with narrower numbers, and HexPlane's lookup against plain torch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import partial
from typing import Any

import torch
from torch import Tensor

from spike4dgs.method.motion.hexplane import sample_level
from spike4dgs.method.motion.hexplane_cpu import sample_levels
from spike4dgs.method.msdi.network import has_bfloat16
from spike4dgs.method.msdi.weights import WEIGHTS, load_network
from spike4dgs.method.torch_state import one_torch_thread
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

GROUP = "Losses and networks"


def _msdi(request: Request) -> Iterator[Series]:
    network = load_network(WEIGHTS.in_use().path, "cpu").eval()
    height, width = request.pick((16, 24), (40, 64), (125, 200))
    g = torch.Generator().manual_seed(request.seed)
    rates = {
        "random light": torch.rand(1, 1, height, width, generator=g),
        "dark": torch.full((1, 1, height, width), 0.01),
    }
    wide = deepcopy(network).double()
    for name, rate in rates.items():
        spikes = (torch.rand(1, network.config.ticks, height, width, generator=g) < 0.6 * rate).to(torch.uint8)
        calls: dict[str, Callable[[], Tensor]] = {
            "float64": lambda spikes=spikes: wide.images(spikes.double()),  # type: ignore[misc]
            "float32": partial(network.images, spikes),
            "features in bfloat16": partial(network.images, spikes, half=True),
        }
        chosen = "features in bfloat16" if has_bfloat16(torch.device("cpu")) else "float32"
        with torch.inference_mode(), one_torch_thread():
            exact = calls["float64"]()
            times = by_turns_ms(list(calls.values()), request.pick(1, 2, 5))
            points = []
            for (title, call), (best, median) in zip(calls.items(), times, strict=True):
                error = (call().double() - exact.double()).abs()
                errors = {"max": float(error.max()), "rms": float(error.square().mean().sqrt())}
                role: Any = "exact" if title == "float64" else "chosen" if title == chosen else ""
                points.append(Point(title, {"ms": best, "median_ms": median, **errors}, role))
        yield Series(f"{name}, {width}x{height}", tuple(points))


def _lookup(request: Request) -> Iterator[Series]:
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

    def features_and_gradient(sample: Callable[..., Tensor], dtype: torch.dtype, at: Tensor) -> tuple[Tensor, Tensor]:
        unit = at.to(dtype).requires_grad_()
        out = sample(unit, [x.to(dtype) for x in lines], [x.to(dtype) for x in space])
        return out.detach(), torch.autograd.grad(out.sum(), unit)[0]

    def plain(unit: Tensor, lines: list[Tensor], space: list[Tensor]) -> Tensor:
        return torch.cat([sample_level(unit, s, x) for s, x in zip(space, lines, strict=True)], -1)

    for name, at in places.items():
        calls = {
            "torch, float64": partial(features_and_gradient, plain, torch.float64, at),
            "torch, float32": partial(features_and_gradient, plain, torch.float32, at),
            "kernels": partial(features_and_gradient, sample_levels, torch.float32, at),
        }
        with one_torch_thread():
            times = by_turns_ms(list(calls.values()), request.pick(1, 5, 9))
            found = [call() for call in calls.values()]
        points = []
        for title, (best, median), (value, gradient) in zip(calls, times, found, strict=True):
            off = float((value - found[0][0]).abs().max())
            slope = float((gradient - found[0][1]).norm() / found[0][1].norm())
            role: Any = {"torch, float64": "exact", "kernels": "chosen"}.get(title, "")
            points.append(Point(title, {"ms": best, "median_ms": median, "max": off, "gradient": slope}, role))
        yield Series(f"{n} points {name}", tuple(points))


MSDI = Measurement(
    id="msdi",
    group=GROUP,
    title="MSDI: numbers of its image generator",
    approximation="Weights are kept as half floats; features are bfloat16 where the processor multiplies them.",
    exact="The same weights in float64.",
    reason="Features in bfloat16 change an image less than one spike in a window does. On processors without its "
    "instructions it is slower, and float32 is chosen.",
    columns=(
        MS,
        MEDIAN_MS,
        Column("rms", "RMS error, spikes per tick"),
        Column("max", "largest error, spikes per tick"),
    ),
    x="ms",
    y=("rms",),
    run=_msdi,
    seconds={"quick": 15, "whole": 60},
    sizes=("quick", "whole"),  # loading the network takes longer than the others of tiny
    held_by="tests/method/msdi",
)
LOOKUP = Measurement(
    id="hexplane-lookup",
    group=GROUP,
    title="HexPlane: lookup and its gradient",
    approximation="Numba kernels in float32; the time planes are lines, as a step has one time.",
    exact="Torch's `grid_sample` in float64.",
    reason="Features keep six digits. On the border of a cell the slope has two values, and either is a gradient.",
    columns=(
        MS,
        MEDIAN_MS,
        Column("max", "largest error of a feature"),
        Column("gradient", "relative L2 error of the slope"),
    ),
    x="ms",
    y=("max", "gradient"),
    run=_lookup,
    seconds={"tiny": 4, "quick": 8, "whole": 30},
    held_by="tests/method/motion/test_hexplane.py",
)
