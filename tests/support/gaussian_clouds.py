"""Gaussians of every spacetime parameter, for tests of motion models."""

import torch
from torch import Tensor

from spike4dgs.method.gaussians.parameters import Gaussians


def cloud(n: int = 12, seed: int = 0, dtype: torch.dtype = torch.float32) -> Gaussians:
    """Gaussians of which no parameter is at its first value."""
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng, dtype=dtype)

    extra = {
        "times": torch.rand(n, generator=rng, dtype=dtype),
        "log_temporal_scales": 0.5 * normal(n) - 1,
        "coefficients": 0.3 * normal(n, 9),
        "angular_velocities": 0.3 * normal(n, 4),
        "features": normal(n, 2),
    }
    return Gaussians(normal(n, 3), normal(n, 3) - 3, normal(n, 4), normal(n), normal(n, 1).abs(), extra)
