"""Fused SSIM and L1 or Huber's loss: value and gradient in one pass of numba kernels, with their twins in plain torch.

SSIM (Wang et al. 2004) with the metric's Gaussian window (`ssim_window`), zero padding, data range 1, averaged over
all pixels and images. The window is separable; the gradient needs three more blurs:

    S = A B / (C D),  A = 2 m1 m2 + c1,  B = 2 (q12 - m1 m2) + c2,
    C = m1^2 + m2^2 + c1,  D = q1 - m1^2 + q2 - m2^2 + c2,
    dS/dimage = blur(dS/dm1) + 2 image blur(dS/dq1) + target blur(dS/dq12)

with m the blurred images, q the blurred squares and product. This is the training loss; scores come from
`spike4dgs.benchmark.metrics.table`, which leaves out the border instead of padding it.

The kernels' float32 is for light of about [0, 1]. In D the squares of the light cancel: in flat parts at 10 times
white the gradient errs by 4 %, at 100 times by 60 %.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.metrics.ssim_window import SSIM_SIGMA, SSIM_WINDOW
from spike4dgs.method.splat.kernels import threads
from spike4dgs.method.splat.kernels.jit import announce_compilation, helper, kernel
from spike4dgs.method.splat.kernels.vector_ir import fetch_add

RADIUS = SSIM_WINDOW // 2
C1, C2 = 0.01**2, 0.03**2
_WINDOW = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / SSIM_SIGMA) ** 2)
_WINDOW /= _WINDOW.sum()
# From the window's edge to its middle. An argument of the kernel, as the window is another module's constant.
_HALF = tuple(np.float32(w) for w in _WINDOW[: RADIUS + 1])
_SHARP = 2.0**-100  # a delta at which Huber's loss is |d|, bit for bit
_C1, _C2, _TWO = np.float32(C1), np.float32(C2), np.float32(2)


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Return the mean SSIM of images [B, H, W] against targets [B, H, W], differentiable in `image`.

    A pixel of `target` that is no number counts as met, and has no gradient.
    CPU tensors go through the kernels in float32, others through torch: the same formula with the window as a matrix.
    Raises UserError for other shapes, or for a target that wants a gradient, which the kernels do not give.
    """
    _check("ssim", image, target)
    if image.device.type != "cpu":
        return _mean_ssim(*met(image, target), _banded)
    value: Tensor = _Fused.apply(image, target, 1.0, 0.0, _SHARP)  # type: ignore[no-untyped-call]
    return value


def l1_and_ssim(image: Tensor, target: Tensor, w: float, delta: float = 0.0) -> Tensor:
    """Return (1 - w) mean h(image - target) + w (1 - SSIM); images and errors as `ssim`.

    h is |d|, which makes it the loss of 3DGS, or with a `delta` above 0 Huber's over delta: d^2 / 2 delta up to it,
    |d| - delta / 2 beyond.
    """
    _check("l1_and_ssim", image, target)
    if image.device.type != "cpu":
        image, target = met(image, target)
        return (1 - w) * huber(image, target, delta) + w * (1 - _mean_ssim(image, target, _banded))
    value: Tensor = _Fused.apply(image, target, -w, 1 - w, max(delta, _SHARP))  # type: ignore[no-untyped-call]
    return w + value


