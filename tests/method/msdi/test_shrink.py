"""Streams of larger pixels against a plain loop."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from spike4dgs.benchmark.errors import UserError
from spike4dgs.method.msdi.inputs import shrink, shrink_intrinsics
from spike4dgs.method.msdi.network import ray_map


@pytest.mark.parametrize(("factor", "size"), [(2, (6, 8)), (3, (7, 5)), (4, (5, 9))])
def test_shrunk_stream_is_that_of_larger_pixels(factor: int, size: tuple[int, int]) -> None:
    g = torch.Generator().manual_seed(0)
    x = (torch.rand(2, 1, 30, *size, generator=g) < torch.rand(2, 1, 1, *size, generator=g)).float()
    out = shrink(x, factor)
    rows, columns = (-(-n // factor) for n in size)
    assert out.shape == (2, 1, 30, rows, columns) and set(out.unique().tolist()) <= {0.0, 1.0}
    for sample, row, column in np.ndindex(2, rows, columns):
        block = x[sample, 0, :, factor * row : factor * (row + 1), factor * column : factor * (column + 1)]
        threshold = block[0].numel()
        charge = threshold / 2
        for tick in range(30):
            charge += float(block[tick].sum())
            fired = charge >= threshold
            charge -= threshold * fired
            assert out[sample, 0, tick, row, column] == fired
        assert abs(float(out[sample, 0, :, row, column].sum()) - 30 * float(block.mean())) <= 0.5 + 1e-5


def test_shrinking_keeps_dark_and_saturated_pixels_and_the_rays_of_blocks() -> None:
    assert torch.equal(shrink(torch.zeros(1, 9, 5, 7), 2), torch.zeros(1, 9, 3, 4))
    assert torch.equal(shrink(torch.ones(1, 9, 5, 7), 2), torch.ones(1, 9, 3, 4))
    x = (torch.rand(2, 9, 5, 7, generator=torch.Generator().manual_seed(0)) < 0.4).float()
    assert torch.equal(shrink(x.bool(), 1), x)
    K = torch.tensor([[40.0, 0, 10], [0, 44, 6], [0, 0, 1]])
    fine, coarse = ray_map(K[None], 1, 12, 20, x), ray_map(shrink_intrinsics(K, 4)[None], 1, 3, 5, x)
    blocks = torch.nn.functional.avg_pool2d(fine, 4)  # the middle of a block of pixels
    assert torch.allclose(coarse, blocks, atol=1e-6)
    with pytest.raises(UserError, match="a factor of 1 or more, found 0"):
        shrink(x, 0)
