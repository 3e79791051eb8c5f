"""`speed splat` and `speed ssim`: the CPU kernels beside pure torch in one process, with the difference.

The other side of `splat` is the rasteriser `torch_ref` of the package metal-gauss, which renders three channels; ours
is timed with one, as the spike cameras need, and with three. It cuts Gaussians off at three standard deviations where
we go on to an alpha of 1/255, so images differ by up to 1/255 a Gaussian; the tests hold our error against float64.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.metrics.ssim_window import SSIM_SIGMA
from spike4dgs.method.splat import Splats, Views, render
from spike4dgs.method.splat.ssim import C1, C2, RADIUS, ssim_reference
from spike4dgs.method.splat.ssim import ssim as fused_ssim
from spike4dgs.studies.speed.timing import show_table, time_ms

HEIGHT, WIDTH = 250, 400
MEAN_RADIUS_PX = {5_000: 6.2, 20_000: 4.3, 50_000: 3.4}  # scenes of more Gaussians have smaller ones
Run = Callable[
    [], tuple[Tensor, list[Tensor]]
]  # -> image [H, W], gradients of means, quats, scales, opacities, colours


def random_scene(n: int, seed: int = 0, width: int = WIDTH, height: int = HEIGHT) -> tuple[Splats, Views]:
    """Return N Gaussians in front of a camera, most in view; float32, one channel.

    Radii are those of `MEAN_RADIUS_PX` in an image of 400 px, and grow with the width.
    """
    g = torch.Generator().manual_seed(seed)
    z = 2 + 4 * torch.rand(n, generator=g)
    at = [(1.06 * torch.rand(n, generator=g) - 0.53) * size / width * z for size in (width, height)]
    size = MEAN_RADIUS_PX.get(n, 4.3) / 2.6 / WIDTH * torch.exp(0.45 * torch.randn(n, generator=g)) * z
    scales = size[:, None] * torch.exp(0.45 * torch.randn(n, 3, generator=g))
    opacities = torch.sigmoid(1.5 * torch.randn(n, generator=g))
    quats, colors = torch.randn(n, 4, generator=g), torch.rand(n, 1, generator=g)
    K = torch.tensor([[[width, 0.0, width / 2], [0.0, width, height / 2], [0.0, 0.0, 1.0]]])
    splats = Splats(torch.stack([*at, z], -1), quats, scales, opacities, colors)
    return splats, Views(torch.eye(4)[None], K, width, height)


def _leaves(splats: Splats, channels: int, gradients: bool) -> list[Tensor]:
    colors = splats.colors.expand(-1, channels)
    return [t.detach().clone().requires_grad_(gradients) for t in (*splats.geometry, colors)]


def _ours(splats: Splats, views: Views, weight: Tensor, channels: int, backward: bool) -> Run:
    leaves = _leaves(splats, channels, backward)

    def run() -> tuple[Tensor, list[Tensor]]:
        image = render(Splats(*leaves), views, backend="cpu").image[0]
        gradients = list(torch.autograd.grad((image * weight).sum(), leaves)) if backward else []
        return image.detach()[..., 0], gradients

    return run


def _metal_gauss(splats: Splats, views: Views, weight: Tensor, backward: bool) -> Run:
    try:
        from metal_gauss import torch_ref
    except ImportError:
        raise problem(
            "speed splat", "the package metal-gauss to compare with", "none", "pip install metal-gauss"
        ) from None
    leaves = _leaves(splats, 3, backward)

    def run() -> tuple[Tensor, list[Tensor]]:
        means, quats, scales, opacities, colors = leaves
        image = torch_ref.render(
            means, quats, scales, opacities, None, views.K[0], views.w2c[0], WIDTH, HEIGHT, colors=colors
        )[0]
        gradients = list(torch.autograd.grad((image[..., :1] * weight).sum(), leaves)) if backward else []
        return image.detach()[..., 0], gradients

    return run


def _difference(ours: tuple[Tensor, list[Tensor]], theirs: tuple[Tensor, list[Tensor]]) -> tuple[str, str]:
    """Return the largest difference of the image, and of the gradients' relative L2 norms over the five parameters."""
    image = f"{float((ours[0] - theirs[0]).abs().max()):.1e}"
    pairs = [(a, b[..., : a.shape[-1]] if a.ndim == 2 else b) for a, b in zip(ours[1], theirs[1], strict=True)]
    relative = [float((a - b).norm() / b.norm()) for a, b in pairs]
    return image, f"{max(relative):.1e}" if relative else ""


