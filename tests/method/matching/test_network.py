"""The matching network: alignment of cells, sampling, dual softmax, refinement, and a pair that it must learn."""

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from spike4dgs.method.matching import matches
from spike4dgs.method.matching.config import BOTTLENECK, TINY
from spike4dgs.method.matching.matches import learned_matches, mutual, mutual_by_rows
from spike4dgs.method.matching.network import FINE, Matcher, points_of_cells, sample


@pytest.mark.parametrize(("height", "width"), [(48, 64), (125, 200), (33, 30)])
def test_every_coarse_cell_has_its_point_in_the_image(height: int, width: int) -> None:
    features = Matcher(TINY).extractor(torch.zeros(2, 4, height, width))
    rows, columns = features.coarse.shape[2:]
    points = points_of_cells(rows, columns)
    assert (points < torch.tensor([width, height])).all()
    assert points[-1, 0] + 4 > width - 0.5 and points[-1, 1] + 4 > height - 0.5  # and there is no room for another
    assert features.fine.shape[2] >= 2 * rows and features.fine.shape[3] >= 2 * columns


def test_samples_are_those_of_scipy() -> None:
    rng = np.random.default_rng(0)
    features = rng.normal(size=(3, 2, 7, 9))
    view = rng.integers(0, 3, 50)
    at = rng.uniform(-2, 22, (50, 2))
    found = sample(torch.from_numpy(features), torch.from_numpy(view), torch.from_numpy(at))
    for k in range(50):
        y, x = np.clip(at[k, 1] / FINE - 0.5, 0, 6), np.clip(at[k, 0] / FINE - 0.5, 0, 8)
        for c in range(2):
            expected = map_coordinates(features[view[k], c], [[y], [x]], order=1)[0]
            assert found[k, c].item() == pytest.approx(expected, abs=1e-9)


def test_probabilities_are_the_product_of_both_softmaxes() -> None:
    network = Matcher(TINY)
    a, b = (torch.nn.functional.normalize(torch.randn(1, 8, 3, 4), dim=1) for _ in range(2))
    found = network.log_probabilities(a, b)[0].exp()
    similar = np.exp(network.sharpness.item()) * (a[0].flatten(1).T @ b[0].flatten(1)).numpy().astype(np.float64)
    e = np.exp(similar)
    np.testing.assert_allclose(found.detach(), e / e.sum(1, keepdims=True) * e / e.sum(0, keepdims=True), rtol=1e-4)
    i, j = mutual(found.log(), 0.0)
    for x, y in zip(i.tolist(), j.tolist(), strict=True):
        assert found[x].argmax() == y and found[:, y].argmax() == x


@pytest.mark.parametrize("rows", [1, 7, 30, 50])
def test_partners_found_in_blocks_of_rows_are_those_of_the_whole_matrix(rows: int) -> None:
    torch.manual_seed(2)
    network = Matcher(TINY)
    a = torch.nn.functional.normalize(torch.randn(1, 8, 5, 6), dim=1)
    b = torch.nn.functional.normalize(a.flip(3) + 0.5 * torch.randn(1, 8, 5, 6), dim=1)
    for least, count in ((0.0, 22), (0.3, 12)):  # of 30 cells
        whole = mutual(network.log_probabilities(a, b)[0], least)
        assert abs(len(whole[0]) - count) < 4
        found = mutual_by_rows(*(factor[0] for factor in network.factors(a, b)), least, rows)
        assert all(torch.equal(x, y) for x, y in zip(found, whole, strict=True))


def test_views_of_many_cells_are_matched_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(1)
    network = Matcher(TINY)
    with torch.no_grad():
        network.sharpness.fill_(6.0)
    views = np.random.default_rng(0).normal(size=(2, 4, 24, 32)).astype(np.float32)
    views[1] = views[0]
    whole = learned_matches(network, views)
    monkeypatch.setattr(matches, "_MOST_AT_ONCE", 48**2 - 1)
    monkeypatch.setattr(matches, "_BLOCK", 7 * 48)
    monkeypatch.setattr(Matcher, "log_probabilities", None)  # it would hold all pairs
    blocks = learned_matches(network, views)
    for pair, m in whole.items():
        assert len(m.point) > 20
        np.testing.assert_array_equal(blocks[pair].point, m.point)
        np.testing.assert_array_equal(blocks[pair].uv, m.uv)


def test_a_shift_of_the_features_is_a_shift_of_the_first_estimate() -> None:
    torch.manual_seed(0)
    network = Matcher(TINY)
    fine = 12 * torch.nn.functional.normalize(torch.randn(1, 6, 24, 32), dim=1)  # no other place is alike
    moved = torch.roll(fine, shifts=(1, 2), dims=(2, 3))  # by 2 px down and 4 px to the right
    at = torch.tensor([[31.0, 21.0], [23.0, 27.0]])  # middles of cells
    views = torch.zeros(2, dtype=torch.long), torch.zeros(2, dtype=torch.long)
    found = network.refined(fine, moved, at, at + torch.tensor([5.0, 3.0]), views)
    torch.testing.assert_close(found.first, at + torch.tensor([4.0, 2.0]), atol=0.05, rtol=0)


def test_the_network_has_the_size_of_its_bar() -> None:
    assert 2 * sum(p.numel() for p in Matcher(BOTTLENECK).parameters()) < 20e6


def test_matches_of_a_view_with_itself_are_where_they_are() -> None:
    torch.manual_seed(1)
    network = Matcher(TINY)
    with torch.no_grad():
        network.sharpness.fill_(6.0)
    view = np.random.default_rng(0).normal(size=(4, 48, 64)).astype(np.float32)
    found = learned_matches(network, np.stack([view, view]))
    assert set(found) == {(0, 1), (1, 0)}
    m = found[0, 1]
    assert len(m.point) > 100
    assert np.abs(m.uv - m.at).max() < 12 and (m.error > 0).all()  # a cell, its neighbour, and the alignment's reach
    np.testing.assert_array_equal(m.at[0] % 4, [2.5, 2.5])
