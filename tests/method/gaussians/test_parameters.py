import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from spike4dgs.benchmark.errors import UserError
from spike4dgs.method.gaussians.optimizer import (
    Adam,
    Decay,
    apply_edit,
    export_state,
    import_state,
    set_learning_rate,
    set_learning_rates,
)
from spike4dgs.method.gaussians.parameters import MAX_COPIES, Gaussians, densify, from_points, nearest, relocate, share

RATES = {name: Decay(0.01, 0.001) for name in ("means", "log_scales", "quats", "logits", "colors")}


def some(n: int, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    g = from_points(rng.normal(size=(n, 3)).astype(np.float32), rng.random(n).astype(np.float32), opacity=0.3)
    g.logits.add_(torch.from_numpy(rng.normal(size=n).astype(np.float32)))
    g.quats.add_(torch.from_numpy(rng.normal(size=(n, 4)).astype(np.float32)))
    return g


def trained(g: Gaussians, steps: int = 3) -> tuple[Gaussians, Adam]:
    g = g.trainable()
    adam = Adam({k: [v] for k, v in g.tensors().items()}, (0.9, 0.99))
    for step in range(steps):
        set_learning_rates(adam, RATES, step / steps)
        adam.zero_grad()
        sum((v * v).sum() for v in g.tensors().values()).backward()
        adam.step()
    return g, adam


def moments(adam: Adam, name: str) -> torch.Tensor:
    return export_state(adam)[f"{name}.0.exp_avg"]


def test_points_become_gaussians_as_wide_as_their_three_nearest_neighbours_are_far():
    x = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3).astype(np.float32)
    g = from_points(x * 0.2, np.full(64, 0.7, np.float32), opacity=0.25)
    splats = g.splats()
    assert torch.allclose(splats.scales, torch.tensor(0.2), rtol=1e-5)  # every grid point has three at distance 0.2
    assert torch.allclose(splats.opacities, torch.tensor(0.25)) and torch.allclose(splats.colors, torch.tensor(0.7))


def test_coincident_points_get_a_positive_size():
    points = np.zeros((8, 3), np.float32)
    points[0] = 1.0
    g = from_points(points, np.zeros(8, np.float32), opacity=0.5)
    assert torch.isfinite(g.log_scales).all()


@pytest.mark.parametrize("points", [np.zeros((3, 3)), np.full((10, 3), np.nan)])
def test_too_few_or_infinite_points_are_refused(points):
    with pytest.raises(UserError, match="at least 4 points, all finite"):
        from_points(points.astype(np.float32), np.zeros(len(points), np.float32), opacity=0.5)


def test_gray_values_that_are_not_finite_are_named():
    values = np.array([0, np.nan, 1, np.inf, 0], np.float32)
    with pytest.raises(UserError, match="finite gray values of the points, found 2 others"):
        from_points(np.eye(5, 3, dtype=np.float32), values, opacity=0.5)


def test_decay_is_log_linear():
    assert Decay(1e-2, 1e-4).at(0.5) == pytest.approx(1e-3)


def test_densify_keeps_old_rows_and_moments_and_starts_new_ones_afresh():
    g, adam = trained(some(10))
    clone, split = torch.zeros(10, dtype=torch.bool), torch.zeros(10, dtype=torch.bool)
    clone[[2, 5]], split[[0, 9]] = True, True
    before = {k: (v.detach().clone(), moments(adam, k).clone()) for k, v in g.tensors().items()}
    edit = densify(g, clone, split, torch.Generator().manual_seed(0))
    new = apply_edit(adam, edit)
    assert len(new) == 10 - 2 + 2 + 4
    kept = [1, 2, 3, 4, 5, 6, 7, 8]
    for name, value in new.tensors().items():
        assert torch.equal(value[:8], before[name][0][kept])
        assert torch.equal(moments(adam, name)[:8], before[name][1][kept])
        assert not moments(adam, name)[8:].any()
        assert torch.equal(value[8:10], before[name][0][[2, 5]])
    halves = new.log_scales[10:].exp() * 1.6
    assert torch.allclose(halves, before["log_scales"][0][[0, 9, 0, 9]].exp())
    assert torch.equal(new.logits[10:], before["logits"][0][[0, 9, 0, 9]])