def met(image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Return both with the values of `image`, without gradient, where `target` is no number."""
    if (finite := target.isfinite()).all():
        return image, target
    return torch.where(finite, image, image.detach()), torch.where(finite, target, image.detach())


def huber(image: Tensor, target: Tensor, delta: float) -> Tensor:
    """Return the mean of h, see `l1_and_ssim`, by torch."""
    return functional.huber_loss(image, target, delta=delta) / delta if delta else (image - target).abs().mean()


def _check(name: str, image: Tensor, target: Tensor) -> None:
    if image.ndim != 3 or image.shape != target.shape or image.numel() == 0:
        found = f"{tuple(image.shape)} and {tuple(target.shape)}"
        raise problem(name, "two batches [B, H, W] of one shape", found, "add the batch dimension")
    if target.requires_grad:
        raise problem(name, "a target without gradient", "requires_grad", "pass the rendered image first")


def ssim_reference(image: Tensor, target: Tensor) -> Tensor:
    """Return the mean SSIM by plain torch, in the precision of the inputs: the twin of the kernels."""
    return _mean_ssim(image, target, _convolved)


def _convolved(x: Tensor) -> Tensor:
    """Return images [B, H, W] blurred by two convolutions."""
    window = torch.as_tensor(_WINDOW, dtype=x.dtype, device=x.device)
    rows = functional.conv2d(x[:, None], window.view(1, 1, 1, -1), padding=(0, RADIUS))
    return functional.conv2d(rows, window.view(1, 1, -1, 1), padding=(RADIUS, 0))[:, 0]


def _banded(x: Tensor) -> Tensor:
    """Return images [B, H, W] blurred by two matrix products.

    On a GPU torch rounds the inputs of float32 convolutions to 10 bits by default (TF32). SSIM subtracts the square of
    a mean from a mean of squares, which leaves nothing of that. Matrix products stay in float32.
    """
    down, across = (_band(size, x.dtype, x.device) for size in x.shape[1:])
    return down @ x @ across


@cache
def _band(size: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the symmetric matrix [size, size] that blurs a line. It is made once: a fit asks for it in every step."""
    line = torch.arange(size)
    away = (line[:, None] - line).abs()
    inside = torch.as_tensor(_WINDOW)[(RADIUS + away).clamp(max=2 * RADIUS)]
    return torch.where(away <= RADIUS, inside, 0.0).to(device, dtype)


def _mean_ssim(image: Tensor, target: Tensor, blur: Callable[[Tensor], Tensor]) -> Tensor:
    m1, m2 = blur(image), blur(target)
    q1, q2, q12 = blur(image * image), blur(target * target), blur(image * target)
    numerator = (2 * m1 * m2 + C1) * (2 * (q12 - m1 * m2) + C2)
    return (numerator / ((m1 * m1 + m2 * m2 + C1) * (q1 - m1 * m1 + q2 - m2 * m2 + C2))).mean()


class _Fused(torch.autograd.Function):
    """`of_ssim` x mean SSIM + `of_l1` x mean h(image - target), |d| but for a `delta`.

    The gradient is computed with the value, while the blurred images are at hand.
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, of_ssim: float, of_l1: float, delta: float) -> Tensor:
        batch, height, width = image.shape
        a = np.ascontiguousarray(image.detach().numpy(), dtype=np.float32)
        b = np.ascontiguousarray(target.numpy(), dtype=np.float32)
        sums = np.empty((batch, 2), np.float64)
        gradient = np.empty_like(a) if image.requires_grad else np.empty((0, 0, 0), np.float32)
        announce_compilation(_loss_kernel, "SSIM")
        workers = min(threads.get_threads(), batch)
        scratch = [
            (
                np.zeros((height + 2 * RADIUS, width), np.float32),
                np.zeros(width + 2 * RADIUS, np.float32),
                np.empty((6, height, width), np.float32),
            )
            for _ in range(workers)
        ]
        weights = np.float32(of_ssim / a.size), np.float32(of_l1 / a.size), np.float32(delta), np.float32(1 / delta)
        threads.run(_loss_kernel, (a, b, _HALF, weights, sums, gradient), scratch)
        if image.requires_grad:
            ctx.save_for_backward(torch.from_numpy(gradient))
            ctx.dtype = image.dtype
        total = sums.sum(0)
        return torch.as_tensor((of_ssim * total[0] + of_l1 * total[1]) / a.size, dtype=image.dtype)

    @staticmethod
    def backward(ctx: Any, *outer: Tensor) -> tuple[Tensor, None, None, None, None]:
        (gradient,) = ctx.saved_tensors
        return (gradient * outer[0]).to(ctx.dtype), None, None, None, None


@helper
def _blur(source, out, half, rows, line):  # type: ignore[no-untyped-def]
    """Blur [H, W] into `out`, which may be `source`. `rows` [H + 10, W] and `line` [W + 10] have zero margins."""
    w0, w1, w2, w3, w4, w5 = half  # unrolled for a window of 11
    height, width = source.shape
    for y in range(height):
        for x in range(width):
            line[x + 5] = source[y, x]
        r = rows[y + 5]
        for x in range(width):
            r[x] = (
                w5 * line[x + 5]
                + w4 * (line[x + 4] + line[x + 6])
                + w3 * (line[x + 3] + line[x + 7])
                + w2 * (line[x + 2] + line[x + 8])
                + w1 * (line[x + 1] + line[x + 9])
                + w0 * (line[x] + line[x + 10])
            )
    for y in range(height):
        o = out[y]
        for x in range(width):
            o[x] = (
                w5 * rows[y + 5, x]
                + w4 * (rows[y + 4, x] + rows[y + 6, x])
                + w3 * (rows[y + 3, x] + rows[y + 7, x])
                + w2 * (rows[y + 2, x] + rows[y + 8, x])
                + w1 * (rows[y + 1, x] + rows[y + 9, x])
                + w0 * (rows[y, x] + rows[y + 10, x])
            )


@helper
def _row_sum(row):  # type: ignore[no-untyped-def]
    """Sum of a row in eight interleaved partial sums, an order that no compiler changes."""
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = np.float32(0)
    whole = len(row) // 8 * 8
    for x in range(0, whole, 8):
        s0 += row[x]
        s1 += row[x + 1]
        s2 += row[x + 2]
        s3 += row[x + 3]
        s4 += row[x + 4]
        s5 += row[x + 5]
        s6 += row[x + 6]
        s7 += row[x + 7]
    for x in range(whole, len(row)):
        s0 += row[x]
    return np.float64((s0 + s1) + (s2 + s3)) + np.float64((s4 + s5) + (s6 + s7))


@kernel
def _loss_kernel(  # type: ignore[no-untyped-def]
    images, targets, half, weights, sums, gradients, counter, rows, line, maps
):
    """Sums of SSIM and h(image - target) of each image, and their gradient with the `weights`, if it is wanted.

    `gradients` is empty where it is not. The last of the weights are the delta of h and its inverse. SSIM's windows
    would pull at pixels that nothing is known of, so a target that is no number becomes the image's own value.
    """
    batch, height, width = images.shape
    of_ssim, of_l1, delta, steep = weights
    one, half_of = np.float32(1), np.float32(0.5)
    m1, m2, q1, q2, q12, b = maps[0], maps[1], maps[2], maps[3], maps[4], maps[5]
    while True:
        i = fetch_add(counter, 0, 1)
        if i >= batch:
            return
        a, given = images[i], targets[i]
        total = 0.0
        for y in range(height):
            for x in range(width):
                known = abs(given[y, x]) < np.float32(np.inf)
                b[y, x] = given[y, x] if known else a[y, x]
                q1[y, x] = a[y, x] * a[y, x]
                q2[y, x] = b[y, x] * b[y, x]
                q12[y, x] = a[y, x] * b[y, x]
                far = abs(a[y, x] - b[y, x])
                near = min(far, delta)
                m1[y, x] = near * steep * (far - half_of * near)
            total += _row_sum(m1[y])
        sums[i, 1] = total
        _blur(a, m1, half, rows, line)
        _blur(b, m2, half, rows, line)
        _blur(q1, q1, half, rows, line)
        _blur(q2, q2, half, rows, line)
        _blur(q12, q12, half, rows, line)
        total = 0.0
        for y in range(height):
            for x in range(width):
                u, v = m1[y, x], m2[y, x]
                uu, vv, uv = u * u, v * v, u * v
                A, B = _TWO * uv + _C1, _TWO * (q12[y, x] - uv) + _C2
                C, D = uu + vv + _C1, (q1[y, x] - uu) + (q2[y, x] - vv) + _C2
                inverse = np.float32(1) / (C * D)
                S = A * B * inverse
                q1[y, x] = -S * C * inverse * of_ssim
                q12[y, x] = _TWO * A * inverse * of_ssim
                m1[y, x] = _TWO * (v * (B - A) + S * u * (C - D)) * inverse * of_ssim
                q2[y, x] = S
            total += _row_sum(q2[y])
        sums[i, 0] = total
        if gradients.size:
            _blur(m1, m1, half, rows, line)
            _blur(q1, q1, half, rows, line)
            _blur(q12, q12, half, rows, line)
            g = gradients[i]
            for y in range(height):
                for x in range(width):
                    d = a[y, x] - b[y, x]
                    slope = max(-one, min(one, d * steep))
                    pull = m1[y, x] + _TWO * a[y, x] * q1[y, x] + b[y, x] * q12[y, x] + of_l1 * slope
                    g[y, x] = pull if b[y, x] == given[y, x] else np.float32(0)
