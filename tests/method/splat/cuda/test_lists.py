"""The tiles' lists against a loop over tiles, and the CUDA back end's errors."""

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from splat_scenes import HARD, random_splats, views
from torch.utils._python_dispatch import TorchDispatchMode

from spike4dgs.benchmark.errors import UserError
from spike4dgs.method.splat import Splats, render
from spike4dgs.method.splat.cuda.prepare import TILE, Grid, make_pairs, naming, product, project, sort_pairs
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


def test_a_gaussian_gets_the_same_bits_alone_and_among_others() -> None:
    """A background is projected by itself, and must give what rendering everything at once gives."""
    splats, v = random_splats(200, seed=3), views(3)
    everything = project(splats, v, CUSTOMARY)
    few = project(Splats(*(t[150:] for t in splats.tensors)), v, CUSTOMARY)
    mine = everything.index >= 150
    assert torch.equal(everything.index[mine] - 150, few.index) and len(few.index) > 50
    for a, b in ((everything.center, few.center), (everything.shape, few.shape), (everything.depth, few.depth)):
        assert torch.equal(a[mine], b)


class Operations(TorchDispatchMode):
    """The names of the operations that run."""

    def __init__(self) -> None:
        super().__init__()
        self.names: set[str] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.names.add(func.__name__.split(".")[0])
        return func(*args, **(kwargs or {}))


def test_projection_calls_no_library_of_products_and_copies_nothing_from_the_host() -> None:
    splats, v = random_splats(50, seed=3), views(2)
    tensors = [t.requires_grad_() for t in splats.tensors]
    with Operations() as seen:
        torch.bmm(v.w2c, v.w2c.new_tensor([[[0.0]] * 4] * 2))
    assert {"bmm", "lift_fresh"} <= seen.names, "what is looked for is seen"
    with Operations() as seen:
        made = project(Splats(*tensors), v, CUSTOMARY)
        (made.center.sum() + made.shape.sum()).backward()
    assert "mul" in seen.names and not seen.names & {"bmm", "mm", "addmm", "baddbmm", "lift_fresh"}


def test_a_product_written_out_is_the_product() -> None:
    g = torch.Generator().manual_seed(0)
    a, b = (torch.randn(4, 5, 3, k, generator=g, dtype=torch.float64) for k in (3, 2))
    torch.testing.assert_close(product(a, b), a @ b, rtol=1e-14, atol=1e-14)


def test_what_fails_in_a_kernel_names_it() -> None:
    def blend() -> None: ...

    with pytest.raises(RuntimeError, match="an illegal memory access") as error:
        with naming(SimpleNamespace(py_func=blend)):
            raise RuntimeError("CUDA error: an illegal memory access was encountered")
    assert error.value.__notes__[0].startswith("in the kernel ") and error.value.__notes__[0].endswith("blend")


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
