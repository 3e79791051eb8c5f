import math

import numpy as np
import pytest
import torch
from hard_case import HardCase
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from spike4dgs.baselines.tracking import losses
from spike4dgs.benchmark.errors import UserError


def cloud(n: int = 40, seed: int = 0, size: float = 1.0) -> tuple[torch.Tensor, torch.Tensor]:
    """Points [N, 3] and quaternions [N, 4] of any length, float64."""
    rng = np.random.default_rng(seed)
    return torch.from_numpy(size * rng.normal(size=(n, 3))), torch.from_numpy(rng.normal(size=(n, 4)))


def scipy_rotation(q: torch.Tensor) -> Rotation:
    return Rotation.from_quat(q.detach().numpy()[..., [1, 2, 3, 0]])


def by_loop(
    graph_points: np.ndarray, k: int, old: tuple[np.ndarray, ...], new: tuple[np.ndarray, ...]
) -> tuple[float, float, float]:
    """The three terms from their formulas, pair by pair; neighbours by sorting all distances."""
    distance = cdist(graph_points, graph_points)
    nearest = np.argsort(distance + np.diag(np.full(len(distance), np.inf)), axis=1)[:, :k]
    lengths = np.sort(np.take_along_axis(distance, nearest, 1), axis=None)
    unit = lengths[(len(lengths) - 1) // 2] * math.sqrt(2000)  # the lower median
    turns = []
    for q, p in zip(new[1], old[1], strict=True):
        r = Rotation.from_quat(q[[1, 2, 3, 0]]) * Rotation.from_quat(p[[1, 2, 3, 0]]).inv()
        x, y, z, w = r.as_quat()
        # the product of the two unit quaternions, whose sign scipy does not keep
        scalar = (q @ p) / np.linalg.norm(q) / np.linalg.norm(p)
        turns.append(np.array([w, x, y, z]) * (1 if w * scalar >= 0 else -1))
    terms = []
    for i in range(len(graph_points)):
        w, x, y, z = turns[i]
        R = Rotation.from_quat([x, y, z, w]).as_matrix()
        for j in nearest[i]:
            d0 = distance[i, j] / unit
            weight = math.sqrt(math.exp(-2000 * d0**2))
            now, then = (new[0][j] - new[0][i]) / unit, (old[0][j] - old[0][i]) / unit
            rigid = weight * np.linalg.norm(R.T @ now - then)
            turn = weight * np.linalg.norm(turns[j] - turns[i])
            terms.append((rigid, turn, weight * abs(np.linalg.norm(now) - d0)))
    return tuple(np.mean(terms, axis=0))


def test_neighbours_are_the_nearest_and_the_median_pair_weighs_one_over_e() -> None:
    points, _ = cloud(51, size=30.0)
    graph = losses.find_neighbours(points, 7)
    distance = cdist(points, points) + np.diag(np.full(51, np.inf))
    for i in range(51):
        assert set(graph.index[i].tolist()) == set(np.argsort(distance[i])[:7])
        np.testing.assert_allclose(graph.rest[i] * graph.unit, np.sort(distance[i])[:7], rtol=1e-12)
    assert math.isclose(float((graph.root**2).median()), math.exp(-1), rel_tol=1e-9)
    torch.testing.assert_close(graph.root**2, torch.exp(-losses.SHARPNESS * graph.rest**2))


def test_size_of_the_world_changes_no_term() -> None:
    (x, q), (y, r) = cloud(30), cloud(30, seed=1)
    small, large = ((losses.find_neighbours(x * s, 5), x * s, (x + 0.01 * y) * s) for s in (1.0, 250.0))
    terms = [losses.physical_terms(g, losses.remember(g, a, q), b, r) for g, a, b in (small, large)]
    torch.testing.assert_close(torch.stack(terms[0]), torch.stack(terms[1]))


def test_fewer_points_than_neighbours_take_all_others() -> None:
    graph = losses.find_neighbours(cloud(4)[0], 20)
    assert graph.index.shape == (4, 3)


@pytest.mark.parametrize("points", [torch.zeros(1, 3), torch.zeros(5, 3)])
def test_nothing_to_relate_is_refused(points: torch.Tensor) -> None:
    with pytest.raises(UserError, match="tracking"):
        losses.find_neighbours(points, 3)


@given(st.integers(0, 10**6), st.floats(0, math.pi), st.floats(-50, 50))
@settings(max_examples=25, deadline=None)
def test_a_rigid_motion_costs_nothing(seed: int, angle: float, far: float) -> None:
    x, q = cloud(25, seed)
    axis = np.random.default_rng(seed + 1).normal(size=3)
    turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    w = turn.as_quat()[[3, 0, 1, 2]]
    moved = x @ torch.from_numpy(turn.as_matrix()).T + far
    turned = losses.multiply(torch.from_numpy(w).expand_as(q), q)
    graph = losses.find_neighbours(x, 6)
    for term in losses.physical_terms(graph, losses.remember(graph, x, q), moved, turned):
        assert abs(float(term)) < 1e-10


@pytest.mark.parametrize("seed", range(3))
def test_terms_are_those_of_a_loop_over_the_pairs(seed: int) -> None:
    (first, _), (x, q), (y, r) = (cloud(20, 10 * seed + i) for i in range(3))
    graph = losses.find_neighbours(first, 5)
    terms = losses.physical_terms(graph, losses.remember(graph, x, q), y, r)
    expected = by_loop(first.numpy(), 5, (x.numpy(), q.numpy()), (y.numpy(), r.numpy()))
    np.testing.assert_allclose([float(t) for t in terms], expected, rtol=1e-9)


def test_gradients_are_those_of_finite_differences() -> None:
    (first, _), (x, q), (y, r) = (cloud(8, i) for i in range(3))
    graph = losses.find_neighbours(first, 3)
    before = losses.remember(graph, x, q)

    def terms(means: torch.Tensor, quats: torch.Tensor) -> torch.Tensor:
        return torch.stack(losses.physical_terms(graph, before, means, quats))

    assert torch.autograd.gradcheck(terms, (y.requires_grad_(), r.requires_grad_()))


@pytest.mark.hard_case(
    asked="rigidity, rotation and isometry, weighted {weights}, of points that are {case}",
    twin="plain torch, float64", unit="of a thousandth or so of the largest", tolerance=1.0,
)  # fmt: skip
@pytest.mark.parametrize("case", ["random", "unmoved", "coincident", "far"])
@pytest.mark.parametrize("weights", [(4.0, 4.0, 2.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
def test_fused_kernel_is_the_float64_twin(hard_case: HardCase, case: str, weights: tuple[float, float, float]) -> None:
    """Far is 1 km away; half of the points coincide with the others."""
    x, q = cloud(60, hard_case.seed)
    x = x.float().double() + (1e3 if case == "far" else 0.0)
    if case == "coincident":
        x[1::2] = x[::2]
    graph = losses.find_neighbours(x, 9)
    y = x if case == "unmoved" else x + 0.05 * cloud(60, 4)[0]
    r = q if case == "unmoved" else q + 0.05 * cloud(60, 5)[1]
    y, r = y.float().double(), r.float().double()
    results = []
    for dtype in (torch.float64, torch.float32):
        leaves = [t.to(dtype).clone().requires_grad_() for t in (y, r)]
        g = type(graph)(graph.index, graph.root.to(dtype), graph.rest.to(dtype), graph.unit)
        value = 3 * losses.physical_loss(g, losses.remember(g, x.to(dtype), q.to(dtype)), *leaves, weights)
        value.backward()
        results.append((value.detach().double(), *(leaf.grad.double() for leaf in leaves)))
    slow, fast = results
    parts = ("value", "of means", "of turns") if case != "unmoved" else ("value",)
    for part, a, b in zip(parts, fast, slow, strict=False):  # the gradient of |0| is what rounding decides
        largest = float(b.abs().max())
        allowed = 1e-4 * largest + 3e-5 if part == "value" else 2e-3 * largest + 1e-7
        hard_case.check(float((a - b).abs().max()) / allowed, f"{part}: up to {largest:.3g}", bool(a.isfinite().all()))


def test_quaternion_product_turns_like_the_second_then_the_first() -> None:
    (_, a), (_, b) = cloud(9), cloud(9, 1)
    expected = (scipy_rotation(a) * scipy_rotation(b)).as_matrix()
    np.testing.assert_allclose(scipy_rotation(losses.multiply(a, b)).as_matrix(), expected, atol=1e-12)
    unit = a / a.norm(dim=-1, keepdim=True)
    identity = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand_as(unit)
    torch.testing.assert_close(losses.multiply(unit, losses.conjugate(unit)), identity)


def test_background_and_colour_terms_are_mean_absolute_sums() -> None:
    (x, q), (y, r) = cloud(6), cloud(6, 1)
    a, b = q.numpy() / np.linalg.norm(q, axis=1)[:, None], r.numpy() / np.linalg.norm(r, axis=1)[:, None]
    expected = sum(np.abs(y[i] - x[i]).sum().item() / 0.3 + np.abs(b[i] - a[i]).sum() for i in range(6)) / 6
    assert math.isclose(float(losses.background_term(y, r, x, q, 0.3)), expected, rel_tol=1e-12)
    assert float(losses.background_term(y[:0], r[:0], x[:0], q[:0], 0.3)) == 0
    c, d = torch.rand(5, 1), torch.rand(5, 1)
    expected = sum(abs(float(c[i] - d[i])) for i in range(5)) / 5
    assert math.isclose(float(losses.color_term(c, d)), expected, rel_tol=1e-6)
