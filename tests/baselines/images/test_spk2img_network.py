"""Spk2ImgNet's parts against explicit loops, and what the network may see of its window."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F  # noqa: N812

from spike4dgs.baselines.images.spk2img.deformable import DeformableConv, convolve, deformable_conv
from spike4dgs.baselines.images.spk2img.network import Extractor, Spk2ImgNet
from spike4dgs.method.images.base import mirrored


def slow_deformable_conv(x: Tensor, offsets: Tensor, masks: Tensor, weight: Tensor, bias: Tensor) -> np.ndarray:
    """From the definition, sample by sample, in float64."""
    x, offsets, masks, weight, bias = (t.detach().double().numpy() for t in (x, offsets, masks, weight, bias))
    batch, channels, height, width = x.shape
    groups = offsets.shape[1]

    def read(image: np.ndarray, v: float, u: float) -> float:
        top, left = math.floor(v), math.floor(u)
        total = 0.0
        for row, column in ((top, left), (top, left + 1), (top + 1, left), (top + 1, left + 1)):
            if 0 <= row < height and 0 <= column < width:
                total += (1 - abs(v - row)) * (1 - abs(u - column)) * image[row, column]
        return total

    out = np.zeros((batch, len(weight), height, width))
    for b, o, row, column in np.ndindex(out.shape):
        total = bias[o]
        for c in range(channels):
            g = c // (channels // groups)
            for k in range(9):
                dy, dx = k // 3 - 1, k % 3 - 1
                right, down = offsets[b, g, k, :, row, column]
                sample = read(x[b, c], row + dy + down, column + dx + right)
                total += weight[o, c, dy + 1, dx + 1] * masks[b, g, k, row, column] * sample
        out[b, o, row, column] = total
    return out


def random_case(groups: int, height: int, width: int, reach: float, dtype: torch.dtype) -> tuple[Tensor, ...]:
    rng = torch.Generator().manual_seed(groups + height)
    channels = 2 * groups

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng, dtype=dtype)

    masks = torch.rand(2, groups, 9, height, width, generator=rng, dtype=dtype)
    offsets = reach * draw(2, groups, 9, 2, height, width)
    return draw(2, channels, height, width), offsets, masks, draw(3, channels, 3, 3), draw(3)


@pytest.mark.parametrize(
    ("groups", "height", "width", "reach", "even"),
    [(1, 4, 5, 0.5, False), (2, 5, 3, 3.0, False), (3, 1, 4, 1.0, False), (2, 3, 1, 20.0, False), (2, 4, 6, 1.0, True)],
)
def test_deformable_convolution_equals_the_loop(groups: int, height: int, width: int, reach: float, even: bool) -> None:
    """Small offsets, ones beyond the image, images one pixel high or wide, and offsets onto pixel centres."""
    x, offsets, *others = random_case(groups, height, width, reach, torch.float64)
    case = x, offsets.round().clamp(-1, 2) if even else offsets, *others
    expected = slow_deformable_conv(*case)
    np.testing.assert_allclose(deformable_conv(*case).numpy(), expected, rtol=1e-9, atol=1e-9)
    single = deformable_conv(*(t.float() for t in case)).numpy()
    np.testing.assert_allclose(single, expected, atol=2e-5 * (1 + reach))


def test_without_offsets_it_is_a_convolution() -> None:
    x, offsets, masks, weight, bias = random_case(2, 7, 9, 0.0, torch.float64)
    plain = F.conv2d(x, weight, bias, padding=1)
    torch.testing.assert_close(deformable_conv(x, offsets, torch.ones_like(masks), weight, bias), plain)
    half = F.conv2d(x, weight / 2, bias, padding=1)
    layer = DeformableConv(4, groups=2).double()
    torch.testing.assert_close(
        layer(x, x), F.conv2d(x, layer.weight / 2, layer.bias, padding=1), msg="guides start at zero: masks of 1/2"
    )
    torch.testing.assert_close(deformable_conv(x, offsets, torch.full_like(masks, 0.5), weight, bias), half)


def test_deformable_gradients() -> None:
    leaves = [t.requires_grad_() for t in random_case(2, 3, 4, 0.3, torch.float64)]
    assert torch.autograd.gradcheck(deformable_conv, leaves, atol=1e-6)


@pytest.mark.parametrize("channels_last", [False, True])
@pytest.mark.parametrize(
    ("groups", "height", "width", "reach"), [(1, 5, 6, 0.7), (2, 4, 3, 3.0), (1, 1, 4, 1.0), (1, 3, 1, 1e12)]
)
def test_the_kernel_for_inference_equals_the_loop(
    groups: int, height: int, width: int, reach: float, channels_last: bool
) -> None:
    rng = torch.Generator().manual_seed(7)
    layer = DeformableConv(8 * groups, groups)
    x = torch.randn(2, 8 * groups, height, width, generator=rng)
    found = torch.randn(2, groups * 27, height, width, generator=rng)
    split = groups * 18
    found[:, :split] *= reach
    found[:, 0] = found[:, 0].round()  # pixel centres, and places just at the border
    if channels_last:
        x, found = (t.to(memory_format=torch.channels_last) for t in (x, found))
    offsets = found[:, :split].reshape(2, groups, 9, 2, height, width)
    masks = torch.sigmoid(found[:, split:]).reshape(2, groups, 9, height, width)
    with torch.inference_mode():
        fast = convolve(x, found, layer.weight, layer.bias).numpy()
    np.testing.assert_allclose(fast, slow_deformable_conv(x, offsets, masks, layer.weight, layer.bias), atol=2e-5)


def test_a_layer_gives_the_same_with_and_without_gradients() -> None:
    layer = DeformableConv(16, groups=2)
    torch.nn.init.normal_(layer.guide.weight, std=0.2, generator=torch.Generator().manual_seed(1))
    x, guide = torch.randn(2, 2, 16, 9, 7, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        fast = layer(x, guide)
    torch.testing.assert_close(fast, layer(x, guide).detach(), atol=2e-5, rtol=1e-5)
    x[0, 3, 2, 2] = torch.nan  # must not become an address
    with torch.no_grad():
        assert layer(guide, x).isnan().any()


@pytest.mark.parametrize("n", [1, 2, 5, 9])
def test_mirroring_is_numpys_symmetric_padding(n: int) -> None:
    values = np.arange(n)
    expected = np.pad(values, 23, mode="symmetric")
    np.testing.assert_array_equal(values[mirrored(np.arange(-23, n + 23), n)], expected)


def count(module: torch.nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def test_parameters_of_the_published_width() -> None:
    network = Spk2ImgNet(64)
    assert count(network) == 3_904_185
    assert count(network.extract) == 1_117_200
    assert count(network.align) == 1_532_000
    assert [count(m) for m in network.masks] == [147_650] * 4


def awake(width: int = 8) -> Spk2ImgNet:
    """A network whose deformable guides do not start at zero."""
    torch.manual_seed(3)
    network = Spk2ImgNet(width).double()
    for name, p in network.named_parameters():
        if "align.guide" in name:
            torch.nn.init.normal_(p, std=0.05)
    return network


def seen(value: Tensor, spikes: Tensor) -> list[int]:
    """Ticks of the window whose spikes change `value`."""
    (gradient,) = torch.autograd.grad(value, spikes, retain_graph=True)
    return torch.nonzero(gradient.abs().sum(dim=(0, 2, 3))).flatten().tolist()


def test_receptive_field_in_time() -> None:
    """The image depends on all 41 ticks; the branches' estimates on the middle 13, 11, 9, 7 of their block alone."""
    spikes = torch.rand(1, 41, 12, 16, dtype=torch.float64, requires_grad=True)
    found = awake()(spikes)
    assert found.rate.shape == (1, 12, 16) and found.estimates.shape == (1, 5, 4, 12, 16)
    assert seen(found.rate.sum(), spikes) == list(range(41))
    for k, centre in enumerate((6, 13, 20, 27, 34)):
        for branch, half in enumerate((6, 5, 4, 3)):
            ticks = seen(found.estimates[0, k, branch].sum(), spikes)
            assert ticks == list(range(centre - half, centre + half + 1)), (k, branch)