def test_a_step_has_the_bits_of_torch_s_fused_adam():
    def leaves() -> dict[str, list[torch.Tensor]]:
        rng = torch.Generator().manual_seed(1)
        return {
            name: [torch.randn(shape, generator=rng, requires_grad=True) for shape in ((7, 3), (5,))]
            for name in ("a", "b")
        }

    ours, theirs = leaves(), leaves()
    adam = Adam(ours, (0.9, 0.99))
    groups = [{"name": name, "params": params} for name, params in theirs.items()]
    reference = torch.optim.Adam(groups, lr=0.0, betas=(0.9, 0.99), eps=1e-15, fused=True)
    for step, rate in enumerate((0.1, 0.05, 0.0, 0.2)):
        for optimiser, params in ((adam, ours), (reference, theirs)):
            optimiser.zero_grad()
            used = params["a"] + params["b"][: step % 3]  # a parameter without a gradient stays where it is
            sum(((p - 1) ** 3).sum() for p in used).backward()
        adam.groups[0].lr = reference.param_groups[0]["lr"] = rate
        adam.groups[1].lr = reference.param_groups[1]["lr"] = rate / 3
        adam.step()
        reference.step()
        for name in ours:
            assert all(torch.equal(p, q) for p, q in zip(ours[name], theirs[name], strict=True)), (step, name)


def test_optimiser_state_survives_export_and_import():
    g, adam = trained(some(5))
    copy, fresh = trained(some(5), steps=0)
    copy = g.trainable()
    fresh = Adam({k: [v] for k, v in copy.tensors().items()}, (0.9, 0.99))
    import_state(fresh, {k: v.clone() for k, v in export_state(adam).items()})
    for leaves, optimiser in ((g, adam), (copy, fresh)):
        set_learning_rates(optimiser, RATES, 0.5)
        optimiser.zero_grad()
        (leaves.means**3).sum().backward()
        optimiser.step()
    assert torch.equal(g.means, copy.means)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.01, 0.99), st.integers(1, MAX_COPIES))
def test_shared_gaussians_keep_opacity_and_line_integral(opacity, copies):
    new, factor = (float(x) for x in share(torch.tensor([opacity]).double(), torch.tensor([copies])))
    assert 1 - (1 - new) ** copies == pytest.approx(opacity, rel=1e-6)
    stacked = quad(lambda x: 1 - (1 - new * math.exp(-0.5 * (x / factor) ** 2)) ** copies, -40, 40, points=[0])[0]
    assert stacked == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-5)


def test_relocation_without_dead_or_without_living_changes_nothing():
    g = some(6)
    for dead in (torch.zeros(6, dtype=torch.bool), torch.ones(6, dtype=torch.bool)):
        edit = relocate(g, dead, torch.Generator())
        assert torch.equal(edit.gaussians.logits, g.logits) and torch.equal(edit.source, torch.arange(6))


@pytest.mark.parametrize(("n", "k"), [(2, 1), (7, 6), (200, 6)])
def test_neighbours_are_those_of_all_distances(n: int, k: int) -> None:
    points = torch.rand(n, 3, generator=torch.Generator().manual_seed(n))
    index, distance = nearest(points, k)
    apart = torch.cdist(points.double(), points.double()).fill_diagonal_(torch.inf)
    expected = apart.sort(dim=1)
    assert torch.equal(index, expected.indices[:, :k])
    assert torch.allclose(distance, expected.values[:, :k], atol=1e-6)


@pytest.mark.parametrize("copies", [2, 3, 9])
def test_a_point_is_never_its_own_neighbour_where_points_coincide(copies: int) -> None:
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(copies)).repeat(copies, 1)
    index, distance = nearest(points, 6)
    assert not (index == torch.arange(len(points))[:, None]).any()
    assert all(len(set(row)) == 6 for row in index.tolist())
    assert (distance[:, : min(copies - 1, 6)] == 0).all()
    assert (index[:, : min(copies - 1, 6)] % 40 == (torch.arange(len(points)) % 40)[:, None]).all()


def test_clipped_steps_are_torchs_and_a_gradient_that_is_no_number_moves_nothing():
    sizes = {"wide": (300, 4), "narrow": (5,)}
    first = {k: torch.randn(size, generator=torch.Generator().manual_seed(0)) for k, size in sizes.items()}
    ours, theirs = ({name: p.clone().requires_grad_() for name, p in first.items()} for _ in range(2))
    adam = Adam({name: [p] for name, p in ours.items()}, (0.9, 0.99))
    set_learning_rate(adam, 0.1)
    twins = [torch.optim.Adam([p], 0.1, (0.9, 0.99), 1e-15) for p in theirs.values()]
    for scale in (1e3, 1e-3, math.inf, 1.0):
        for leaves in (ours, theirs):
            for p in leaves.values():
                p.grad = (scale * p).detach()
        if scale == math.inf:
            ours["narrow"].grad = torch.ones_like(ours["narrow"])  # one group is finite: it does not move either
        adam.step_clipped()
        for p, twin in zip(theirs.values(), twins, strict=True):
            torch.nn.utils.clip_grad_norm_([p], 1.0)
            if math.isfinite(scale):
                twin.step()
        for name, p in ours.items():
            torch.testing.assert_close(p.detach(), theirs[name].detach(), rtol=1e-5, atol=1e-7)
