"""The gradient of the projection: from each Gaussian's summed moments to its parameters and the camera pose, float64.

Symbols as in project.py. With p = dx / sqrt(xx) and q = (dy - slope dx) / sqrt(r), r = det / xx, a Gaussian is
ln(alpha) = ln(o) - p^2 / 2 - q^2 / 2, and the rasteriser delivers the sums of s, s p, s q, s p^2, s p q, s q^2 over
its pixels, s = dL/d ln(alpha) (up to the factor between xi, eta and p, q). Their chain rule has no cancelling terms:

    d/d center_x = s p / sqrt(xx) - slope s q / sqrt(r)      d/d slope = s p q sqrt(xx / r)
    d/d center_y = s q / sqrt(r)                             d/d xx = s p^2 / (2 xx)     d/d r = s q^2 / (2 r)

and det = |b0 x b1|^2 + eps2d (|b0|^2 + |b1|^2) + eps2d^2 has the gradient 2 b1 x (b0 x b1) + 2 eps2d b0 in b0.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from spike4dgs.method.splat.kernels.blend_ir import MOMENTS
from spike4dgs.method.splat.kernels.jit import helper, kernel
from spike4dgs.method.splat.kernels.lens import curved, curved_gradient, lens_constants, straight, straight_gradient
from spike4dgs.method.splat.kernels.project import (
    BLOCK,
    CULLED,
    MX,
    MY,
    MZ,
    OP,
    QW,
    QX,
    QY,
    QZ,
    SX,
    SY,
    SZ,
    camera_constants,
    gather_parameters,
    half_covariance,
    jacobian,
    rotation,
)  # fmt: skip
from spike4dgs.method.splat.kernels.triples import cross, dot
from spike4dgs.method.splat.kernels.vector_ir import fetch_add

ROWS = 43  # rows of the scratch array: the 11 parameters, then
M0, MP, MQ, MPP, MPQ, MQQ, GDEPTH = (k * BLOCK for k in range(11, 18))
POSE = 18 * BLOCK  # 12 rows: dL/d[R | t], row by row
GX, GY, GZ, GQW, GQX, GQY, GQZ, GSX, GSY, GSZ, GOP, GCX, GCY = (k * BLOCK for k in range(30, 43))
P_PER_XI = math.sqrt(2 * math.log(2.0))  # p = xi sqrt(2 ln 2), likewise q and eta


class Records(NamedTuple):
    """The gradient records that the rasteriser wrote, one per Gaussian-tile pair."""

    keys: np.ndarray  # [V, N] uint32: depth bits or CULLED
    slots: np.ndarray  # [V, N + 1] int32: Gaussian i of view v owns the pairs slots[v, i]:slots[v, i + 1]
    sums: np.ndarray  # [chunks, pairs, 8 or 16] float32: six moments and the colour gradients
    depth_channel: int  # the channel that holds the depth, or -1


class Gradients(NamedTuple):
    """dLoss of the Gaussians: `centers` and `poses` are written, the others are added to."""

    means: np.ndarray  # [N, 3]
    quats: np.ndarray  # [N, 4]
    scales: np.ndarray  # [N, 3]
    opacities: np.ndarray  # [N]
    colors: np.ndarray  # [N, F] float32
    centers: np.ndarray  # [V, N, 2] px
    poses: np.ndarray  # [V, blocks, 12], or empty: dL/d[R | t], row by row, summed over each block


@kernel
def project_backward(
    geometry: Any, cameras: Any, records: Any, gradients: Any, counter: Any, s: Any, lanes: Any
) -> None:
    """Sum each Gaussian's `Records` over its tiles and chain them to the parameters: `Gradients`.

    A block of Gaussians is one work item with all its views, in their order: so the sums are the same bits on any
    number of threads, and no thread needs gradients of its own. s and lanes are scratch.
    """
    keys, chunks, n_colors = records.keys, records.sums.shape[0], gradients.colors.shape[1]
    n_all, views = len(geometry.means), len(cameras.entries)
    per_chunk = 4 if chunks > 1 else n_colors + (records.depth_channel >= 0)  # as `cpu.chunking` has them
    while True:
        block = fetch_add(counter, 0, 1)
        first = block * BLOCK
        if first >= n_all:
            break
        for view in range(views):
            n = 0
            for i in range(first, min(first + BLOCK, n_all)):
                gradients.centers[view, i, 0], gradients.centers[view, i, 1] = 0, 0
                if keys[view, i] == CULLED:
                    continue
                gather_parameters(s, n, i, geometry)
                gather_gradients(s, n, view, i, records, gradients.colors, per_chunk)
                lanes[n] = i
                n += 1
            if n:
                differentiate_lanes(s, n, lanes[0], geometry, cameras, view)
            for l in range(n):  # noqa: E741
                add_gradients(s, l, view, lanes[l], gradients)
            if gradients.poses.size:
                for k in range(12):
                    total = 0.0
                    for l in range(n):  # noqa: E741
                        total += s[POSE + k * BLOCK + l]
                    gradients.poses[view, block, k] = total


@helper
def differentiate_lanes(s: np.ndarray, n: int, some: int, geometry: Any, cameras: Any, view: int) -> None:
    """Chain the moments of the first n lanes; those that fill the last vector hold Gaussian `some`."""
    R, t, f, limits = camera_constants(cameras, view)
    rounded = (n + 7) // 8 * 8
    for l in range(n, rounded):  # noqa: E741
        gather_parameters(s, l, some, geometry)
        for row in range(MOMENTS + 1):
            s[M0 + row * BLOCK + l] = 0.0
    eps2d, antialiased = cameras.eps2d, cameras.antialiased
    if len(cameras.lenses):
        lens, limits = lens_constants(cameras, view)
        for l in range(rounded):  # noqa: E741
            differentiate_lane(s, l, R, t, f, limits, eps2d, antialiased, curved, curved_gradient, lens)
    else:
        for l in range(rounded):  # noqa: E741
            differentiate_lane(s, l, R, t, f, limits, eps2d, antialiased, straight, straight_gradient, None)


@helper
def add_gradients(s: np.ndarray, l: int, view: int, i: int, gradients: Any) -> None:  # noqa: E741
    """Add lane l to the gradients of Gaussian i."""
    for k in range(3):
        gradients.means[i, k] += s[GX + k * BLOCK + l]
        gradients.scales[i, k] += s[GSX + k * BLOCK + l]
    for k in range(4):
        gradients.quats[i, k] += s[GQW + k * BLOCK + l]
    gradients.opacities[i] += s[GOP + l]
    gradients.centers[view, i, 0], gradients.centers[view, i, 1] = s[GCX + l], s[GCY + l]


@helper
def gather_gradients(
    s: np.ndarray, l: int, view: int, i: int, records: Any, d_colors: Any, per_chunk: int  # noqa: E741
) -> None:  # fmt: skip
    """Add up Gaussian i's records over its tiles, in their order, into lane l and d_colors[i]."""
    _, _, sums, depth_channel = records
    begin, end = records.slots[view, i], records.slots[view, i + 1]
    m0, mp, mq, mpp, mpq, mqq = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for chunk in range(sums.shape[0]):
        for slot in range(begin, end):
            m0, mp, mq = m0 + sums[chunk, slot, 0], mp + sums[chunk, slot, 1], mq + sums[chunk, slot, 2]
            mpp, mpq, mqq = mpp + sums[chunk, slot, 3], mpq + sums[chunk, slot, 4], mqq + sums[chunk, slot, 5]
    s[M0 + l], s[MP + l], s[MQ + l], s[MPP + l], s[MPQ + l], s[MQQ + l] = m0, mp, mq, mpp, mpq, mqq
    s[GDEPTH + l] = 0.0
    for channel in range(d_colors.shape[1] + (depth_channel >= 0)):
        chunk, row, total = channel // per_chunk, MOMENTS + channel % per_chunk, 0.0
        for slot in range(begin, end):
            total += sums[chunk, slot, row]
        if channel == depth_channel:
            s[GDEPTH + l] = total
        else:
            d_colors[i, channel] += total


