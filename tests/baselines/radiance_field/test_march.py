"""Sampling, compositing, encoding, blocks and occupancy against formulas and plain loops."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scenes import array_cameras
from torch import nn

from spike4dgs.baselines.radiance_field import field as blocks
from spike4dgs.baselines.radiance_field.field import Deformation, Field, encode_position, encoded_size, in_blocks
from spike4dgs.baselines.radiance_field.march import camera_rays, resample, spread, weigh
from spike4dgs.baselines.radiance_field.occupancy import Occupancy, may_move
from spike4dgs.method.motion.hexplane import HexPlaneShape


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_encoding_is_the_formula() -> None:
    x = torch.tensor([[0.3, -0.7, 0.11]], dtype=torch.float64)
    out = encode_position(x, 5)[0]
    sines = [math.sin(2**k * math.pi * v) for k in range(5) for v in x[0].tolist()]
    cosines = [math.cos(2**k * math.pi * v) for k in range(5) for v in x[0].tolist()]
    assert out.tolist() == pytest.approx(x[0].tolist() + sines + cosines, abs=1e-12)
    assert len(out) == encoded_size(3, 5)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(3, 40))
def test_weights_are_the_recursion_and_sum_to_one(seed: int, n: int) -> None:
    g = rng(seed)
    density = 8 * torch.rand(4, n, generator=g).double() * (torch.rand(4, n, generator=g) > 0.4)
    z = torch.rand(4, n, generator=g).double().sort().values
    lengths = 1 + torch.rand(4, generator=g).double()
    weights = weigh(density, z, lengths)
    for r in range(4):
        left = 1.0
        for i in range(n):
            alpha = 1.0 if i == n - 1 else 1 - math.exp(-float(density[r, i] * (z[r, i + 1] - z[r, i]) * lengths[r]))
            assert float(weights[r, i]) == pytest.approx(left * alpha, abs=1e-12)
            left *= 1 - alpha
    torch.testing.assert_close(weights.sum(-1), torch.ones(4).double(), rtol=0, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6), st.integers(4, 30))
def test_resampling_is_interpolation_of_the_inverse_cdf(seed: int, n: int) -> None:
    g = rng(seed)
    fractions = torch.rand(3, n, generator=g).double().sort().values
    weights = torch.rand(3, n, generator=g).double() ** 4
    u = torch.rand(3, 50, generator=g).double()
    found = resample(fractions, weights, u)
    for r in range(3):
        middles = ((fractions[r, 1:] + fractions[r, :-1]) / 2).numpy()
        share = weights[r, 1:-1].numpy() + 1e-5
        cdf = np.concatenate([[0], np.cumsum(share / share.sum())])
        np.testing.assert_allclose(found[r].numpy(), np.interp(u[r].numpy(), cdf, middles), atol=1e-9)


def test_a_ray_that_meets_nothing_is_sampled_everywhere() -> None:
    fractions = spread(1, 33, None)
    x = resample(fractions, torch.zeros(1, 33), spread(1, 64, None))[0]
    assert x.isfinite().all() and float(x.diff().max()) < 0.02 and float(x[-1] - x[0]) > 0.9


def test_spread_puts_one_place_into_each_bin() -> None:
    for generator in (None, rng()):
        fractions = spread(50, 16, generator)
        assert torch.equal((fractions * 16).long(), torch.arange(16).expand(50, 16))


def test_rays_go_through_pixel_centres() -> None:
    camera = array_cameras()[2]
    rays = camera_rays(camera)
    points = rays.at(torch.tensor([[1.5, 4.0]]).expand(len(rays), 2))
    for k, z in enumerate((1.5, 4.0)):
        uv, depth = camera.project(points[:, k].double().numpy())
        v, u = np.mgrid[: camera.height, : camera.width].reshape(2, -1) + 0.5
        np.testing.assert_allclose(uv, np.stack([u, v], -1), atol=1e-3)
        np.testing.assert_allclose(depth, z, atol=1e-5)
    assert torch.allclose(rays.lengths * 2.5, (points[:, 1] - points[:, 0]).norm(dim=-1), atol=1e-5)


def field() -> Field:
    return Field(4, 16, 5, 2, 1.5, rng(1))


@pytest.mark.parametrize("rows", [1, 700, 1500])
def test_blocks_equal_the_whole_in_value_and_gradient(rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocks, "BLOCK", 256)
    f = field()
    x = torch.rand(rows, 3, generator=rng(2)) * 2 - 1
    view = encode_position(torch.randn(rows, 3, generator=rng(3)), 2)
    weight = torch.randn(rows, 2, generator=rng(4))
    results = []
    for whole in (False, True):
        f.zero_grad()
        leaf = x.clone().requires_grad_()
        out = f.rows(leaf, view) if whole else in_blocks(f.rows, [leaf, view], list(f.parameters()))
        (out * weight).sum().backward()
        results.append([out.detach(), leaf.grad, *(p.grad.clone() for p in f.parameters())])
    for fast, slow in zip(*results, strict=True):
        torch.testing.assert_close(fast, slow, rtol=1e-4, atol=2e-5 * float(slow.abs().max()) + 1e-7)
    with torch.no_grad():
        quiet = in_blocks(f.rows, [x, view], [])
        assert not quiet.requires_grad and torch.allclose(quiet, results[1][0], atol=1e-6)
        assert torch.allclose(in_blocks(f.density_rows, [x], [])[:, 0], quiet[:, 0], atol=1e-6)


def test_network_has_the_published_number_of_parameters() -> None:
    """D 8, W 256, skip 4, encodings of 10 and 4 frequencies: NeRF's layers, with one gray output."""
    f = Field(8, 256, 10, 4, 1.0, rng())
    layers = [(63, 256), *[(256, 256)] * 3, (256 + 63, 256), *[(256, 256)] * 3]
    layers += [(256, 1), (256, 256), (256 + 27, 128), (128, 1)]
    assert sum(p.numel() for p in f.parameters()) == sum(a * b + b for a, b in layers)
    assert [layer.in_features for layer in f.trunk] == [63, 256, 256, 256, 319, 256, 256, 256]


