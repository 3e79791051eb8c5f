"""Hard inputs of the losses, the motion lookup and the poses from points, each beside a float64 twin."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
import torch
from hard_case import HardCase
from numpy.typing import NDArray
from torch import Tensor

from spike4dgs.baselines.tracking.losses import Neighbours, find_neighbours, physical_loss, remember
from spike4dgs.benchmark.metrics.pose_error import angle_deg
from spike4dgs.benchmark.scene.cameras import look_at
from spike4dgs.method.motion.coherence import incoherence, incoherence_reference, neighbours
from spike4dgs.method.motion.hexplane import sample_level
from spike4dgs.method.motion.hexplane_cpu import sample_levels
from spike4dgs.method.msdi.pose import solve_poses
from spike4dgs.method.splat import Views
from spike4dgs.method.splat.ssim import ssim, ssim_reference
from spike4dgs.method.supervision.spike import encode, firing_rate
from spike4dgs.method.training_views.instants import correction, node
from spike4dgs.method.training_views.training_images import Spans

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
    asked="{which} of currents 0, 1e-12, 1/n, 1, 1e6 from all starts, 1 to 256 steps",
    twin="a loop over the steps, float64",
    unit="spikes per step, or of the slope",
    tolerance=1e-12,
)
@pytest.mark.parametrize("which", ["firing rates", "surrogate gradients"])
def test_neuron(hard_case: HardCase, which: str) -> None:
    """All numbers are multiples of 2^-12, so that every sum is exact."""
    levels = [0.0, 2**-12, 1 / 256, 0.25, 0.5, 1 - 2**-12, 1.0, 1.5, 1e6]
    current, start = np.meshgrid(levels, [0.0, 2**-12, 0.5, 1 - 2**-12])
    for steps in (1, 2, 7, 256):
        leaf = torch.tensor(current, requires_grad=True)
        rate = firing_rate(leaf, torch.tensor(start), steps)
        rate.sum().backward()
        expected_rate, slope = _looped(current, start, steps)
        found, expected = (rate.detach(), expected_rate) if which == "firing rates" else (leaf.grad, slope)
        hard_case.close(found.numpy(), expected, f"{steps} steps")


def _looped(current: Float64, start: Float64, steps: int) -> tuple[Float64, Float64]:
    """Return the rate and the surrogate's gradient of neurons with subtractive reset, step by step."""
    charge, count, last = start.copy(), np.zeros_like(start), np.zeros_like(start)
    for step in range(1, steps + 1):
        charge += np.minimum(current, 1.0)
        fired = charge >= 1
        charge -= fired
        count += fired
        last[fired] = step
    return count / steps, last / steps


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
    asked="instants from means of light of the fifth power in time, over 10 and 20 ticks",
    twin="the light in closed form",
    unit="of radiance",
    tolerance=1e-8,
)
def test_instants(hard_case: HardCase) -> None:
    shape = (2, 40, 64)
    texture = torch.tensor(hard_case.rng().random(shape) + 0.5)
    powers = torch.stack([c * texture for c in (0.5, 0.01, -2e-3, 1e-4, 3e-5, -2e-6)])

    def light(ticks: float) -> Tensor:
        return _sum_of(powers, lambda k: ticks**k)

    for half in (5.0, 10.0):
        spans = Spans(torch.stack([torch.full(shape, -half), torch.full(shape, half)], 1).double(), half, 81)
        mean = _sum_of(powers, lambda k, h=half: (h ** (k + 1) - (-h) ** (k + 1)) / ((k + 1) * 2 * h))
        found = mean + correction(light(-node(half)), light(0.0), light(node(half)), spans)
        hard_case.close(found.numpy(), light(0.0).numpy(), f"{2 * half:g} ticks")


def _sum_of(coefficients: Tensor, weight: Callable[[int], float]) -> Tensor:
    return torch.stack([c * weight(k) for k, c in enumerate(coefficients)]).sum(0)


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


