"""Pixels that are no numbers neither count nor pull."""

from __future__ import annotations

import math

import torch

from spike4dgs.method.supervision.base import difference


def test_unknown_pixels_have_no_gradient_and_known_ones_have_theirs() -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(2, 24, 30, generator=generator)
    rendered = torch.rand(2, 24, 30, generator=generator).requires_grad_(True)
    unknown = torch.zeros(2, 24, 30, dtype=torch.bool)
    unknown[:, :, 22:] = True
    difference(rendered, image.masked_fill(unknown, math.nan), 0.2).backward()
    part = rendered.grad.clone()
    assert (part[unknown] == 0).all() and (part[~unknown] != 0).all()
    rendered.grad = None
    difference(rendered, image, 0.2).backward()
    far = torch.zeros_like(unknown)
    far[:, :, : 22 - 11] = True  # further than SSIM's window from what is unknown
    torch.testing.assert_close(part[far], rendered.grad[far])
