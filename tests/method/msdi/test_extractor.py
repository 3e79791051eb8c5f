"""The blind-spot extractor against loops, and the image generator."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from spike4dgs.method.msdi.extractor import ImageGenerator, SpikeExtractor

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