def test_density_is_positive_and_values_are_within_what_a_camera_can_tell() -> None:
    f = field()
    nn.init.normal_(f.value.weight, std=30, generator=rng())
    with torch.no_grad():
        out = f.rows(torch.rand(500, 3, generator=rng()), encode_position(torch.randn(500, 3, generator=rng()), 2))
    assert (out[:, 0] > 0).all() and (out[:, 1] >= 0).all() and (out[:, 1] <= 1.5).all() and out[:, 1].max() > 1.2


def test_deformation_starts_at_zero_and_then_moves_in_units_of_the_scene() -> None:
    d = Deformation(HexPlaneShape((4, 8), 5, 4, 16), -torch.ones(3), torch.ones(3), 2.0, rng())
    points = torch.randn(30, 3, generator=rng())
    assert torch.equal(d(points, 0.3), points)
    nn.init.ones_(d.last.bias)
    assert torch.allclose(d(points, 0.3) - points, torch.tensor(2.0))
    d(points, 0.3).sum().backward()
    assert all(p.grad is not None for p in d.mlp())


def ball(points: torch.Tensor) -> torch.Tensor:
    """Density of a hard ball of radius 0.5."""
    return 20.0 * (points.norm(dim=-1) < 0.5)


def looked_at(updates: int) -> Occupancy:
    grid = Occupancy(-torch.ones(3), torch.ones(3), 16, 0.01)
    for k in range(updates):
        grid.update(ball, 0.5, rng(k))
    return grid


def test_occupancy_keeps_all_matter_and_drops_most_of_nothing() -> None:
    grid = looked_at(20)
    points = torch.rand(20_000, 3, generator=rng(100)) * 2 - 1
    kept = grid(points)
    assert kept[ball(points) > 0].all()
    near = points.norm(dim=-1) < 0.5 + 3 * math.sqrt(3) * 2 / 16
    assert not kept[~near].any() and float(kept.float().mean()) < 0.4
    assert grid(3 * torch.ones(1, 3)).all()  # outside nothing is known


def test_occupancy_forgets_what_has_gone_and_finds_what_comes_back() -> None:
    grid = looked_at(10)
    for k in range(120):
        grid.update(lambda p: torch.zeros(len(p)), 0.5, rng(k))
    assert not grid.occupied.any()
    for k in range(10):
        grid.update(ball, 0.5, rng(k))
    points = torch.rand(20_000, 3, generator=rng(100)) * 2 - 1
    assert grid(points)[ball(points) > 0].all()


def test_candidates_are_cells_near_points_and_cells_that_may_move() -> None:
    grid = Occupancy(-torch.ones(3), torch.ones(3), 8, 0.01)
    movable = torch.zeros(8**3, dtype=torch.bool)
    movable[grid.cell_of(torch.tensor([[0.9, 0.9, 0.9]]))[1]] = True
    grid.begin(torch.tensor([[-0.9, -0.9, -0.9], [7.0, 0.0, 0.0]]), movable)
    probes = torch.tensor([[-0.9, -0.9, -0.9], [-0.6, -0.9, -0.6], [0.0, 0.0, 0.0], [0.9, 0.7, 0.9]])
    assert grid(probes).tolist() == [True, True, False, True]
    assert grid.moves(probes).tolist() == [False, False, False, True]
    assert int(grid.candidates.sum()) == 16 and not grid.moves(torch.tensor([[9.0, 9.0, 9.0]])).any()


def test_cells_that_may_move_are_seen_changing_by_all_who_see_them() -> None:
    cameras = array_cameras()
    grid = Occupancy(torch.tensor([-1.0, -1.0, -1.0]), torch.ones(3), 20, 0.01)
    centers = grid.positions(torch.arange(20**3)).double().numpy()
    there = np.linalg.norm(centers, axis=1) < 0.3
    moving = np.zeros((len(cameras), 24, 40), bool)
    for camera, mask in zip(cameras, moving, strict=True):
        u, v = np.floor(camera.project(centers[there])[0]).astype(int).T
        mask[v, u] = True
    found = may_move(grid, cameras, moving).numpy()
    assert found[there].all() and found.mean() < 0.2
    moving[1] = False  # one view sees that nothing changes there
    assert not may_move(grid, cameras, moving).numpy()[there].any()