def splat(argv: Sequence[str] = ()) -> int:
    """Time rendering, and rendering with gradients, of 5k, 20k and 50k Gaussians at 250x400, beside metal-gauss."""
    p = argparse.ArgumentParser("spike4dgs speed splat", description=splat.__doc__)
    p.add_argument("--counts", type=int, nargs="+", default=list(MEAN_RADIUS_PX))
    p.add_argument("--repeats", type=int, default=30, help="of ours; the other side runs three times")
    p.add_argument("--csv", type=Path, help="write the table here too")
    a = p.parse_args(list(argv))
    weight = torch.randn(HEIGHT, WIDTH, 1, generator=torch.Generator().manual_seed(1))
    rows = []
    for n in a.counts:
        splats, views = random_scene(n)
        for backward in (False, True):
            what = "forward+backward" if backward else "forward"
            other = _metal_gauss(splats, views, weight, backward)
            theirs, base = other(), time_ms(other, 3)
            rows.append((f"{n}", what, "metal-gauss, 3 channels", *_ms(base), "1", "", ""))
            for channels in (1, 3):
                run = _ours(splats, views, weight, channels, backward)
                mine, difference = time_ms(run, a.repeats), _one_channel(run, theirs, channels)
                name = f"spike4dgs, {channels} channel{'s' if channels > 1 else ''}"
                rows.append((f"{n}", what, name, *_ms(mine), f"{base[1] / mine[1]:.0f}", *difference))
    columns = ("N", "what", "by", "min ms", "median ms", "times as fast", "image differs", "gradients differ")
    print(f"torch {torch.__version__} on {torch.get_num_threads()} threads")
    show_table(f"{HEIGHT}x{WIDTH} pixels", columns, rows, a.csv)
    return 0


def _one_channel(run: Run, theirs: tuple[Tensor, list[Tensor]], channels: int) -> tuple[str, str]:
    """Return differences where both sides differentiate the same loss; with three channels ours weighs all of them."""
    return _difference(run(), theirs) if channels == 1 else (_difference((run()[0], []), (theirs[0], []))[0], "")


def _ms(times: tuple[float, float]) -> tuple[str, str]:
    return f"{times[0]:.1f}", f"{times[1]:.1f}"


def ssim(argv: Sequence[str] = ()) -> int:
    """Time SSIM with its gradient at 250x400, beside torch with the customary 11x11 and with separable windows."""
    p = argparse.ArgumentParser("spike4dgs speed ssim", description=ssim.__doc__)
    p.add_argument("--repeats", type=int, default=50, help="of ours; the other side runs five times")
    p.add_argument("--csv", type=Path, help="write the table here too")
    a = p.parse_args(list(argv))
    g = torch.Generator().manual_seed(0)
    image, target = torch.rand(1, HEIGHT, WIDTH, generator=g), torch.rand(1, HEIGHT, WIDTH, generator=g)
    exact = differentiate(ssim_reference, image.double(), target.double())
    rows: list[tuple[str, ...]] = []
    base = 0.0
    for name, function, repeats in (
        ("torch, 11x11 window", ssim_square, 5),
        ("torch, separable window", ssim_reference, 5),
        ("spike4dgs", fused_ssim, a.repeats),
    ):
        value, gradient = differentiate(function, image, target)
        times = time_ms(lambda f=function: differentiate(f, image, target), repeats)  # type: ignore[misc]
        base = base or times[1]
        errors = float((value - exact[0]).abs()), float((gradient - exact[1]).norm() / exact[1].norm())
        ms = f"{times[0]:.2f}", f"{times[1]:.2f}"
        rows.append((name, *ms, f"{base / times[1]:.0f}", f"{errors[0]:.1e}", f"{errors[1]:.1e}"))
    columns = ("value and gradient by", "min ms", "median ms", "times as fast", "value error", "gradient error")
    print(f"torch {torch.__version__} on {torch.get_num_threads()} threads")
    show_table(f"SSIM of {HEIGHT}x{WIDTH} pixels; errors against float64", columns, rows, a.csv)
    return 0


def differentiate(function: Callable[[Tensor, Tensor], Tensor], image: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Return the value of a loss and its gradient for the image."""
    leaf = image.detach().clone().requires_grad_()
    value = function(leaf, target)
    return value.detach(), torch.autograd.grad(value, leaf)[0]


def ssim_square(image: Tensor, target: Tensor) -> Tensor:
    """Return SSIM as training code usually writes it: five convolutions with one 11x11 window."""
    at = torch.arange(-RADIUS, RADIUS + 1, dtype=image.dtype)
    line = torch.exp(-0.5 * (at / SSIM_SIGMA) ** 2)
    window = torch.outer(line, line) / line.sum() ** 2

    def blur(x: Tensor) -> Tensor:
        return functional.conv2d(x[:, None], window[None, None], padding=RADIUS)[:, 0]

    m1, m2 = blur(image), blur(target)
    s1, s2, s12 = blur(image**2) - m1**2, blur(target**2) - m2**2, blur(image * target) - m1 * m2
    return ((2 * m1 * m2 + C1) * (2 * s12 + C2) / ((m1**2 + m2**2 + C1) * (s1 + s2 + C2))).mean()
