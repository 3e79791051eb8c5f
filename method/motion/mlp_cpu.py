"""`mlp.perceptron` on the CPU: products of matrices in vector code, for blocks of rows that stay in the cache.

All widths are small, where torch's product of matrices is slow: 40 to 65 GFLOP/s on a core that does 80 to 90 here. A
tile is 4 rows by 16 columns, whose sums stay in registers. The gradient computes the activations again, so that none
are kept. Torch's own threads cannot be used beside the rasteriser's (see `torch_state.one_torch_thread`). Sums have one
order on any number of cores.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from torch import Tensor

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.compilation import cached_njit
from spike4dgs.method.splat.kernels.vector_ir import Lanes, array_data, int64, offset
from spike4dgs.method.two_threads import on_two_threads

BLOCK = 128  # rows: the activations and gradients of a block, 160 columns each, fill a third of a second-level cache
WIDTH = 8  # lanes of a vector, on any processor
ANY, POSITIVE = np.float32(-np.inf), np.float32(0)
FIRST: Any = np.int64(0)  # of a 0 numba makes a type of its own, and a kernel for it


def _tile(rows: int, vectors: int, lanes: int) -> Any:
    """Return the intrinsic of a tile of C, `rows` rows by `vectors * lanes` columns: max(C + A B, floor).

    An array comes with the index of its first element. Elements of A are `row_a` and `next_a` apart, the rows of B and
    C `row_b` and `row_c`; `count` is how many rows B has. What is not a number stays so.
    """

    def declare(
        typing_context: Any, a: Any, at_a: Any, row_a: Any, next_a: Any, b: Any, at_b: Any, row_b: Any, c: Any,
        at_c: Any, row_c: Any, count: Any, floor: Any,
    ) -> Any:  # fmt: skip
        i = types.int64
        return types.void(a, i, i, i, b, i, i, c, i, i, i, types.float32), generate

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        v, places = Lanes(builder, lanes), range(rows * vectors)
        a, b, c = (offset(builder, array_data(context, builder, sig.args[x], args[x]), args[x + 1]) for x in (0, 4, 7))
        row_a, next_a, row_b, row_c = args[2], args[3], args[6], args[9]

        def element(pointer: Any, row: Any, step: Any, column: Any) -> Any:
            return offset(builder, pointer, builder.add(builder.mul(step, row), column))

        to = [element(c, int64(p // vectors), row_c, int64(p % vectors * lanes)) for p in places]
        sums = [cgutils.alloca_once_value(builder, v.const(0)) for _ in to]
        with cgutils.for_range(builder, args[10]) as loop:
            of_b = [v.load(element(b, loop.index, row_b, int64(x * lanes))) for x in range(vectors)]
            for r in range(rows):
                own = v.splat(builder.load(element(a, int64(r), row_a, builder.mul(loop.index, next_a))))
                for x, total in enumerate(sums[r * vectors : (r + 1) * vectors]):
                    builder.store(v.fma(own, of_b[x], builder.load(total)), total)
        floor = v.splat(args[11])
        for total, pointer in zip(sums, to, strict=True):
            x = v.add(v.load(pointer), builder.load(total))
            v.store(builder.select(builder.fcmp_ordered("<", x, floor), floor, x), pointer)
        return context.get_dummy_value()

    return intrinsic(declare)


def _strip(vectors: int, lanes: int) -> Any:
    """Return the kernel of M rows by `vectors * lanes` columns, in tiles of four rows and of one."""
    four, one = _tile(4, vectors, lanes), _tile(1, vectors, lanes)

    def strip(
        a: Any, at_a: int, row_a: int, next_a: int, b: Any, at_b: int, row_b: int, c: Any, at_c: int, row_c: int,
        m: int, k: int, floor: np.float32,
    ) -> None:  # fmt: skip
        whole = m - m % 4
        for i in range(0, whole, 4):
            four(a, at_a + i * row_a, row_a, next_a, b, at_b, row_b, c, at_c + i * row_c, row_c, k, floor)
        for i in range(whole, m):
            one(a, at_a + i * row_a, row_a, next_a, b, at_b, row_b, c, at_c + i * row_c, row_c, k, floor)

    # Kernels that were compiled in two processes are linked by the names of what they call: one name, one code.
    strip.__qualname__ = f"strip_{vectors}_{lanes}"
    return njit(nogil=True, error_model="numpy")(strip)


_wide, _narrow, _column = _strip(2, WIDTH), _strip(1, WIDTH), _strip(1, 1)


@njit(nogil=True, error_model="numpy")
def add_product(
    a: Any, at_a: int, row_a: int, next_a: int, b: Any, at_b: int, row_b: int, c: Any, at_c: int, row_c: int,
    m: int, n: int, k: int, floor: np.float32,
) -> None:  # fmt: skip
    """Set C [M, N] to max(C + A [M, K] B [K, N], floor); see `_tile` for where their elements are."""
    wide, narrow = n - n % (2 * WIDTH), n - n % WIDTH
    for j in range(0, wide, 2 * WIDTH):
        _wide(a, at_a, row_a, next_a, b, at_b + j, row_b, c, at_c + j, row_c, m, k, floor)
    for j in range(wide, narrow, WIDTH):
        _narrow(a, at_a, row_a, next_a, b, at_b + j, row_b, c, at_c + j, row_c, m, k, floor)
    for j in range(narrow, n):
        _column(a, at_a, row_a, next_a, b, at_b + j, row_b, c, at_c + j, row_c, m, k, floor)


@njit(nogil=True, error_model="numpy")
def _activations(x: Any, at: int, w: Any, bias: Any, out: Any, n: int) -> None:
    """Set n rows to relu(x w + bias) of the rows of x from `at` on."""
    for r in range(n):
        for i in range(len(bias)):
            out[r, i] = bias[i]
    d, m = w.shape
    add_product(x, at * d, d, 1, w, FIRST, m, out, FIRST, m, n, m, d, POSITIVE)


@cached_njit(nogil=True, error_model="numpy")
def _forward(
    x: Float32, w1: Float32, b1: Float32, w2: Float32, b2: Float32, w3: Float32, b3: Float32, out: Float32
) -> None:
    """Set out [N, heads * P], P a head's size, padded. Matrices are transposed: w3 [H2, P], one head after another."""
    p = w3.shape[1]
    heads = out.shape[1] // p
    width = len(w3) // heads
    h1, h2 = np.empty((BLOCK, w1.shape[1]), np.float32), np.empty((BLOCK, w2.shape[1]), np.float32)
    for at in range(0, len(x), BLOCK):
        n = min(BLOCK, len(x) - at)
        _activations(x, at, w1, b1, h1, n)
        _activations(h1, FIRST, w2, b2, h2, n)
        for r in range(n):
            for i in range(len(b3)):
                out[at + r, i] = b3[i]
        for head in range(heads):
            to = (at * heads + head) * p
            add_product(h2, head * width, h2.shape[1], 1, w3, head * width * p, p, out, to, heads * p, n, p, width, ANY)


