"""What a lens does to a projected Gaussian, and to the gradient; and nothing, in the place of that, for pinholes.

Kernels take one pair of these functions or the other, chosen as they are compiled: pinholes pay nothing for lenses.

With f = diag(fx, fy) and D the lens's derivatives at the point of linearisation, the half covariance of the pinhole's
image becomes B = f D f^-1 B_pinhole, and the centre follows the lens. A lens is k1, k2, p1, p2, k3 and fold^2.
"""

from __future__ import annotations

from typing import Any

from spike4dgs.benchmark.scene import lens as formulas
from spike4dgs.method.splat.kernels.jit import helper
from spike4dgs.method.splat.kernels.triples import combined, dot

bend, slopes, curvatures = (helper(f) for f in (formulas.bend, formulas.slopes, formulas.curvatures))


@helper
def lens_constants(cameras: Any, view: int) -> Any:
    """Return the lens of a view as scalars, and the limits of x/z and y/z."""
    row = cameras.lenses[view]
    return (row[0], row[1], row[2], row[3], row[4], row[9]), (row[5], row[6], row[7], row[8])


@helper
def held(limits: Any, u: float, v: float) -> Any:
    """Return the point at which the projection is linearised."""
    return min(max(u, limits[0]), limits[1]), min(max(v, limits[2]), limits[3])


@helper
def straight(lens: Any, f: Any, limits: Any, u: float, v: float, b0: Any, b1: Any) -> Any:
    """Return u, v, whether they are seen, and b0, b1, as they are: there is no lens."""
    return u, v, True, b0, b1


@helper
def curved(lens: Any, f: Any, limits: Any, u: float, v: float, b0: Any, b1: Any) -> Any:
    """Return the lens's coordinates of (u, v), whether the lens shows them, and b0, b1 as the lens shows them."""
    k = (lens[0], lens[1], lens[2], lens[3], lens[4])
    xx, xy, yy = slopes(u, v, k)
    shown = (u * u + v * v < lens[5]) & (xx * yy > xy * xy)
    bent_u, bent_v = bend(u, v, k)
    held_u, held_v = held(limits, u, v)
    xx, xy, yy = slopes(held_u, held_v, k)
    right, down = xy * (f[0] / f[1]), xy * (f[1] / f[0])
    return bent_u, bent_v, shown, combined(xx, b0, right, b1), combined(down, b0, yy, b1)


@helper
def straight_gradient(
    lens: Any, f: Any, limits: Any, u: float, v: float, b0: Any, b1: Any, d_cx: float, d_cy: float, d_b0: Any, d_b1: Any
) -> Any:
    """Return the gradients of the centre (x, y) and of b0, b1 as they are: there is no lens."""
    return d_cx, d_cy, d_b0, d_b1


@helper
def curved_gradient(
    lens: Any, f: Any, limits: Any, u: float, v: float, b0: Any, b1: Any, d_cx: float, d_cy: float, d_b0: Any, d_b1: Any
) -> Any:
    """Return the gradients of a pinhole's centre and of its b0, b1 from those of the lens's.

    The pinhole's centre moves (u, v) alone, so its gradient holds all that does so: the point of linearisation too.
    """
    k = (lens[0], lens[1], lens[2], lens[3], lens[4])
    held_u, held_v = held(limits, u, v)
    ratio, back = f[0] / f[1], f[1] / f[0]
    d_xx, d_xy, d_yy = dot(d_b0, b0), dot(d_b0, b1) * ratio + dot(d_b1, b0) * back, dot(d_b1, b1)
    xxx, xxy, xyy, yyy = curvatures(held_u, held_v, k)
    d_u = (d_xx * xxx + d_xy * xxy + d_yy * xyy) if held_u == u else 0.0
    d_v = (d_xx * xxy + d_xy * xyy + d_yy * yyy) if held_v == v else 0.0
    xx, xy, yy = slopes(u, v, k)
    d_u, d_v = d_u + d_cx * f[0] * xx + d_cy * f[1] * xy, d_v + d_cx * f[0] * xy + d_cy * f[1] * yy
    xx, xy, yy = slopes(held_u, held_v, k)
    right, down = xy * ratio, xy * back
    return d_u / f[0], d_v / f[1], combined(xx, d_b0, down, d_b1), combined(right, d_b0, yy, d_b1)
