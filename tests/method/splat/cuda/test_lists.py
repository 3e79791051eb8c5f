"""The tiles' lists against a loop over tiles, and the CUDA back end's errors."""

from __future__ import annotations

import pytest
import torch
from splat_scenes import HARD, random_splats, views

from spike4dgs.benchmark.errors import UserError
from spike4dgs.method.splat import render
from spike4dgs.method.splat.cuda.prepare import TILE, Grid, make_pairs, project, sort_pairs
from spike4dgs.method.splat.reference import project as project_reference
from spike4dgs.method.splat.types import CUSTOMARY, PixelFilter


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("scene", HARD)
def test_projection_equals_the_reference(scene, antialiased: bool) -> None:  # type: ignore[no-untyped-def]
    splats, v = scene()
    seen = project(splats, v, PixelFilter(compensated=antialiased))
    for c in range(len(v)):
        wanted = project_reference(splats, v.w2c[c], v.K[c], (v.width, v.height), PixelFilter(compensated=antialiased))
        mine = seen.view == c
        order = torch.argsort(seen.depth[mine].float(), stable=True)
        assert torch.equal(seen.index[mine][order], wanted.index)
        for a, b in ((seen.center, wanted.center), (seen.radius, wanted.radius), (seen.shape[:, 3], wanted.opacity)):
            torch.testing.assert_close(a[mine][order], b, rtol=1e-9, atol=1e-9)


def test_every_tile_lists_what_its_pixels_may_see_nearest_first() -> None:
    splats, v = random_splats(200, seed=3), views(2)
    seen, grid = project(splats, v, CUSTOMARY), Grid(len(v), v.width, v.height)
    pairs = make_pairs(seen, grid)
    slots = torch.arange(len(pairs.keys))
    lists = sort_pairs(grid, pairs.keys, pairs.rows, slots)
    assert len(lists.tiles) == len(grid) == 2 * grid.across * grid.down
    for tile in range(len(grid)):
        view, at = divmod(tile, grid.across * grid.down)
        x0, y0 = at % grid.across * TILE, at // grid.across * TILE
        box = seen.box
        meets = (box[:, 0] < x0 + TILE) & (box[:, 1] > x0) & (box[:, 2] < y0 + TILE) & (box[:, 3] > y0)
        wanted = torch.nonzero(meets & (seen.view == view))[:, 0]
        wanted = wanted[torch.argsort(seen.depth[wanted].float(), stable=True)]
        begin, end = lists.offsets[tile : tile + 2]
        assert torch.equal(lists.rows[begin:end], wanted)
        assert torch.equal(pairs.rows[lists.slots[begin:end]], wanted)
    assert torch.equal(pairs.starts[1:] - pairs.starts[:-1], torch.bincount(pairs.rows, minlength=len(seen.view)))


def test_the_back_end_refuses_tensors_of_the_cpu() -> None:
    with pytest.raises(UserError, match="back end cuda: expected tensors on a CUDA device, found cpu"):
        render(random_splats(3), views(1), backend="cuda")
