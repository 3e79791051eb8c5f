"""The DPT head: its exponentials, and the order of its layers."""

from __future__ import annotations

import numpy as np
import torch

from spike4dgs.method.msdi.layers import Fusion, unpack


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
