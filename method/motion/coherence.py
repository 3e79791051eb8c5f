"""Motion coherence: neighbouring Gaussians share their motion where the images do not say otherwise.

On a flat surface no image says where a Gaussian goes. Left alone it stays where it is while the object moves on, and
takes up whatever is fixed to the pixels: noise of a sensor, or of a renderer. With the coefficients m_i of its path,

    sum over i of sqrt(|d_i|^2 + e^2) - e,    d_i = p_i W (m_i - mean of m_j over the nearest neighbours j of i)

is how far the paths depart from their neighbours', in pixels: W are the shares of displacement that the coefficients
have at the clip's ends, p_i the pixels per metre at the Gaussian. It is the motion coherence of Yuille and Grzywacz
(1988) on a graph. d_i is zero for a motion that is linear in space, like a rotation's velocities, where neighbours lie
around i; and the sum grows linearly, so that parts may move apart. Neighbours are those of the positions at rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from spike4dgs.method.gaussians.parameters import Gaussians, nearest
from spike4dgs.method.splat import Views
from spike4dgs.method.splat.kernels.jit import kernel
from spike4dgs.method.splat.kernels.threads import ITEM, run_items
from spike4dgs.method.splat.kernels.vector_ir import fetch_add
from spike4dgs.method.splat.types import NEAR

CUBIC = 9  # m1, m2 and m3 of a path in space
NEAREST = 6
EASE = 0.1  # e, px: below it the pull weakens
SHARES = (0.5,) * 3 + (0.25,) * 3 + (0.125,) * 3  # of m1, m2 and m3 half a clip away
_SHARES = np.asarray(SHARES, np.float32)


@dataclass(frozen=True, eq=False)
class Neighbours:
    """The neighbours of Gaussians and what a metre is in pixels."""

    index: Tensor  # int64 [N, K]; K = 0 where there are too few Gaussians
    pixels: Tensor  # float32 [N], px per metre in the first view

    @cached_property
    def pulling(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Who pulls at each Gaussian, itself and those whose neighbour it is, ascending.

        They are `second[first[i] : first[i + 1]]` for Gaussian i.
        """
        n, k = self.index.shape
        pulled = np.concatenate([self.index.numpy().ravel(), np.arange(n)])
        who = np.concatenate([np.repeat(np.arange(n), k), np.arange(n)])
        first = np.concatenate([[0], np.bincount(pulled, minlength=n).cumsum()])
        return first, who[np.lexsort((who, pulled))]


class Coherence:
    """The term of a fit: a `weight` in white by which a pixel's loss would pay for a departure of one pixel."""

    def __init__(self, weight: float, views: Views) -> None:
        self.weight, self.views = weight / (views.width * views.height), views
        self.near: Neighbours | None = None

    def __call__(self, gaussians: Gaussians) -> Tensor:
        """Return the term. The neighbours are those of the first call, until they are forgotten."""
        if not self.weight:
            return torch.zeros(())
        if self.near is None:
            self.near = neighbours(gaussians.means, self.views)
        return self.weight * incoherence(gaussians.extra["coefficients"], self.near)

    def forget(self) -> None:
        """Find the neighbours anew at the next call: Gaussians were added or removed."""
        self.near = None

    def state(self) -> dict[str, Tensor]:
        """Return the neighbours, on which later steps depend; nothing where there are none."""
        return {"index": self.near.index, "pixels": self.near.pixels} if self.near else {}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Go on with the neighbours of a `state`."""
        self.near = Neighbours(**state) if state else None


def neighbours(means: Tensor, views: Views) -> Neighbours:
    """Return the `NEAREST` neighbours of Gaussians at `means` [N, 3]; none where there are no more than these."""
    x = means.detach()
    depth = x @ views.w2c[0, 2, :3].to(x) + views.w2c[0, 2, 3].to(x)
    # What is nearer than the near plane, or behind the view, is not rendered: as if it were far away.
    pixels = torch.where(depth > NEAR, views.K[0, 0, 0].to(x) / depth, 0.0)
    if len(x) <= NEAREST:
        return Neighbours(torch.zeros(len(x), 0, dtype=torch.int64, device=x.device), pixels)
    return Neighbours(nearest(x, NEAREST)[0], pixels)


def incoherence(coefficients: Tensor, near: Neighbours) -> Tensor:
    """Return the sum of the module's text, in pixels, for the coefficients [N, 9] of cubic paths; differentiable."""
    if near.index.shape[1] == 0:
        return coefficients.sum() * 0.0
    if coefficients.device.type != "cpu" or coefficients.dtype != torch.float32:
        return incoherence_reference(coefficients, near)
    value: Tensor = _Incoherence.apply(coefficients, near)  # type: ignore[no-untyped-call]
    return value