@helper
def outer_rows(e0: Any, e1: Any, a: Any) -> Any:
    """Return E A^T for E with rows e0, e1 (3-tuples) and a 3 x 3 matrix A given row by row."""
    r0, r1, r2 = (a[0], a[1], a[2]), (a[3], a[4], a[5]), (a[6], a[7], a[8])
    return (dot(e0, r0), dot(e0, r1), dot(e0, r2)), (dot(e1, r0), dot(e1, r1), dot(e1, r2))


@helper
def covariance_gradient(s: np.ndarray, l: int, b0: Any, b1: Any, eps2d: float, antialiased: bool) -> Any:  # noqa: E741
    """Return the gradients of the centre (x, y) and of b0, b1 from the moments of lane l."""
    m0, mp, mq = s[M0 + l], s[MP + l] * P_PER_XI, s[MQ + l] * P_PER_XI
    unit = P_PER_XI * P_PER_XI
    mpp, mpq, mqq = s[MPP + l] * unit, s[MPQ + l] * unit, s[MQQ + l] * unit
    g = cross(b0, b1)
    det_sharp, xx, xy, yy = dot(g, g), dot(b0, b0), dot(b0, b1), dot(b1, b1)
    det = det_sharp + eps2d * (xx + yy) + eps2d * eps2d
    xx = xx + eps2d
    slope, inverse_xx, r = xy / xx, 1.0 / xx, det / xx
    root_xx, root_r = math.sqrt(xx), math.sqrt(r)
    d_cy = mq / root_r
    d_cx = mp / root_xx - slope * d_cy
    d_r, d_xy = 0.5 * mqq / r, mpq * root_xx / root_r * inverse_xx
    d_xx = 0.5 * mpp * inverse_xx - d_r * r * inverse_xx - d_xy * slope
    d_det = d_r * inverse_xx
    # antialiased: ln(o) carries half of ln(det_sharp / det)
    d_sharp = 0.5 * m0 / det_sharp if antialiased else 0.0
    d_det = d_det - 0.5 * m0 / det if antialiased else d_det
    along0, along1, minor = 2.0 * (eps2d * d_det + d_xx), 2.0 * eps2d * d_det, 2.0 * (d_det + d_sharp)
    c0, c1 = cross(b1, g), cross(g, b0)
    d_b0 = (
        minor * c0[0] + along0 * b0[0] + d_xy * b1[0],
        minor * c0[1] + along0 * b0[1] + d_xy * b1[1],
        minor * c0[2] + along0 * b0[2] + d_xy * b1[2],
    )
    d_b1 = (
        minor * c1[0] + along1 * b1[0] + d_xy * b0[0],
        minor * c1[1] + along1 * b1[1] + d_xy * b0[1],
        minor * c1[2] + along1 * b1[2] + d_xy * b0[2],
    )
    return d_cx, d_cy, d_b0, d_b1


