import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from spike4dgs.benchmark.scene.cameras import Camera, look_at
from spike4dgs.method.gaussians import optimizer
from spike4dgs.method.gaussians.density import DensitySettings, GradientStatistics, adapt_density
from spike4dgs.method.gaussians.parameters import Edit, Gaussians, densify, prune, relocate
from spike4dgs.method.splat import Views, render

SETTINGS = DensitySettings()
HIGH = 2 * SETTINGS.grow_grad2d


def cloud(n: int, seed: int = 0) -> Gaussians:
    """Gaussians of all shapes around the origin, none of them faint or large."""
    rng = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=torch.rand(n, 3, generator=rng) - 0.5,
        log_scales=-6 + torch.rand(n, 3, generator=rng),
        quats=torch.randn(n, 4, generator=rng),
        logits=torch.logit(0.1 + 0.8 * torch.rand(n, generator=rng)),
        colors=torch.rand(n, 1, generator=rng),
        extra={"times": torch.rand(n, generator=rng), "coefficients": torch.randn(n, 9, generator=rng)},
    )


def camera(x: float) -> Camera:
    up = np.array([0.0, 0.0, 1.0])
    return look_at("c", np.array([x, -3.0, 0.4]), np.zeros(3), up, focal=90.0, width=64, height=48)


def statistics(values: list[float]) -> GradientStatistics:
    return GradientStatistics(torch.tensor(values), torch.ones(len(values)))


def mask(n: int, *rows: int) -> Tensor:
    return torch.zeros(n, dtype=torch.bool).index_fill(0, torch.tensor(rows), True)


def trained(gaussians: Gaussians) -> tuple[Gaussians, torch.nn.Parameter, optimizer.Adam]:
    """Gaussians, something else beside them, and an optimiser whose moments differ in every row."""
    leaves, other = gaussians.trainable(), torch.nn.Parameter(torch.ones(3))
    adam = optimizer.Adam({**{k: [v] for k, v in leaves.tensors().items()}, "grid": [other]}, (0.9, 0.99))
    optimizer.set_learning_rates(adam, {g.name: optimizer.Decay(1e-3, 1e-3) for g in adam.groups}, 0.0)
    rng = torch.Generator().manual_seed(5)
    for _ in range(3):
        for p in [*leaves.tensors().values(), other]:
            p.grad = torch.randn(p.shape, generator=rng)
        adam.step()
    return leaves, other, adam


EDITS = {
    "prune": lambda g: prune(g, torch.arange(12) % 3 != 0),
    "densify": lambda g: densify(g, mask(12, 1, 4, 5), mask(12, 0, 5, 11), torch.Generator().manual_seed(3)),
    "relocate": lambda g: relocate(g, mask(12, 2, 9), torch.Generator().manual_seed(1)),
    "adapt_density": lambda g: adapt_density(g, statistics([HIGH, 0] * 6), SETTINGS, 1.0, 100, torch.Generator())[0],
}


@pytest.mark.parametrize("name", EDITS)
def test_every_rows_moments_are_those_of_the_row_that_it_continues(name: str) -> None:
    leaves, other, adam = trained(cloud(12))
    old, before = {k: v.clone() for k, v in optimizer.export_state(adam).items()}, other.detach().clone()
    edit: Edit = EDITS[name](leaves)
    after = optimizer.apply_edit(adam, edit)
    new = optimizer.export_state(adam)
    assert new.keys() == old.keys()
    kept = edit.source >= 0
    assert kept.any()
    for key, value in old.items():
        group, _, what = key.split(".")
        if group == "grid" or what not in optimizer.MOMENTS:  # another group, and the count of steps
            assert torch.equal(new[key], value)
            continue
        assert new[key].shape == after.tensors()[group].shape
        assert torch.equal(new[key][kept], value[edit.source[kept]]) and not new[key][~kept].any()
    for group in adam.groups:
        (parameter,) = group.params
        assert parameter is (other if group.name == "grid" else after.tensors()[group.name])
        assert parameter.is_leaf and parameter.requires_grad
        parameter.grad = torch.ones_like(parameter)
    assert len(adam.state) == len(adam.groups)  # no memory of the old leaves
    adam.step()
    assert all(torch.isfinite(v).all() for v in after.tensors().values())
    assert not torch.equal(other, before)


