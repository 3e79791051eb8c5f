"""A three-layer perceptron; on the CPU in blocks of rows that stay in the cache, on two threads of our own.

Torch's layers write every activation to memory and back, and torch's threads cannot be used beside the rasteriser's
(see `torch_state.one_torch_thread`): 34 against 42 CPU-ms for 13,000 rows of width 64, value and gradients, and on both
cores. The twin is the same three layers in plain torch.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from spike4dgs.method.two_threads import on_two_threads

BLOCK = 512  # rows: 512 x 384 activations are 0.8 MB, within a core's second-level cache


def _in_parts(rows: int, work: Callable[[list[slice]], Any]) -> tuple[Any, Any]:
    """Call `work` on each half of the blocks of rows: two on any number of cores, so that sums keep their order."""
    blocks = [slice(a, min(a + BLOCK, rows)) for a in range(0, rows, BLOCK)]
    cut = (len(blocks) + 1) // 2
    quiet = torch.no_grad()(work)  # the mode belongs to the thread that calls
    return on_two_threads(quiet, blocks[:cut], blocks[cut:])


class _Perceptron(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, *layers: Tensor) -> Tensor:
        w1, b1, w2, b2, w3, b3 = layers
        n = len(x)
        h1, h2, out = x.new_empty(n, len(b1)), x.new_empty(n, len(b2)), x.new_empty(n, len(b3))

        def work(blocks: list[slice]) -> None:
            for s in blocks:
                torch.addmm(b1, x[s], w1.T, out=h1[s]).relu_()
                torch.addmm(b2, h1[s], w2.T, out=h2[s]).relu_()
                torch.addmm(b3, h2[s], w3.T, out=out[s])

        _in_parts(n, work)
        ctx.save_for_backward(x, h1, h2, w1, w2, w3)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, ...]:
        x, h1, h2, w1, w2, w3 = ctx.saved_tensors
        grad, to_x = grads[0].contiguous(), torch.empty_like(x)

        def work(blocks: list[slice]) -> list[Tensor]:
            sums = [x.new_zeros(s) for w in (w1, w2, w3) for s in (w.shape, w.shape[:1])]
            for s in blocks:
                g = grad[s]
                for layer, (h, w) in ((2, (h2, w3)), (1, (h1, w2)), (0, (x, w1))):
                    sums[2 * layer].addmm_(g.T, h[s])
                    sums[2 * layer + 1].add_(g.sum(0))
                    if layer:
                        g = torch.ops.aten.threshold_backward(g @ w, h[s], 0)
                    else:
                        torch.mm(g, w, out=to_x[s])
            return sums

        first, second = _in_parts(len(x), work)
        return to_x, *(a + b for a, b in zip(first, second, strict=True))


def perceptron(x: Tensor, layers: list[Tensor]) -> Tensor:
    """Return W3 relu(W2 relu(W1 x + b1) + b2) + b3 for rows x [N, D]; `layers` is [W1, b1, W2, b2, W3, b3]."""
    if x.device.type != "cpu" or x.dtype != torch.float32:
        return perceptron_reference(x, layers)
    out: Tensor = _Perceptron.apply(x, *layers)
    return out


def perceptron_reference(x: Tensor, layers: list[Tensor]) -> Tensor:
    """Return the same in plain torch, on any device."""
    w1, b1, w2, b2, w3, b3 = layers
    return (((x @ w1.T + b1).relu() @ w2.T + b2).relu()) @ w3.T + b3
