"""A back end of the rasteriser against the float64 reference: images, and gradients of all inputs."""

from __future__ import annotations

from spike4dgs.method.hard_cases.splat import GRADIENT_TOLERANCE, IMAGE_TOLERANCE, MOST_ON_CUTOFF, parity
from spike4dgs.method.splat import Splats, Views


def compare(
    splats: Splats, v: Views, backend: str, device: str = "cpu", *, depth: bool = False, antialiased: bool = False
) -> None:
    """Assert that a back end on a device gives the reference's images and gradients."""
    found = parity(splats, v, backend, device, depth=depth, antialiased=antialiased)
    assert found.on_cutoff <= MOST_ON_CUTOFF, "too many pixels are on a cut-off"
    assert found.visible and found.finite_image and found.finite_gradient
    assert found.image <= IMAGE_TOLERANCE
    assert found.gradient <= GRADIENT_TOLERANCE, found.worst_leaf
