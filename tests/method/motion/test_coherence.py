"""Motion coherence: the kernel against its float64 twin, closed forms, and what it does where nothing else pulls."""

from itertools import product

import pytest
import torch
from torch import Tensor

from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.motion.coherence import (
    EASE,
    NEAREST,
    Coherence,
    Neighbours,
    incoherence,
    incoherence_reference,
    neighbours,
)
from spike4dgs.method.splat import Views
from spike4dgs.method.splat.types import NEAR

FOCAL, DEPTH = 300.0, 5.0
VIEWS = Views(torch.eye(4)[None], torch.tensor([[[FOCAL, 0, 40], [0, FOCAL, 30], [0, 0, 1]]]), 80, 60)
INNER = 2  # layers of the cube that are away from its faces


def cube(side: int = 6) -> Tensor:
    """Return a lattice [N, 3] in front of the view: six nearest neighbours, one on each side of those inside."""
    return 0.02 * torch.tensor(list(product(range(side), repeat=3)), dtype=torch.float32) + torch.tensor([0, 0, DEPTH])


def paths(n: int, seed: int = 0, spread: float = 1.0) -> Tensor:
    return spread * torch.randn(n, 9, generator=torch.Generator().manual_seed(seed))


def velocities(values: Tensor) -> Tensor:
    return torch.cat([values, torch.zeros(len(values), 6)], 1)


def gaussians(means: Tensor, coefficients: Tensor) -> Gaussians:
    n = len(means)
    shapes = {"log_scales": (3,), "quats": (4,), "logits": (), "colors": (1,)}
    rest = {name: torch.zeros(n, *shape) for name, shape in shapes.items()}
    return Gaussians.from_tensors({"means": means, **rest, "coefficients": coefficients})


def test_what_is_nearer_than_the_near_plane_has_no_say() -> None:
    """It is not rendered; as near as it is, it would weigh thousands of times as much as others."""
    depths = torch.tensor([1e-5, 0.5 * NEAR, 2 * NEAR, DEPTH, -1.0])
    pixels = neighbours(torch.stack([torch.zeros(5), torch.zeros(5), depths], 1), VIEWS).pixels
    torch.testing.assert_close(pixels, torch.tensor([0.0, 0.0, FOCAL / (2 * NEAR), FOCAL / DEPTH, 0.0]))


@pytest.mark.parametrize("spread", [0.0, 1e-4, 0.01, 10.0])
@pytest.mark.parametrize("n", [NEAREST + 1, 50, 3000])
def test_value_and_gradient_are_those_of_the_twin(n: int, spread: float) -> None:
    means = torch.rand(n, 3, generator=torch.Generator().manual_seed(n)) + torch.tensor([0, 0, DEPTH])
    near = neighbours(means, VIEWS)
    fast = paths(n, spread=spread).requires_grad_()
    slow = fast.detach().double().requires_grad_()
    found, expected = incoherence(fast, near), incoherence_reference(slow, near)
    (3 * found).backward()
    (3 * expected).backward()
    assert fast.grad is not None and slow.grad is not None
    # Below the ease, the term is a difference of two numbers near it.
    assert found.item() == pytest.approx(expected.item(), rel=1e-5, abs=1e-7 * n)
    assert (fast.grad - slow.grad).norm() <= 1e-5 * slow.grad.norm()


@pytest.mark.parametrize("n", [0, 1, NEAREST])
def test_few_gaussians_have_no_neighbours(n: int) -> None:
    own = paths(n).requires_grad_()
    value = incoherence(own, neighbours(torch.rand(n, 3) + DEPTH, VIEWS))
    value.backward()
    assert value.item() == 0 and own.grad is not None and not own.grad.any()


def test_what_moves_as_one_pays_nothing() -> None:
    means = cube()
    own = paths(1).expand(len(means), 9).contiguous().requires_grad_()
    value = incoherence(own, neighbours(means, VIEWS))
    value.backward()
    assert abs(value.item()) < 1e-4
    assert own.grad is not None and own.grad.abs().max() < 1e-2  # of float32's 1e-7 m, in pixels, over the ease