def test_a_gaussian_marked_for_both_is_split_only() -> None:
    g = cloud(3)
    edit = densify(g, mask(3, 1), mask(3, 1), torch.Generator())
    assert edit.source.tolist() == [0, 2, -1, -1]


def test_halves_spread_along_the_axes_of_the_gaussian_that_is_split() -> None:
    one = cloud(1, seed=4)
    one.log_scales[0] = torch.tensor([0.1, 0.4, 1.0]).log()
    everything = torch.ones(4000, dtype=torch.bool)
    halves = densify(one.rows(torch.zeros(4000).long()), ~everything, everything, torch.Generator().manual_seed(0))
    w, x, y, z = (one.quats[0] / one.quats[0].norm()).tolist()
    R = torch.tensor(Rotation.from_quat([x, y, z, w]).as_matrix(), dtype=torch.float32)
    spread = torch.cov((halves.gaussians.means - one.means).T)
    torch.testing.assert_close(spread, R @ torch.diag(torch.tensor([0.01, 0.16, 1.0])) @ R.T, rtol=0.1, atol=0.02)
    assert (halves.gaussians.means.mean(0) - one.means[0]).norm() < 0.05


def test_relocated_gaussians_equal_their_hosts_and_leave_the_others_alone() -> None:
    g, dead = cloud(30), mask(30, 2, 9, 17, 28)
    edit = relocate(g, dead, torch.Generator().manual_seed(1))
    new = edit.gaussians
    quiet = edit.source >= 0
    assert edit.source[quiet].tolist() == torch.nonzero(quiet)[:, 0].tolist() and not quiet[dead].any()
    for i in torch.nonzero(dead)[:, 0].tolist():
        (host,) = [j for j in range(30) if not dead[j] and torch.equal(g.means[j], new.means[i])]
        assert not quiet[host] and new.logits[i] < g.logits[host]
        assert all(torch.equal(v[i], v[host]) for v in new.tensors().values())
    assert all(torch.equal(v[quiet], g.tensors()[k][quiet]) for k, v in new.tensors().items())


def test_relocation_prefers_opaque_hosts() -> None:
    g = cloud(400)
    g.logits[:200], g.logits[200:] = 8.0, torch.logit(torch.tensor(0.01))
    dead = torch.arange(400) % 2 == 0
    edit = relocate(g, dead, torch.Generator().manual_seed(0))
    hosts = (edit.source < 0) & ~dead
    assert hosts[:200].sum() > 80 and hosts[200:].sum() < 8


def test_relocation_changes_the_image_far_less_than_plain_copies_would() -> None:
    g = cloud(40, seed=2)
    g = Gaussians(g.means, g.log_scales + 3, g.quats, g.logits, g.colors)
    dead = torch.arange(40) % 4 == 0
    g.logits[dead] = -12.0  # invisible
    relocated = relocate(g, dead, torch.Generator().manual_seed(0)).gaussians
    hosts = torch.cdist(relocated.means[dead], g.means[~dead]).argmin(1)
    copied = g.rows(torch.arange(40))
    for name, value in copied.tensors().items():
        value[dead] = g.tensors()[name][~dead][hosts]

    def make_image(gaussians: Gaussians) -> Tensor:
        return render(gaussians.splats(), Views.from_cameras([camera(0.1)]), backend="reference").image

    before = make_image(g)
    change, uncorrected = (before - make_image(relocated)).abs(), (before - make_image(copied)).abs()
    assert before.max() > 0.5 and change.max() < 0.06
    assert change.mean() < 0.02 * before.mean() and change.mean() < 0.2 * uncorrected.mean()


def test_densification_grows_where_the_gradient_is_high_and_removes_the_faint() -> None:
    g = cloud(6)
    g.logits[3] = -9.0
    g.log_scales[1, 2] = math.log(2 * SETTINGS.grow_scale3d * 3.0)  # large for a scene of this size
    (edit,) = adapt_density(g, statistics([HIGH, HIGH, 0, HIGH, 0, 0]), SETTINGS, 3.0, 100, torch.Generator())
    assert edit.source.tolist() == [0, 2, 4, 5, -1, -1, -1]
    assert torch.equal(edit.gaussians.means[4], g.means[0])


