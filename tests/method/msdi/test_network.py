"""MSDI's network, its extractor and its layers."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from toy_world import ToyWorld

from spike4dgs.benchmark.errors import UserError
from spike4dgs.method.msdi import PAPER, SMALL, TINY, Msdi
from spike4dgs.method.msdi import network as module
from spike4dgs.method.msdi.extractor import ImageGenerator, SpikeExtractor
from spike4dgs.method.msdi.layers import Fusion, unpack
from spike4dgs.method.msdi.losses import image_loss, point_loss
from spike4dgs.method.msdi.network import has_bfloat16, margins, ray_map, view_numbers


def test_output_is_unpacked_by_the_exponentials_and_bounded() -> None:
    raw = torch.tensor([0.3, -0.4, 1.2, 0.7]).view(1, 4, 1, 1)
    points, confidence = unpack(raw)
    assert torch.allclose(points[0, 0, 0], raw[0, :3, 0, 0] / 1.3 * (np.exp(1.3) - 1))
    assert torch.allclose(confidence, 1 + torch.tensor(0.7).exp())
    for value in (0.0, 1e5, -1e5):
        x = torch.full((1, 4, 1, 1), value, requires_grad=True)
        points, confidence = unpack(x)
        (points.sum() + confidence.log().sum()).backward()
        assert points.isfinite().all() and confidence.isfinite().all() and x.grad is not None
        assert x.grad.isfinite().all()
    assert unpack(raw.to(torch.bfloat16))[0].dtype == torch.float32


def test_head_doubles_after_its_last_layer_as_well_as_before() -> None:
    torch.manual_seed(0)
    fuse, x, finer = Fusion(4), torch.rand(1, 4, 3, 5), torch.rand(1, 4, 3, 5)
    y = fuse.resConfUnit2(x + fuse.resConfUnit1(finer))
    published = fuse.out_conv(torch.nn.functional.interpolate(y, scale_factor=2, mode="bilinear", align_corners=True))
    assert torch.allclose(fuse(x, finer), published, atol=1e-6)


PIXELS = ((0, 0), (0, 11), (7, 0), (7, 11), (0, 5), (7, 6), (3, 0), (4, 11), (3, 5), (4, 6), (5, 7))


@pytest.mark.parametrize("widths", [(5,), (4, 6), (4, 5, 6)])
def test_features_of_a_pixel_have_exactly_no_gradient_to_its_own_spikes(widths: tuple[int, ...]) -> None:
    torch.manual_seed(1)
    extractor = SpikeExtractor(3, widths)
    x = torch.rand(1, 3, 8, 12, requires_grad=True)
    features = extractor(x)
    assert features.shape == (1, 4 * widths[0], 8, 12)
    weights = torch.rand(4 * widths[0])
    for v, u in PIXELS:
        (slope,) = torch.autograd.grad((weights * features[0, :, v, u]).sum(), x, retain_graph=True)
        assert (slope[0, :, v, u] == 0).all()
        near = slope[0, :, max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2].abs().sum(dim=0)
        assert int((near > 0).sum()) == near.numel() - 1  # every neighbour is seen
    far = torch.autograd.grad((weights * features[0, :, 4, 5]).sum(), x)[0].abs().sum(dim=(0, 1)) > 0
    rows = far.any(dim=1).nonzero()
    assert (len(widths) == 1) == (rows.max() - rows.min() == 6)  # a single layer reaches 3 rows each way


def test_one_layer_equals_loops_in_float64() -> None:
    torch.manual_seed(2)
    ticks, width, rows, columns = 2, 3, 5, 7
    extractor = SpikeExtractor(ticks, (width,)).double()
    x = torch.rand(1, ticks, rows, columns, dtype=torch.float64)
    conv = extractor.upward.down[0].conv  # type: ignore[union-attr]
    torch.nn.init.normal_(conv.bias)  # type: ignore[arg-type]
    kernel, bias, s = conv.weight.detach().numpy(), conv.bias.detach().numpy(), x[0].numpy()  # type: ignore[union-attr]

    def turned(step: tuple[int, int], quarter: int) -> tuple[int, int]:
        """Return a step (down, right) in the stream turned by quarters, as a step in the stream itself."""
        for _ in range(quarter):
            step = (step[1], -step[0])
        return step

    expected = np.zeros((4 * width, rows, columns))
    for quarter in range(4):
        for v in range(rows):
            for u in range(columns):
                above = np.add((v, u), turned((-1, 0), quarter))
                if not (0 <= above[0] < rows and 0 <= above[1] < columns):
                    continue  # nothing lies above: the shift brought in a zero
                for o in range(width):
                    total = bias[o]
                    for i in range(3):
                        for j in range(3):
                            y, z = np.add((v, u), turned((i - 3, j - 1), quarter))
                            if 0 <= y < rows and 0 <= z < columns:
                                total += sum(kernel[o, t, i, j] * s[t, y, z] for t in range(ticks))
                    expected[quarter * width + o, v, u] = total if total > 0 else 0.1 * total
    with torch.no_grad():
        found = extractor(x)[0].numpy()
    assert np.abs(found - expected).max() < 1e-12


def test_generator_is_three_layers_on_single_pixels() -> None:
    torch.manual_seed(0)
    generator = ImageGenerator(6, (5, 4), 3).double()
    f, s = torch.rand(1, 6, 4, 5, dtype=torch.float64), torch.rand(1, 3, 4, 5, dtype=torch.float64)
    x = torch.cat([f[0, :, 2, 3], s[0, :, 2, 3]])
    for k, layer in enumerate(generator.layers):
        x = layer.weight[:, :, 0, 0] @ x + layer.bias  # type: ignore[operator, index]
        x = torch.where(x > 0, x, 0.1 * x) if k < 2 else x
    assert len(generator.layers) == 3 and torch.allclose(generator(f, s)[0, 2, 3], x[0])


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    """Use one thread: tiny layers on many threads wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def spikes(*shape: int, seed: int = 0) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    return (torch.rand(*shape, generator=g) < 0.4).float()