@njit(nogil=True, error_model="numpy")
def _gradients(x: Any, at: int, h: Any, grad: Any, w: Any, to_x: Any, to_w: Any, to_bias: Any, n: int) -> None:
    """Add the gradients of a layer h = relu(x w^T + bias), `w` [M, K], from n rows of h's, which are overwritten."""
    m, k = w.shape
    total = np.zeros_like(to_bias)
    for r in range(n):
        for i in range(m):
            grad[r, i] *= np.float32(h[r, i] > 0)
    for r in range(n):
        for i in range(m):
            total[i] += grad[r, i]
    for i in range(m):  # numba compiles the message of an addition of arrays for as long as all of this
        to_bias[i] += total[i]
    add_product(grad, FIRST, m, 1, w, FIRST, k, to_x, at * k, k, n, k, m, ANY)
    add_product(grad, FIRST, 1, m, x, at * k, k, to_w, FIRST, k, m, k, n, ANY)


@cached_njit(nogil=True, error_model="numpy")
def _backward(
    x: Float32,
    grad: Float32,
    sizes: Any,
    transposed: Any,
    biases: Any,
    weights: Any,
    to_x: Float32,
    to_weights: Any,
    to_biases: Any,
) -> None:
    """Add the gradients of x, weights and biases to zeros, of grad [N, T], where T is the sum of the heads' sizes."""
    w1, w2, w3 = weights  # [H1, D], [H2, H1], [T, H2 / heads]
    width, total = w3.shape[1], grad.shape[1]
    h1, h2 = np.empty((BLOCK, len(w1)), np.float32), np.empty((BLOCK, len(w2)), np.float32)
    for at in range(0, len(x), BLOCK):
        n = min(BLOCK, len(x) - at)
        _activations(x, at, transposed[0], biases[0], h1, n)
        _activations(h1, FIRST, transposed[1], biases[1], h2, n)
        g2, g1 = np.zeros_like(h2), np.zeros_like(h1)
        first = 0
        for head, size in enumerate(sizes):
            of_grad, of_h, of_w = at * total + first, head * width, first * width
            add_product(grad, of_grad, total, 1, w3, of_w, width, g2, of_h, len(w2), n, width, size, ANY)
            add_product(grad, of_grad, 1, total, h2, of_h, len(w2), to_weights[2], of_w, width, size, width, n, ANY)
            first += size
        _gradients(h1, FIRST, h2, g2, w2, g1, to_weights[1], to_biases[1], n)
        _gradients(x, at, h1, g1, w1, to_x, to_weights[0], to_biases[0], n)