def test_velocities_of_a_rotation_and_a_stretch_pay_nothing_inside() -> None:
    means = cube()
    spin, stretch = torch.tensor([[0.0, -2, 0], [2, 0, 1], [0, -1, 0]]), torch.diag(torch.tensor([0.3, 0, -0.2]))
    near = neighbours(means, VIEWS)
    middle = ((means - means.mean(0)).abs() < (INNER + 0.1) * 0.02).all(1)
    inside = Neighbours(near.index, near.pixels * middle)  # weighs the others with nothing
    linear = velocities((means - means.mean(0)) @ (spin + stretch).T)
    assert incoherence(linear, near).item() > 10
    assert incoherence(linear, inside).item() < 1e-3


def test_one_that_departs_pays_for_itself_and_its_neighbours() -> None:
    means = cube()
    middle = int((means - means.mean(0)).norm(dim=1).argmin())
    near = neighbours(means, VIEWS)
    own = torch.zeros(len(means), 9)
    own[middle, 3] = 0.4  # m2 along x: a quarter of it at the clip's ends
    at = means[:, 2]

    def eased(px: Tensor) -> Tensor:
        return (px.square() + EASE**2).sqrt() - EASE

    departed = 0.4 * 0.25 * FOCAL / at
    times = (near.index == middle).sum(1)
    expected = eased(departed[middle]) + eased(departed * times / NEAREST).sum()
    assert times.sum() == NEAREST and incoherence(own, near).item() == pytest.approx(expected.item(), rel=1e-5)


def test_a_gaussian_behind_the_view_does_not_count() -> None:
    means = cube()
    means[:, 2] -= 2 * DEPTH
    assert incoherence(paths(len(means)), neighbours(means, VIEWS)).item() == 0


def test_neighbours_stay_until_they_are_forgotten_and_pass_through_a_state() -> None:
    means, own = cube(), paths(len(cube()))
    moved = means + 0.05 * paths(len(means), seed=1)[:, :3]
    first, second = Coherence(2.0, VIEWS), Coherence(2.0, VIEWS)
    assert first.state() == {}
    value = first(gaussians(means, own))
    assert value.item() == pytest.approx(2 / 4800 * incoherence_reference(own, neighbours(means, VIEWS)).item())
    assert torch.equal(first(gaussians(moved, own)), value)
    second.restore(first.state())
    assert torch.equal(second(gaussians(moved, own)), value)
    second.forget()
    assert second.state() == {} and not torch.equal(second(gaussians(moved, own)), value)
    second.restore({})
    assert second.near is None


def test_without_weight_nothing_is_looked_for() -> None:
    none = Coherence(0.0, VIEWS)
    assert none(gaussians(cube(), paths(len(cube())))).item() == 0 and none.state() == {}


def test_motion_spreads_from_the_rim_over_a_flat_surface() -> None:
    """Only the rim's motion is known, and a part of its own keeps its own."""
    side = 21
    y, x = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
    means = torch.stack([0.02 * x, 0.02 * y, torch.full_like(x, DEPTH)], -1).reshape(-1, 3).float()
    apart = means.clone()
    apart[:, 0] += 1.0
    everything, n = torch.cat([means, apart]), len(means)
    rim = ((x % (side - 1) == 0) | (y % (side - 1) == 0)).reshape(-1)
    known = torch.cat([rim, rim])
    truth = torch.zeros(2 * n, 9)
    truth[:n, 0], truth[n:, 1] = 0.2, -0.1
    own = torch.where(known[:, None], truth, 0.0).requires_grad_()
    near = neighbours(everything, VIEWS)
    adam = torch.optim.Adam([own], lr=0.01)
    for _ in range(400):
        adam.zero_grad()
        incoherence(own, near).backward()
        assert own.grad is not None
        own.grad[known] = 0
        adam.step()
    inner = ~known
    assert (own.detach() - truth)[inner].norm(dim=1).median() < 0.01
    assert (own.detach() - truth)[inner].norm(dim=1).max() < 0.05