@pytest.mark.parametrize("limit", [6, 7, 8, 11, 12, 50])
def test_densification_keeps_to_the_limit_and_prefers_high_gradients(limit: int) -> None:
    g = cloud(6)
    (edit,) = adapt_density(g, statistics([(i + 1) * HIGH for i in range(6)]), SETTINGS, 1.0, limit, torch.Generator())
    more = min(limit, 12) - 6
    assert len(edit.gaussians) == 6 + more
    assert torch.equal(edit.gaussians.means[6:].sort(0).values, g.means[6 - more :].sort(0).values)


def test_densification_at_the_limit_moves_the_dead() -> None:
    g = cloud(8)
    g.logits[2] = -9.0
    (edit,) = adapt_density(g, statistics([1.0] * 8), SETTINGS, 1.0, 7, torch.Generator())
    assert len(edit.gaussians) == 8 and edit.source[2] == -1
    assert edit.gaussians.logits.sigmoid().min() > SETTINGS.prune_opacity


def test_gradient_statistics_are_those_of_each_view_alone_in_half_images() -> None:
    g = cloud(6)
    g = Gaussians(g.means, g.log_scales + 3, g.quats, g.logits, g.colors).trainable()
    g.means.data[5] = torch.tensor([0.0, -9.0, 0.0])  # behind both cameras
    cameras, gathered = [camera(-0.2), camera(0.2)], GradientStatistics.zero(6, torch.device("cpu"))
    for _ in range(2):
        out = render(g.splats(), Views.from_cameras(cameras), backend="cpu")
        out.image.square().mean().backward()
        gathered.add(out)
    expected = torch.zeros(6)
    for one in cameras:
        alone = render(g.splats(), Views.from_cameras([one]), backend="reference")
        alone.image.square().mean().backward()
        assert alone.means2d.grad is not None
        expected += (alone.means2d.grad[0] * torch.tensor([32.0, 24.0])).norm(dim=-1).float() / 2
    assert gathered.seen.tolist() == [4.0] * 5 + [0.0]
    torch.testing.assert_close(gathered.mean(), expected, rtol=2e-3, atol=1e-7)


def test_a_warm_cosine_rises_linearly_and_falls_to_nothing() -> None:
    schedule = optimizer.WarmCosine(peak=3e-3, warm_up=8, steps=50)
    for step in range(50):
        rise = (step + 1) / 8 if step < 8 else 1.0
        assert schedule.at(step) == pytest.approx(3e-3 * rise * math.cos(math.pi * step / 100) ** 2, rel=1e-9)
    assert schedule.at(50) == pytest.approx(0, abs=1e-12)
    assert optimizer.WarmCosine(peak=1.0, warm_up=1, steps=9).at(0) == 1


def test_one_rate_is_set_for_all_groups() -> None:
    adam = optimizer.Adam({name: [torch.zeros(1, requires_grad=True)] for name in ("a", "b")}, (0.9, 0.999))
    optimizer.set_learning_rate(adam, 0.25)
    assert [group.lr for group in adam.groups] == [0.25, 0.25]


@pytest.mark.parametrize("count", [1, 2, 7])
def test_averages_are_plain_means_of_all_parameters(count: int) -> None:
    a, b = torch.zeros(5, 3, requires_grad=True), torch.zeros(2, requires_grad=True)
    adam, averages, seen = optimizer.Adam({"a": [a], "b": [b]}, (0.9, 0.99)), optimizer.Averages(), []
    for n in range(1, count + 1):
        with torch.no_grad():
            a.copy_(torch.randn(a.shape, generator=torch.Generator().manual_seed(n)))
            b.copy_(torch.randn(b.shape, generator=torch.Generator().manual_seed(100 + n)))
        seen.append((a.detach().double(), b.detach().double()))
        averages.add(adam, n)
    averages.apply(adam)
    for leaf, values in zip((a, b), zip(*seen, strict=True), strict=True):
        torch.testing.assert_close(leaf.detach().double(), torch.stack(values).mean(0), atol=1e-6, rtol=0)
