"""The kernels of polynomial paths against plain torch in float64: values and gradients."""

import pytest
import torch

from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.motion.polynomial import at_time, at_time_reference

SIDES = {
    "means": (3,), "log_scales": (3,), "quats": (4,), "logits": (), "colors": (1,), "times": (),
    "log_temporal_scales": (), "coefficients": (9,), "angular_velocities": (4,),
}  # fmt: skip


def random_gaussians(n: int, spread: float) -> Gaussians:
    g = torch.Generator().manual_seed(n)
    return Gaussians.from_tensors({k: spread * torch.randn(n, *s, generator=g) for k, s in SIDES.items()}).trainable()


def close(found: torch.Tensor, expected: torch.Tensor) -> None:
    """Allow float32's rounding of terms as large as the largest value, of which a sum may leave little."""
    largest = float(expected.detach().abs().max()) if expected.numel() else 0.0
    torch.testing.assert_close(found.double(), expected, rtol=2e-5, atol=2e-6 * max(largest, 1.0))


@pytest.mark.parametrize("t", [0.0, 0.37, 1.0])
@pytest.mark.parametrize(("n", "spread"), [(0, 1.0), (1, 1.0), (3000, 1.0), (3000, 5.0)])
def test_values_and_gradients_are_those_of_the_twin(n: int, spread: float, t: float) -> None:
    fast = random_gaussians(n, spread)
    slow = Gaussians.from_tensors({k: v.detach().double().requires_grad_() for k, v in fast.tensors().items()})
    found, expected = at_time(fast, t), at_time_reference(slow, t)
    weights = [torch.randn(x.shape, generator=torch.Generator().manual_seed(i)) for i, x in enumerate(found)]
    for values in (found, expected):
        sum((v * w).sum() for v, w in zip(values, weights, strict=True)).backward()
    for a, b in zip(found, expected, strict=True):
        close(a, b)
    for name, value in fast.tensors().items():
        if name != "colors":
            close(value.grad, slow.tensors()[name].grad)


def test_float64_gaussians_keep_their_precision() -> None:
    g = random_gaussians(10, 1.0)
    exact = Gaussians.from_tensors({k: v.detach().double() for k, v in g.tensors().items()})
    assert all(x.dtype == torch.float64 for x in at_time(exact, 0.5))
