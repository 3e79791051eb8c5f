"""A function of rows, evaluated in blocks on two threads of our own, forwards and backwards.

A block's activations stay near the cache, and each thread walks its own blocks' graphs: torch's threads would share
one large layer at a time, and cannot be used beside the HexPlane kernels (`torch_state.one_torch_thread`). The twin is
the same function called on all rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import torch
from torch import Tensor

BLOCK = 2048  # rows; 1024 to 4096 take the same time within the noise for layers of 32 to 64
PARTS = 2  # fixed, so that sums are taken in one order on any number of cores

Rows = Callable[..., Tensor]  # row tensors [n, ...] -> [n, K], each row by itself


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(PARTS - 1, "field", initializer=lambda: torch.set_num_threads(1))


def _cuts(rows: int) -> list[slice]:
    """Return blocks of equal size, as many for each part."""
    count = PARTS * -(-rows // (PARTS * BLOCK))
    edges = [rows * i // count for i in range(count + 1)]
    return [slice(a, b) for a, b in zip(edges, edges[1:], strict=False)]


def _in_parts(blocks: list[Any], work: Callable[[Any], Any]) -> list[list[Any]]:
    """Call `work` on each of the blocks, on one thread per part; return the results by part."""
    cut = len(blocks) // PARTS
    later = _pool().submit(lambda: [work(b) for b in blocks[cut:]])
    return [[work(b) for b in blocks[:cut]], later.result()]


class _Blocks(torch.autograd.Function):
    """Each block is a graph of its own, made by the forward pass and walked by the backward pass in the same thread."""

    @staticmethod
    def forward(ctx: Any, function: Rows, count: int, *tensors: Tensor) -> Tensor:
        inputs, ctx.parameters = tensors[:count], tensors[count:]
        needed = ctx.needs_input_grad[2 : 2 + count]

        def work(s: slice) -> tuple[list[Tensor], Tensor]:
            leaves = [x[s].detach().requires_grad_(n) for x, n in zip(inputs, needed, strict=True)]
            with torch.enable_grad():
                return leaves, function(*leaves)

        ctx.cuts, ctx.needed = _cuts(len(inputs[0])), needed
        ctx.blocks = [block for part in _in_parts(ctx.cuts, work) for block in part]
        return torch.cat([out.detach() for _, out in ctx.blocks])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        def work(job: tuple[slice, tuple[list[Tensor], Tensor]]) -> tuple[Tensor, ...]:
            s, (leaves, out) = job
            wanted = [leaf for leaf in leaves if leaf.requires_grad]
            return torch.autograd.grad(out, [*wanted, *ctx.parameters], grads[0][s])

        parts = _in_parts(list(zip(ctx.cuts, ctx.blocks, strict=True)), work)
        inputs = sum(ctx.needed)
        rows = iter([torch.cat([g[i] for part in parts for g in part]) for i in range(inputs)])
        per_part = [[sum(g[inputs + i] for g in part) for i in range(len(ctx.parameters))] for part in parts]
        totals = [sum(values) for values in zip(*per_part, strict=True)]
        return None, None, *(next(rows) if n else None for n in ctx.needed), *totals


def in_blocks(function: Rows, inputs: Sequence[Tensor], parameters: Sequence[Tensor]) -> Tensor:
    """Return function(*inputs), whose rows are independent, by blocks; gradients go to `inputs` and `parameters`.

    `parameters` are all leaves that the function uses, and it must use each of them.
    """
    if inputs[0].device.type != "cpu" or not len(inputs[0]):
        return function(*inputs)
    if not torch.is_grad_enabled():
        quiet = torch.no_grad()(lambda s: function(*(x[s] for x in inputs)))  # the mode belongs to the thread
        return torch.cat([out for part in _in_parts(_cuts(len(inputs[0])), quiet) for out in part])
    out: Tensor = _Blocks.apply(function, len(inputs), *inputs, *parameters)
    return out