@helper
def quaternion_gradient(w: float, x: float, y: float, z: float, m: Any) -> Any:
    """Return dL/d quaternion from dL/dR (row by row): orthogonal to the quaternion, as its length does not matter."""
    inverse = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w * inverse, x * inverse, y * inverse, z * inverse
    gw = 2.0 * (x * (m[7] - m[5]) + y * (m[2] - m[6]) + z * (m[3] - m[1]))
    gx = 2.0 * (y * (m[3] + m[1]) + z * (m[6] + m[2]) + w * (m[7] - m[5]) - 2.0 * x * (m[4] + m[8]))
    gy = 2.0 * (x * (m[3] + m[1]) + z * (m[7] + m[5]) + w * (m[2] - m[6]) - 2.0 * y * (m[0] + m[8]))
    gz = 2.0 * (x * (m[6] + m[2]) + y * (m[7] + m[5]) + w * (m[3] - m[1]) - 2.0 * z * (m[0] + m[4]))
    radial = gw * w + gx * x + gy * y + gz * z
    return (
        (gw - radial * w) * inverse,
        (gx - radial * x) * inverse,
        (gy - radial * y) * inverse,
        (gz - radial * z) * inverse,
    )


@helper
def differentiate_lane(
    s: np.ndarray, l: int, R: Any, t: Any, f: Any, limits: Any, eps2d: float, antialiased: bool,  # noqa: E741
    through: Any, back_through: Any, lens: Any,
) -> None:  # fmt: skip
    """Chain the moments of lane l, which is visible, `back_through` a lens to its parameters and to the pose."""
    mx, my, mz = s[MX + l], s[MY + l], s[MZ + l]
    sx, sy, sz = s[SX + l], s[SY + l], s[SZ + l]
    x, y = R[0] * mx + R[1] * my + R[2] * mz + t[0], R[3] * mx + R[4] * my + R[5] * mz + t[1]
    inverse_z = 1.0 / (R[6] * mx + R[7] * my + R[8] * mz + t[2])
    u, v = x * inverse_z, y * inverse_z
    j = jacobian(f, limits, u, v, inverse_z)
    q = rotation(s[QW + l], s[QX + l], s[QY + l], s[QZ + l])
    a = (q[0] * sx, q[1] * sy, q[2] * sz, q[3] * sx, q[4] * sy, q[5] * sz, q[6] * sx, q[7] * sy, q[8] * sz)
    t0, t1, b0, b1 = half_covariance(R, j, a)
    _, _, _, c0, c1 = through(lens, f, limits, u, v, b0, b1)
    d_cx, d_cy, d_b0, d_b1 = covariance_gradient(s, l, c0, c1, eps2d, antialiased)
    s[GCX + l], s[GCY + l], s[GOP + l] = d_cx, d_cy, s[M0 + l] / s[OP + l]
    d_cx, d_cy, d_b0, d_b1 = back_through(lens, f, limits, u, v, b0, b1, d_cx, d_cy, d_b0, d_b1)
    # B = T A: dL/dT = dB A^T, dL/dA = T^T dB, and T = J R: dL/dJ = dT R^T, dL/dR = J^T dT
    w0, w1 = outer_rows(d_b0, d_b1, a)
    j0, j1 = outer_rows(w0, w1, R)
    d_jx, d_jxz, d_jy, d_jyz = j0[0], j0[2], j1[1], j1[2]
    free_u = 1.0 if (u >= limits[0]) & (u <= limits[1]) else 0.0  # the point of linearisation moves with the centre
    free_v = 1.0 if (v >= limits[2]) & (v <= limits[3]) else 0.0
    gx = d_cx * j[0] - free_u * d_jxz * j[0] * inverse_z
    gy = d_cy * j[2] - free_v * d_jyz * j[2] * inverse_z
    gz = s[GDEPTH + l] - (d_cx * j[0] * u + d_cy * j[2] * v) - (d_jx * j[0] + d_jy * j[2]) * inverse_z
    gz = gz - (d_jxz * (1.0 + free_u) * j[1] + d_jyz * (1.0 + free_v) * j[3]) * inverse_z
    s[GX + l], s[GY + l] = R[0] * gx + R[3] * gy + R[6] * gz, R[1] * gx + R[4] * gy + R[7] * gz
    s[GZ + l] = R[2] * gx + R[5] * gy + R[8] * gz
    m = (
        t0[0] * d_b0[0] + t1[0] * d_b1[0], t0[0] * d_b0[1] + t1[0] * d_b1[1], t0[0] * d_b0[2] + t1[0] * d_b1[2],
        t0[1] * d_b0[0] + t1[1] * d_b1[0], t0[1] * d_b0[1] + t1[1] * d_b1[1], t0[1] * d_b0[2] + t1[1] * d_b1[2],
        t0[2] * d_b0[0] + t1[2] * d_b1[0], t0[2] * d_b0[1] + t1[2] * d_b1[1], t0[2] * d_b0[2] + t1[2] * d_b1[2],
    )  # fmt: skip
    s[GSX + l] = m[0] * q[0] + m[3] * q[3] + m[6] * q[6]
    s[GSY + l] = m[1] * q[1] + m[4] * q[4] + m[7] * q[7]
    s[GSZ + l] = m[2] * q[2] + m[5] * q[5] + m[8] * q[8]
    m = (m[0] * sx, m[1] * sy, m[2] * sz, m[3] * sx, m[4] * sy, m[5] * sz, m[6] * sx, m[7] * sy, m[8] * sz)
    gq = quaternion_gradient(s[QW + l], s[QX + l], s[QY + l], s[QZ + l], m)
    s[GQW + l], s[GQX + l], s[GQY + l], s[GQZ + l] = gq[0], gq[1], gq[2], gq[3]
    p = POSE + l
    s[p], s[p + BLOCK], s[p + 2 * BLOCK], s[p + 3 * BLOCK] = (
        j[0] * w0[0] + gx * mx, j[0] * w0[1] + gx * my, j[0] * w0[2] + gx * mz, gx,
    )  # fmt: skip
    s[p + 4 * BLOCK], s[p + 5 * BLOCK], s[p + 6 * BLOCK], s[p + 7 * BLOCK] = (
        j[2] * w1[0] + gy * mx, j[2] * w1[1] + gy * my, j[2] * w1[2] + gy * mz, gy,
    )  # fmt: skip
    s[p + 8 * BLOCK], s[p + 9 * BLOCK], s[p + 10 * BLOCK], s[p + 11 * BLOCK] = (
        j[1] * w0[0] + j[3] * w1[0] + gz * mx, j[1] * w0[1] + j[3] * w1[1] + gz * my,
        j[1] * w0[2] + j[3] * w1[2] + gz * mz, gz,
    )  # fmt: skip