def test_features_of_a_block_depend_on_its_ticks_alone() -> None:
    torch.manual_seed(0)
    block = torch.rand(1, 13, 6, 6, requires_grad=True)
    features, _ = Extractor(8)(block)
    assert seen(features.sum(), block) == list(range(13))


@pytest.mark.parametrize(("height", "width"), [(8, 12), (9, 12), (10, 11), (7, 5), (2, 3)])
def test_any_size_gives_what_its_mirrored_image_gives(height: int, width: int) -> None:
    """The network on a padded image, cut by hand; numpy does the padding."""
    network = awake()
    spikes = torch.rand(2, 41, height, width, dtype=torch.float64)
    above, left = -height % 4 // 2, -width % 4 // 2
    sides = ((0, 0), (0, 0), (above, -height % 4 - above), (left, -width % 4 - left))
    padded = torch.from_numpy(np.pad(spikes.numpy(), sides, mode="symmetric"))
    assert padded.shape[2] % 4 == padded.shape[3] % 4 == 0
    with torch.inference_mode():
        found, whole = network(spikes), network(padded)
    assert found.rate.shape == (2, height, width)
    torch.testing.assert_close(found.rate, whole.rate[:, above : above + height, left : left + width])
    torch.testing.assert_close(found.estimates, whole.estimates[..., above : above + height, left : left + width])


def test_images_of_a_batch_do_not_mix() -> None:
    network = awake()
    spikes = torch.rand(3, 41, 8, 8, dtype=torch.float64)
    with torch.inference_mode():
        together = network(spikes)
        for k in range(3):
            alone = network(spikes[k : k + 1])
            torch.testing.assert_close(together.rate[k], alone.rate[0])
            torch.testing.assert_close(together.estimates[k], alone.estimates[0])