def incoherence_reference(coefficients: Tensor, near: Neighbours) -> Tensor:
    """Return the same by plain torch, in the precision of the input: the twin of the kernel."""
    shares = torch.tensor(SHARES).to(coefficients)
    departure = (coefficients - coefficients[near.index].mean(1)) * shares * near.pixels.to(coefficients)[:, None]
    return ((departure.square().sum(1) + EASE**2).sqrt() - EASE).sum()


class _Incoherence(torch.autograd.Function):
    """The gradient is computed with the value: they share the neighbours' means."""

    @staticmethod
    def forward(ctx: Any, coefficients: Tensor, near: Neighbours) -> Tensor:
        m, index, pixels = coefficients.detach().contiguous().numpy(), near.index.numpy(), near.pixels.numpy()
        own, others, gradient = (np.empty_like(m) for _ in range(3))
        lengths = np.empty(len(m))
        run_items(_departures, (m, index, pixels, _SHARES, np.float32(EASE), own, others, lengths), len(m))
        run_items(_gradient, (own, others, *near.pulling, gradient), len(m))
        ctx.save_for_backward(torch.from_numpy(gradient))
        return torch.tensor(lengths.sum(), dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, *outer: Tensor) -> tuple[Tensor, None]:
        return ctx.saved_tensors[0] * outer[0], None


@kernel
def _departures(  # type: ignore[no-untyped-def]
    m, index, pixels, shares, ease, own, others, lengths, counter
):
    """Fill each Gaussian's part of the sum, and its slopes in the Gaussian's and in each neighbour's coefficients."""
    departure, part = np.empty(CUBIC, np.float32), np.float32(1 / NEAREST)
    while True:
        begin = fetch_add(counter, 0, 1) * ITEM
        if begin >= len(m):
            return
        for i in range(begin, min(begin + ITEM, len(m))):
            departure[:] = 0
            for j in range(NEAREST):
                at = index[i, j]
                for c in range(CUBIC):
                    departure[c] += m[at, c]
            square = ease * ease
            for c in range(CUBIC):
                departure[c] = (m[i, c] - departure[c] * part) * shares[c] * pixels[i]
                square += departure[c] * departure[c]
            length = np.sqrt(square)
            lengths[i] = length - ease
            for c in range(CUBIC):
                own[i, c] = departure[c] * shares[c] * pixels[i] / length
                others[i, c] = own[i, c] * part


@kernel
def _gradient(own, others, first, who, gradient, counter):  # type: ignore[no-untyped-def]
    """Sum up each Gaussian's gradient over who pulls at it."""
    total = np.empty(CUBIC, np.float32)
    while True:
        begin = fetch_add(counter, 0, 1) * ITEM
        if begin >= len(own):
            return
        for i in range(begin, min(begin + ITEM, len(own))):
            total[:] = 0
            for k in range(first[i], first[i + 1]):
                j = who[k]
                if j == i:
                    for c in range(CUBIC):
                        total[c] += own[i, c]
                else:
                    for c in range(CUBIC):
                        total[c] -= others[j, c]
            gradient[i] = total