@pytest.mark.hard_case(
    asked="rigidity, rotation and isometry of points that coincide, or lie 1 km away",
    twin="plain torch, float64",
    unit="of the largest",
    tolerance=2e-3,
)
def test_tracking(hard_case: HardCase) -> None:
    rng = hard_case.rng()
    cloud, turns = torch.tensor(rng.normal(size=(60, 3))), torch.tensor(rng.normal(size=(60, 4)))
    moves = torch.tensor(0.05 * rng.normal(size=(60, 3))), torch.tensor(0.05 * rng.normal(size=(60, 4)))
    coincident = cloud.clone()
    coincident[1::2] = coincident[::2]
    for name, points in (("random", cloud), ("coincident", coincident), ("1 km away", cloud + 1e3)):
        start = points.float().double()
        graph = find_neighbours(start, 9)
        moved = [(a + b).float().double() for a, b in zip((start, turns), moves, strict=True)]
        results = [_terms(graph, (start, turns), moved, dtype) for dtype in (torch.float64, torch.float32)]
        for part, slow, fast in zip(("value", "of means", "of turns"), *results, strict=True):
            size = float(slow.abs().max()) + 1e-4
            hard_case.close(fast / size, slow / size, f"{name}, {part}")


def _terms(graph: Neighbours, before: Sequence[Tensor], now: Sequence[Tensor], dtype: torch.dtype) -> list[Tensor]:
    """Return the loss of a moved cloud and its two gradients, computed in one precision."""
    leaves = [t.to(dtype, copy=True).requires_grad_() for t in now]
    own = Neighbours(graph.index, graph.root.to(dtype), graph.rest.to(dtype), graph.unit)
    value = physical_loss(own, remember(own, *(t.to(dtype) for t in before)), leaves[0], leaves[1], (4.0, 4.0, 2.0))
    value.backward()
    return [value.detach().double(), *(leaf.grad.double() for leaf in leaves if leaf.grad is not None)]


def _seen(scale: float = 1.0) -> tuple[Float64, Float64, Float64]:
    """Return points [3, H, W, 3] in view 0's frame of a wavy wall, their cameras' K [3, 3, 3] and poses [3, 4, 4]."""
    up, aim = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 4.0])
    places = ((0.0, 0.0, 0.0), (0.5, 0.1, 0.0), (-0.4, -0.3, 0.2))
    cameras = [look_at("c", np.array(p), aim, up, focal=70, width=64, height=40) for p in places]
    v, u = np.mgrid[:40, :64] + 0.5
    maps = []
    for camera in cameras:
        depth = 4 + 0.3 * np.sin(u / 9) * np.cos(v / 7)
        world = camera.unproject(np.column_stack([u.ravel(), v.ravel()]), depth.ravel())
        maps.append(scale * (world @ cameras[0].R.T + cameras[0].t).reshape(40, 64, 3))
    back = np.linalg.inv(cameras[0].w2c)
    return np.stack(maps), np.stack([c.K for c in cameras]), np.stack([c.w2c @ back for c in cameras])


@pytest.mark.hard_case(
    asked="poses from exact points in units of 1 mm, 1 m and 10 km",
    twin="the true poses",
    unit="degrees",
    tolerance=1e-4,
)
def test_pnp_scale(hard_case: HardCase) -> None:
    for scale in (1e-3, 1.0, 1e4):
        points, K, true = _seen(scale)
        for i, pose in enumerate(solve_poses(points, np.ones(points.shape[:3]), K, hard_case.seed)):
            found = np.full((4, 4), np.nan) if pose.w2c is None else pose.w2c
            hard_case.close(angle_deg(found[:3, :3] @ true[i, :3, :3].T), 0.0, f"view {i}, scale {scale:g}")


@pytest.mark.hard_case(
    asked="points that are NaN, equal, on a line, nonsense, infinite; no confidence",
    twin="the contract: no pose, and a reason",
    unit="views with a pose",
)
def test_pnp_degenerate(hard_case: HardCase) -> None:
    points, K, _ = _seen()
    bad = {
        "NaN": np.full_like(points[1], np.nan),
        "infinite": np.full_like(points[1], np.inf),
        "equal": np.ones_like(points[1]),
        "on a line": points[1] * [1, 0, 0] + [0, 0.5, 3.0],
        "nonsense": 5 * hard_case.rng().normal(size=points[1].shape),
        "1e300": np.full_like(points[1], 1e300),
    }
    sure = np.ones((2, 40, 64))
    found = {n: solve_poses(np.stack([points[0], p]), sure, K[:2], hard_case.seed)[1] for n, p in bad.items()}
    found["no confidence"] = solve_poses(points[:2], np.full_like(sure, np.nan), K[:2], hard_case.seed)[1]
    posed = [name for name, pose in found.items() if pose.found or not pose.reason]
    hard_case.check(len(posed), f"poses of {', '.join(posed)}" if posed else f"no pose of {len(found)}")
