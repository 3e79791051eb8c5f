"""Gaussians in front of a background against the same Gaussians rendered all at once: equal bits, equal gradients."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from splat_scenes import HARD, random_splats, views
from torch import Tensor

from spike4dgs.benchmark.errors import UserError
from spike4dgs.method.splat import PixelFilter, Splats, Views, cpu, render
from spike4dgs.method.splat.background import Background, Repeated, join
from spike4dgs.method.splat.types import CUSTOMARY


def rows(splats: Splats, index: Tensor) -> Splats:
    return Splats(*(t[index].float() for t in splats.tensors))


BOX = PixelFilter(1 / 12, compensated=True)


def both_ways(splats: Splats, v: Views, moving: Tensor, chosen: list[int], f: PixelFilter = CUSTOMARY) -> None:
    """Compare images and gradients of splats[moving] in front of the others."""
    few = Views(v.w2c[chosen], v.K[chosen], v.width, v.height)
    order = torch.cat([torch.nonzero(~moving)[:, 0], torch.nonzero(moving)[:, 0]])
    everything = [t.requires_grad_() for t in (*rows(splats, order).geometry, rows(splats, order).colors)]
    own = [t.requires_grad_() for t in (*rows(splats, moving).geometry, rows(splats, moving).colors)]
    expected = render(Splats(*everything), few, f, backend="cpu")
    found = Background(rows(splats, ~moving), v, f).render(Splats(*own), chosen)
    assert torch.equal(found.image, expected.image) and torch.equal(found.alpha, expected.alpha)
    n = int((~moving).sum())
    assert torch.equal(found.radii, expected.radii[:, n:])
    g = torch.Generator().manual_seed(1)
    weight, opaque = torch.randn(found.image.shape, generator=g), torch.randn(found.alpha.shape, generator=g)
    for out in (expected, found):
        ((out.image * weight).sum() + (out.alpha * opaque).sum()).backward()
    for a, b in zip(everything, own, strict=True):
        assert torch.equal(a.grad[n:], b.grad)
    assert torch.equal(expected.means2d.grad[:, n:], found.means2d.grad)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 300), st.sampled_from([0.0, 0.02, 0.3, 1.0]), st.sampled_from([1, 2, 3]), st.integers(0, 2**31))
def test_images_and_gradients_are_those_of_all_at_once(n: int, share: float, channels: int, seed: int) -> None:
    moving = torch.rand(n, generator=torch.Generator().manual_seed(seed)) < share
    both_ways(random_splats(n, channels, seed=seed), views(3), moving, [2, 0])


@pytest.mark.parametrize("pixel_filter", [PixelFilter(), BOX], ids=["customary", "box"])
@pytest.mark.parametrize("scene", HARD)
def test_hard_scenes(scene, pixel_filter: PixelFilter) -> None:  # type: ignore[no-untyped-def]
    splats, v = scene()
    moving = torch.arange(len(splats)) % 3 == 0
    both_ways(splats, v, moving, [0], pixel_filter)


@pytest.mark.parametrize("lanes", sorted({8, cpu.host_lanes()}))
@pytest.mark.parametrize("size", [1e-3, 1e-2, 0.1])
def test_few_in_front_of_many(size: float, lanes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Below a pixel to tens of them, across the edges of tiles and of the image, on pixels' centres and borders."""
    monkeypatch.setattr(cpu, "host_lanes", lambda: lanes)
    many, v = random_splats(400, seed=3), views(1)
    pixels = [(64.0, 32.0), (63.5, 31.5), (0.0, 0.0), (99.5, 69.5), (-3.0, 40.0), (71.5, 33.0), (20.5, 64.0)]
    for few in (pixels[:1], pixels[1:2], pixels[2:4], pixels[4:], pixels):
        at = torch.tensor([(x, y, 1.0) for x, y in few], dtype=torch.float64) @ torch.linalg.inv(v.K[0]).T
        n = len(few)
        means, scales = torch.cat([many.means, 3 * at]), torch.cat([many.scales, torch.full((n, 3), size).double()])
        quats, opacities, colors = (torch.cat([t, t[:n]]) for t in (many.quats, many.opacities, many.colors))
        moving = torch.arange(400 + n) >= 400
        both_ways(Splats(means, quats, scales, opacities, colors), v, moving, [0], BOX)


def test_a_background_serves_many_renders() -> None:
    splats, v = random_splats(100, seed=5), views(2)
    static = torch.arange(100) < 60
    background = Background(rows(splats, static), v)
    first = [background.render(rows(random_splats(30, seed=s), torch.arange(30)), [0, 1]).image for s in (1, 2, 1)]
    assert torch.equal(first[0], first[2]) and not torch.equal(first[0], first[1])
    assert len(background) == 60


def test_a_view_that_comes_back_gets_a_background_of_its_own() -> None:
    splats, v = rows(random_splats(60, seed=5), torch.arange(60)), views(Repeated.MOST + 1)
    one = [Views(v.w2c[[i]], v.K[[i]], v.width, v.height) for i in range(len(v))]
    repeated = Repeated(splats, BOX)
    assert repeated.in_view(one[0]) is None
    kept = repeated.in_view(Views(v.w2c[:1].clone(), v.K[:1].clone(), v.width, v.height))
    assert kept is not None and repeated.in_view(one[0]) is kept, "the same camera, whichever object says so"
    moving = rows(random_splats(30, seed=1), torch.arange(30))
    expected = render(join(splats, moving), one[0], BOX, backend="cpu")
    assert torch.equal(kept.render(moving, [0]).image, expected.image)
    assert repeated.in_view(Views(v.w2c[:1], v.K[:1], v.width, v.height - 1)) is None, "another size"
    assert all(repeated.in_view(view) is None for view in one[1:]), "each of them is seen once"
    assert repeated.in_view(one[0]) is None, "too long ago"


def test_another_number_of_channels_is_refused() -> None:
    background = Background(random_splats(20, channels=1), views(1))
    with pytest.raises(UserError, match="expected 1 channels, as the background has, found 2"):
        background.render(random_splats(20, channels=2), [0])


def test_values_that_are_not_finite_are_refused() -> None:
    splats, v = rows(random_splats(20, seed=3), torch.arange(20)), views(1)
    background = Background(splats, v)
    for name in ("means", "colors"):
        bad = {n: getattr(splats, n).clone() for n in ("means", "quats", "scales", "opacities", "colors")}
        bad[name][3, 0] = float("nan")
        with pytest.raises(UserError, match="finite"):
            background.render(Splats(**bad), [0])