def tiny(seed: int = 0, **changes: object) -> Msdi:
    torch.manual_seed(seed)
    return Msdi(replace(TINY, **changes)).eval()  # type: ignore[arg-type]


@pytest.mark.parametrize("sees", [True, False])
def test_image_depends_on_the_pixels_own_spikes_only_if_configured(sees: bool) -> None:
    network = tiny(generator_sees_pixel=sees)
    x = torch.rand(1, 9, 13, 18, requires_grad=True)
    for v, u in ((0, 0), (12, 17), (6, 8)):
        (slope,) = torch.autograd.grad(network.images(x)[0, v, u], x)
        assert bool((slope[0, :, v, u] != 0).any()) == sees and (slope != 0).any()


@pytest.mark.parametrize("patch", [16, 8])
@pytest.mark.parametrize("size", [(25, 40), (16, 32), (33, 17), (7, 5)])
def test_any_size_is_kept(size: tuple[int, int], patch: int) -> None:
    network = tiny(patch=patch)
    x = spikes(1, 2, 9, *size).requires_grad_()
    out = network(x)
    assert out.points.shape == (1, 2, *size, 3) and out.confidence.shape == out.images.shape == (1, 2, *size)
    (out.points.sum() + out.images.sum()).backward()
    assert x.grad is not None and (x.grad.abs().sum(dim=2) > 0).all()  # each pixel counts: nothing is cropped
    around = margins(*size, patch)
    by_hand = torch.zeros(2, 9, *(-(-n // patch) * patch for n in size))
    by_hand[..., around.top : around.top + size[0], around.left : around.left + size[1]] = x[0].detach()
    with torch.no_grad():
        whole = network.images(by_hand)
    cut = whole[:, around.top : around.top + size[0], around.left : around.left + size[1]]
    assert torch.allclose(out.images[0], cut, atol=1e-6)


def test_the_papers_size_is_padded() -> None:
    around = margins(250, 400, 16)
    assert (around.top, around.bottom, around.left, around.right) == (3, 3, 0, 0)
    assert tiny().images(spikes(1, 9, 250, 400)).shape == (1, 250, 400)


def test_views_see_each_other_and_samples_do_not() -> None:
    network, x = tiny(), spikes(2, 3, 9, 16, 32)
    with torch.no_grad():
        both, other = network(x), x.clone()
        other[0, 2] = spikes(9, 16, 32, seed=5)
        changed = network(other)
        alone = network(x[1:])
    assert (both.points[0] - changed.points[0]).abs().amax(dim=(1, 2, 3)).min() > 1e-5  # all views of the sample
    assert torch.equal(both.images[0, :2], changed.images[0, :2])  # images are each view's own
    assert torch.allclose(both.points[1], changed.points[1]) and torch.allclose(
        both.points[1:], alone.points, atol=1e-5
    )


def test_views_differ_by_their_numbers_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    network, x = tiny(), spikes(1, 3, 9, 16, 32)
    x[0, 2] = x[0, 1]
    order = [0, 2, 1]
    with torch.no_grad():
        out = network(x)
        assert not torch.allclose(out.points[0, 1], out.points[0, 2])  # the same stream under two numbers
        x[0, 2] = spikes(9, 16, 32, seed=7)
        out = network(x)
        numbers = view_numbers(1, 3, shuffled=False)
        monkeypatch.setattr(module, "view_numbers", lambda *_, **__: numbers[:, order])
        swapped = network(x[:, order])
    assert torch.allclose(swapped.points, out.points[:, order], atol=1e-5)  # weights are shared, order means nothing


def test_numbers_of_views() -> None:
    torch.manual_seed(3)
    shuffled = view_numbers(40, 9, shuffled=True)
    assert shuffled.shape == (40, 9) and (shuffled[:, 0] == 0).all()
    assert all(len(set(row.tolist())) == 9 for row in shuffled)
    assert shuffled[:, 1:].min() >= 1 and shuffled.max() <= 999 and shuffled.max() > 900
    assert not torch.equal(shuffled[0], shuffled[1])
    torch.manual_seed(3)
    assert torch.equal(view_numbers(40, 9, shuffled=True), shuffled)
    for views in (1, 2, 9, 1000):
        fixed = view_numbers(2, views, shuffled=False)
        assert torch.equal(fixed[0], fixed[1]) and len(set(fixed[0].tolist())) == views
        assert fixed[0, 0] == 0 and fixed.max() <= 999
    with pytest.raises(UserError, match="1 to 1000 views, found 1001"):
        view_numbers(1, 1001, shuffled=False)


def test_inference_is_deterministic_and_training_shuffles_numbers() -> None:
    network, x = tiny(), spikes(1, 3, 9, 16, 32)
    with torch.no_grad():
        assert torch.equal(network(x).points, network(x).points)
        network.train()
        assert not torch.equal(network(x).points, network(x).points)


def test_rays_are_those_of_the_cameras() -> None:
    cameras = ToyWorld(width=20, height=12).cameras[:2]
    K = torch.tensor(np.stack([c.K for c in cameras]))[None]
    rays = ray_map(K, 2, 12, 20, torch.zeros(1))
    assert rays.dtype == torch.float32 and (rays[:, 2] == 1).all()
    point = cameras[1].R.T @ (np.array([*rays[1, :2, 4, 7].tolist(), 1.0]) - cameras[1].t)
    assert np.allclose(cameras[1].project(point[None])[0], [7.5, 4.5], atol=1e-4)
    unknown = ray_map(None, 2, 12, 20, torch.zeros(1))
    assert unknown.shape == rays.shape and (unknown[:, 2] == 0).all()
    assert torch.allclose(unknown[0, :2, 0, 0], torch.tensor([-9.5 / 20, -5.5 / 20]))


def test_known_intrinsics_count_once_their_embedding_is_trained() -> None:
    network, x = tiny(), spikes(1, 2, 9, 16, 32)
    K = torch.tensor([[40.0, 0, 16], [0, 40, 8], [0, 0, 1]]).expand(1, 2, 3, 3)
    with torch.no_grad():
        assert torch.equal(network(x, K).points, network(x).points)  # pre-trained layers start undisturbed
        torch.nn.init.normal_(network.encoder.ray_embed.weight, std=0.1)
        known = network(x, K)
        assert not torch.allclose(known.points, network(x).points)
        assert not torch.allclose(known.points, network(x, 2 * K).points)
        assert torch.equal(known.images, network(x).images)


def test_shapes_that_do_not_fit_are_refused() -> None:
    network = tiny()
    with pytest.raises(UserError, match=r"spikes \[samples, views, 9, height, width\], found \[1, 2, 8, 16, 32\]"):
        network(spikes(1, 2, 8, 16, 32))
    with pytest.raises(UserError, match=r"found \[2, 9, 16, 32\]"):
        network(spikes(2, 9, 16, 32))
    with pytest.raises(UserError, match=r"intrinsics \[1, 2, 3, 3\], found \[2, 3, 3\]"):
        network(spikes(1, 2, 9, 16, 32), torch.eye(3).expand(2, 3, 3))


@pytest.mark.parametrize("views", [1, 3, 11])
def test_float32_agrees_with_float64(views: int) -> None:
    network, x = tiny(), spikes(1, views, 9, 25, 40)
    with torch.no_grad():
        single = network(x)
        double = network.double()(x.double())
    assert double.points.dtype == torch.float64
    for name in ("points", "confidence", "images"):
        a, b = getattr(single, name), getattr(double, name)
        assert (a - b).abs().max() < 1e-4 * (1 + b.abs().max()), name


@pytest.mark.parametrize("case", ["dark", "saturated", "one view dark", "nan in a view", "identical views"])
def test_hard_streams_leave_everything_finite(case: str) -> None:
    network = tiny().train()
    x = spikes(1, 3, 9, 16, 32)
    if case == "dark":
        x[:] = 0
    elif case == "saturated":
        x[:] = 1
    elif case == "one view dark":
        x[0, 1] = 0
    elif case == "nan in a view":
        x[0, 1, 3] = torch.nan
        x[0, 1, 4] = torch.inf
    else:
        x[:] = x[:, :1]
    out = network(x)
    truth = torch.rand_like(out.points)
    loss = point_loss(out.points, out.confidence, truth)
    (loss + image_loss(out.images, torch.zeros_like(out.images))).backward()
    assert all(t.isfinite().all() for t in (out.points, out.confidence, out.images, loss))
    assert all(p.grad is None or p.grad.isfinite().all() for p in network.parameters())


def test_integer_streams_are_the_same() -> None:
    network, x = tiny(), spikes(1, 2, 9, 16, 32)
    with torch.no_grad():
        out = network(x)
        assert torch.equal(network(x.to(torch.uint8)).points, out.points)
        assert torch.equal(network(x.bool()).images, out.images)


def test_sizes_are_those_of_the_papers_parts_and_of_the_budget() -> None:
    with torch.device("meta"):
        paper, small = Msdi(PAPER), Msdi(SMALL)

    def count(part: torch.nn.Module) -> int:
        return sum(p.numel() for p in part.parameters())

    layers = 24 * (12 * 1024**2 + 13 * 1024)  # ViT-L: 302 M
    assert count(paper.encoder.blocks) == count(paper.fusion.blocks) == layers
    assert tuple(paper.encoder.patch_embed.weight.shape) == (1024, 3, 16, 16)
    assert len(paper.fusion.blocks) == len(small.fusion.blocks) == 24
    assert 5e6 < count(small) < 15e6


@pytest.mark.parametrize(("capability", "units"), [((7, 5), False), ((8, 0), True), ((12, 0), True)])
def test_bfloat16_is_for_gpus_that_have_units_for_it(capability: tuple[int, int], units: bool, monkeypatch) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: capability)
    has_bfloat16.cache_clear()
    assert has_bfloat16(torch.device("cuda", 0)) is units
    has_bfloat16.cache_clear()