class _Perceptron(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, *layers: Tensor) -> tuple[Tensor, ...]:
        heads, rows = len(layers) // 2 - 2, x.detach().contiguous().numpy()
        w, biases = ([layer.detach().numpy() for layer in layers[k::2]] for k in range(2))
        widest = max(len(head) for head in w[2:])
        p = widest + -widest % WIDTH
        w3, b3 = np.zeros((heads, w[2].shape[1], p), np.float32), np.zeros((heads, p), np.float32)  # padded with zeros
        for i, (head, bias) in enumerate(zip(w[2:], biases[2:], strict=True)):
            w3[i, :, : len(head)], b3[i, : len(head)] = head.T, bias
        out, transposed = np.empty((len(rows), heads * p), np.float32), [np.ascontiguousarray(a.T) for a in w[:2]]

        def work(part: slice) -> None:
            _forward(
                rows[part], transposed[0], biases[0], transposed[1], biases[1], w3.reshape(-1, p), b3.ravel(), out[part]
            )

        on_two_threads(work, *_halves(len(rows)))
        ctx.save_for_backward(x, *layers)
        return tuple(torch.from_numpy(out[:, i * p : i * p + len(head)]) for i, head in enumerate(w[2:]))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, ...]:
        x, *layers = (tensor.detach() for tensor in ctx.saved_tensors)
        rows, grad = x.contiguous().numpy(), torch.cat(grads, 1).numpy()
        (first, second, *heads), biases = layers[0::2], tuple(bias.numpy() for bias in layers[1:4:2])
        weights = first.contiguous().numpy(), second.contiguous().numpy(), torch.cat(heads).numpy()
        transposed = tuple(np.ascontiguousarray(w.T) for w in weights[:2])
        sizes, to_x = tuple(map(len, heads)), np.zeros_like(rows)

        def work(part: slice) -> tuple[list[Any], list[Any]]:
            to_weights, to_biases = [np.zeros_like(w) for w in weights], [np.zeros_like(bias) for bias in biases]
            job = transposed, biases, weights, to_x[part], tuple(to_weights), tuple(to_biases)
            _backward(rows[part], grad[part], np.array(sizes), *job)
            return to_weights, to_biases

        (w_one, b_one), (w_two, b_two) = on_two_threads(work, *_halves(len(rows)))
        w1, w2, w3 = (torch.from_numpy(a + b) for a, b in zip(w_one, w_two, strict=True))
        b1, b2 = (torch.from_numpy(a + b) for a, b in zip(b_one, b_two, strict=True))
        of_heads = zip(w3.split(sizes), (g.sum(0) for g in grads), strict=True)
        return torch.from_numpy(to_x), w1, b1, w2, b2, *(g for pair in of_heads for g in pair)


def _halves(rows: int) -> tuple[slice, slice]:
    """Return both halves of the blocks of rows: two on any number of cores, so that sums keep their order."""
    cut = (rows // BLOCK + 1) // 2 * BLOCK
    return slice(0, cut), slice(cut, rows)


def perceptron_on_cpu(x: Tensor, layers: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Return what `mlp.perceptron` says, of float32 tensors on the CPU."""
    out: tuple[Tensor, ...] = _Perceptron.apply(x, *layers)
    return out
