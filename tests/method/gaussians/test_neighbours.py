"""Nearest neighbours against all distances, and points that coincide."""

from __future__ import annotations

import pytest
import torch

from spike4dgs.method.gaussians.parameters import nearest


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
