"""3-tuples as vectors, in kernels."""

from __future__ import annotations

from typing import Any

from spike4dgs.method.splat.kernels.jit import helper


@helper
def dot(a: Any, b: Any) -> float:
    """Return a . b of two 3-tuples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@helper
def cross(a: Any, b: Any) -> Any:
    """Return a x b of two 3-tuples."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@helper
def combined(x: float, a: Any, y: float, b: Any) -> Any:
    """Return x a + y b of two 3-tuples."""
    return x * a[0] + y * b[0], x * a[1] + y * b[1], x * a[2] + y * b[2]
