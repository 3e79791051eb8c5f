"""The fused SSIM of training against its float64 twin, scikit-image and closed forms."""

import numpy as np
import pytest
import torch
from hard_case import BYTES, HardCase, core_counts
from skimage.metrics import structural_similarity

from spike4dgs.benchmark.errors import UserError
from spike4dgs.method.splat import set_threads
from spike4dgs.method.splat.kernels.threads import get_threads
from spike4dgs.method.splat.ssim import _banded, _convolved, ssim, ssim_reference
from spike4dgs.method.supervision.base import difference


def images(batch: int, height: int, width: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    a = torch.rand(batch, height, width, generator=g)
    return a, (a + 0.2 * torch.randn(batch, height, width, generator=g)).clamp(0, 1.5)


@pytest.mark.parametrize("delta", [0.0, 1e-3, 0.02, 10.0])
@pytest.mark.parametrize("w", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("shape", [(2, 125, 200), (3, 24, 40), (2, 11, 33), (2, 7, 5), (1, 1, 1)])
def test_the_loss_equals_its_two_terms(shape: tuple[int, int, int], w: float, delta: float) -> None:
    a, b = images(*shape)
    b[..., 0] = a[..., 0]  # |d| has no gradient at 0
    fast, slow = a.clone().requires_grad_(), a.double().requires_grad_()
    value, d = difference(fast, b, w, delta), (slow - b.double()).abs()
    h = torch.where(d < delta, d * d / (2 * max(delta, 1e-9)), d - delta / 2)
    expected = (1 - w) * h.mean() + w * (1 - ssim_reference(slow, b.double()))
    value.backward()
    expected.backward()
    assert value.item() == pytest.approx(expected.item(), abs=1e-6)
    assert fast.grad is not None and slow.grad is not None
    assert (fast.grad - slow.grad).norm() <= 1e-5 * slow.grad.norm() + 1e-6


@pytest.mark.parametrize("shape", [(1, 125, 200), (2, 7, 5), (1, 1, 1)])
def test_matrix_products_blur_as_convolutions_do(shape: tuple[int, int, int]) -> None:
    """The blur of other devices."""
    x = images(*shape)[0].double()
    torch.testing.assert_close(_banded(x), _convolved(x))


def test_inner_region_equals_scikit_image() -> None:
    a, b = images(1, 64, 80)
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1, "full": True}
    full = structural_similarity(a[0].double().numpy(), b[0].double().numpy(), **options)[1]
    # Padding differs only within half a window of the border.
    inner = ssim_map(a, b)[5:-5, 5:-5]
    np.testing.assert_allclose(inner, full[5:-5, 5:-5], atol=1e-9)


def ssim_map(a: torch.Tensor, b: torch.Tensor) -> np.ndarray:
    """Return the twin's map, per pixel, in float64."""
    window = torch.as_tensor(np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2))
    window = (window / window.sum()).view(1, 1, 1, -1)

    def blur(x: torch.Tensor) -> torch.Tensor:
        rows = torch.nn.functional.conv2d(x[:, None], window, padding=(0, 5))
        return torch.nn.functional.conv2d(rows, window.transpose(2, 3), padding=(5, 0))[:, 0]

    x, y = a.double(), b.double()
    m1, m2 = blur(x), blur(y)
    s1, s2, s12 = blur(x * x) - m1**2, blur(y * y) - m2**2, blur(x * y) - m1 * m2
    full = (2 * m1 * m2 + 1e-4) * (2 * s12 + 9e-4) / ((m1**2 + m2**2 + 1e-4) * (s1 + s2 + 9e-4))
    assert abs(full.mean().item() - ssim_reference(x, y).item()) < 1e-12
    return full[0].numpy()


def test_identical_images_have_value_one_and_no_gradient() -> None:
    a, _ = images(2, 40, 30)
    x = a.clone().requires_grad_()
    value = ssim(x, a)
    value.backward()
    assert value.item() == pytest.approx(1, abs=1e-6)
    assert x.grad is not None and x.grad.abs().max() < 1e-6


@pytest.mark.hard_case(asked="SSIM of training and its gradient", twin="one thread", **BYTES, kind="threads")
def test_threads(hard_case: HardCase) -> None:
    a, b = images(5, 50, 60)
    results, before, counts = [], get_threads(), [*core_counts(), core_counts()[-1] + 1]
    try:
        for count in counts:
            set_threads(count)
            x = a.clone().requires_grad_()
            value = ssim(x, b)
            value.backward()
            results.append(value.detach().numpy().tobytes() + x.grad.numpy().tobytes())
    finally:
        set_threads(before)
    hard_case.same_bytes(results, [f"{n} threads" for n in counts])


def test_shapes_are_checked() -> None:
    with pytest.raises(UserError, match=r"two batches \[B, H, W\]"):
        ssim(torch.zeros(3, 4), torch.zeros(3, 4))
    with pytest.raises(UserError, match="without gradient"):
        ssim(torch.zeros(1, 3, 4), torch.zeros(1, 3, 4, requires_grad=True))
