"""Projection of Gaussians into views, in float64. Its gradient is in project_gradient.py.

A few Gaussians' arithmetic is cheap beside the pixels', and needles, huge pancakes and worlds whose origin is far away
lose what float32 has. Blocks of Gaussians are copied into rows of a scratch array (structure of arrays) so that LLVM
vectorises the arithmetic; constant row offsets let it prove that rows do not overlap.

Symbols: p = (x, y, z) in the camera; J = [[jx, 0, jxz], [0, jy, jyz]]; A = R diag(scales); T = J R_w2c;
B = T A with rows b0, b1; the blurred 2D covariance is [[xx, xy], [xy, yy]] = B B^T + eps2d I.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from spike4dgs.method.splat.kernels.blend_ir import TILE_HEIGHT, TILE_WIDTH
from spike4dgs.method.splat.kernels.jit import helper, kernel
from spike4dgs.method.splat.kernels.lens import curved, held, lens_constants, straight
from spike4dgs.method.splat.kernels.triples import cross, dot
from spike4dgs.method.splat.kernels.vector_ir import bits_double, double_bits, fetch_add, float_bits
from spike4dgs.method.splat.lens import FRUSTUM_MARGIN
from spike4dgs.method.splat.types import ALPHA_MIN, NEAR

BLOCK = 128  # Gaussians per work item
CULLED = np.uint32(0xFFFFFFFF)  # depth key of an invisible Gaussian
ROWS = 22  # rows of the scratch array
HALF_LOG2E = 0.5 / math.log(2.0)

# Scratch rows: the parameters, then the projection.
MX, MY, MZ, QW, QX, QY, QZ, SX, SY, SZ, OP = (k * BLOCK for k in range(11))
CX, CY, SLOPE, HX, HY, XTOP, XIS, ETAS, RATIO, DEPTH, BAD = (k * BLOCK for k in range(11, 22))


class Geometry(NamedTuple):
    """The parameters of N Gaussians that decide where they are seen: arrays of one dtype."""

    means: np.ndarray  # [N, 3]
    quats: np.ndarray  # [N, 4]
    scales: np.ndarray  # [N, 3]
    opacities: np.ndarray  # [N]


class Cameras(NamedTuple):
    """V cameras of one image size, a row of `entries` for each, and the pixel filter of their images."""

    entries: np.ndarray  # [V, 16] float64: R row by row (9), t (3), fx, fy, cx, cy
    lenses: np.ndarray  # [V, 10] float64, see method/splat/lens.py; [0, 10]: pinholes
    width: int
    height: int
    eps2d: float
    antialiased: bool


class Projected(NamedTuple):
    """The outputs of `project_forward`: per view and Gaussian, and in the last two per view and block."""

    records: np.ndarray  # [V, N, 8] float64, see blend_ir.py
    keys: np.ndarray  # [V, N] uint32: depth bits or CULLED
    depths: np.ndarray  # [V, N] float32
    centers: np.ndarray  # [V, N, 2] px, 0 where culled
    radii: np.ndarray  # [V, N] px, 0 where culled
    tiles: np.ndarray  # [V, N, 4] int32: first and last + 1 tile in x, in y
    histogram: np.ndarray  # [V, blocks, 1 + tiles] int32: total and per-tile count of Gaussian-tile pairs
    invalid: np.ndarray  # [V, blocks] int64: a Gaussian with a parameter that is not finite, or -1


@helper
def floor_int(x: float) -> int:
    """Return the largest integer <= x (math.floor would be a library call that spills every vector register)."""
    i = np.int64(x)
    return i - np.int64(np.float64(i) > x)


@helper
def ceil_int(x: float) -> int:
    """Return the smallest integer >= x."""
    i = np.int64(x)
    return i + np.int64(np.float64(i) < x)


@helper
def log2(x: float) -> float:
    """Return log2 of a positive normal number to 3e-11: atanh series around the nearest power of two."""
    bits = double_bits(x)
    # An exponent written into the low mantissa bits of 2^52 becomes a number by subtraction.
    exponent = bits_double((bits >> 52) | 0x4330000000000000) - 4503599627371519.0
    m = bits_double((bits & 0x000FFFFFFFFFFFFF) | 0x3FF0000000000000)
    large = m > 1.4142135623730951
    m = 0.5 * m if large else m
    exponent = exponent + 1.0 if large else exponent
    s = (m - 1.0) / (m + 1.0)
    s2 = s * s
    series = 1 / 3 + s2 * (1 / 5 + s2 * (1 / 7 + s2 * (1 / 9 + s2 * (1 / 11))))
    return exponent + 2.8853900817779268 * s * (1.0 + s2 * series)


@helper
def rotation(w: float, x: float, y: float, z: float) -> Any:
    """Return the rotation matrix, row by row, of a quaternion of any length."""
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return (
        1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
        s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x),
        s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y),
    )  # fmt: skip


@helper
def camera_constants(cameras: Any, view: int) -> Any:
    """Return R, t and (fx, fy, cx, cy) of a view as scalars, and the limits of x/z and y/z."""
    camera, width, height = cameras.entries[view], cameras.width, cameras.height
    fx, fy, cx, cy = camera[12], camera[13], camera[14], camera[15]
    mx, my = FRUSTUM_MARGIN * 0.5 * width / fx, FRUSTUM_MARGIN * 0.5 * height / fy
    limits = (-cx / fx - mx, (width - cx) / fx + mx, -cy / fy - my, (height - cy) / fy + my)
    R = (camera[0], camera[1], camera[2], camera[3], camera[4], camera[5], camera[6], camera[7], camera[8])
    return R, (camera[9], camera[10], camera[11]), (fx, fy, cx, cy), limits


@helper
def jacobian(f: Any, limits: Any, u: float, v: float, inverse_z: float) -> Any:
    """Return jx, jxz, jy, jyz of the projection at the point (u, v) = (x/z, y/z), held inside the limits."""
    held_u, held_v = held(limits, u, v)
    jx, jy = f[0] * inverse_z, f[1] * inverse_z
    return jx, -jx * held_u, jy, -jy * held_v


@helper
def half_covariance(R: Any, j: Any, a: Any) -> Any:
    """Return T = J R and B = T A, each as two rows of three. a: A row by row."""
    t0 = (j[0] * R[0] + j[1] * R[6], j[0] * R[1] + j[1] * R[7], j[0] * R[2] + j[1] * R[8])
    t1 = (j[2] * R[3] + j[3] * R[6], j[2] * R[4] + j[3] * R[7], j[2] * R[5] + j[3] * R[8])
    b0 = (
        t0[0] * a[0] + t0[1] * a[3] + t0[2] * a[6],
        t0[0] * a[1] + t0[1] * a[4] + t0[2] * a[7],
        t0[0] * a[2] + t0[1] * a[5] + t0[2] * a[8],
    )
    b1 = (
        t1[0] * a[0] + t1[1] * a[3] + t1[2] * a[6],
        t1[0] * a[1] + t1[1] * a[4] + t1[2] * a[7],
        t1[0] * a[2] + t1[1] * a[5] + t1[2] * a[8],
    )
    return t0, t1, b0, b1


@helper
def gather_parameters(s: np.ndarray, l: int, i: int, geometry: Any) -> None:  # noqa: E741
    """Copy Gaussian i into lane l."""
    means, quats, scales, opacities = geometry
    s[MX + l], s[MY + l], s[MZ + l] = means[i, 0], means[i, 1], means[i, 2]
    s[QW + l], s[QX + l], s[QY + l], s[QZ + l] = quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3]
    s[SX + l], s[SY + l], s[SZ + l], s[OP + l] = scales[i, 0], scales[i, 1], scales[i, 2], opacities[i]


@kernel
def project_forward(geometry: Any, cameras: Any, out: Any, counter: Any, s: Any) -> None:
    """Project all Gaussians (a `Geometry`) into all `Cameras` and fill `out` (a `Projected`)."""
    views, (_, _, width, height, eps2d, antialiased) = len(cameras.entries), cameras
    n_all, across = len(geometry.means), (width + TILE_WIDTH - 1) // TILE_WIDTH
    blocks = (n_all + BLOCK - 1) // BLOCK
    while True:
        item = fetch_add(counter, 0, 1)
        if item >= views * blocks:
            break
        view, block = item // blocks, item % blocks
        R, t, f, limits = camera_constants(cameras, view)
        records, keys, depths, centers = out.records[view], out.keys[view], out.depths[view], out.centers[view]
        radii, tiles, histogram, invalid = out.radii[view], out.tiles[view], out.histogram[view], out.invalid[view]
        first = block * BLOCK
        n = min(BLOCK, n_all - first)
        for l in range(n):  # noqa: E741
            gather_parameters(s, l, first + l, geometry)
        for l in range(n, BLOCK):  # noqa: E741
            gather_parameters(s, l, first, geometry)
        if len(cameras.lenses):
            lens, limits = lens_constants(cameras, view)
            for l in range(BLOCK):  # noqa: E741
                project_lane(s, l, R, t, f, limits, width, height, eps2d, antialiased, curved, lens)
        else:
            for l in range(BLOCK):  # noqa: E741
                project_lane(s, l, R, t, f, limits, width, height, eps2d, antialiased, straight, None)
        histogram[block, :] = 0
        invalid[block] = -1
        total = 0
        for l in range(n):  # noqa: E741
            i = first + l
            keys[i], depths[i], radii[i] = CULLED, 0, 0
            centers[i, 0], centers[i, 1] = 0, 0
            if s[BAD + l] != 0.0:
                invalid[block] = i
            if not s[DEPTH + l] > 0.0:
                continue
            x, y, hx, hy = s[CX + l], s[CY + l], s[HX + l], s[HY + l]
            # Pixel columns and rows whose centres lie within the ellipse's bounding box, clipped to the image.
            x0, x1 = ceil_int(max(x - hx - 0.5, 0.0)), floor_int(min(x + hx + 0.5, float(width)))
            y0, y1 = ceil_int(max(y - hy - 0.5, 0.0)), floor_int(min(y + hy + 0.5, float(height)))
            if x1 <= x0 or y1 <= y0:
                continue
            depths[i] = s[DEPTH + l]
            keys[i] = np.uint32(float_bits(depths[i]))
            centers[i, 0], centers[i, 1], radii[i] = x, y, max(hx, hy)
            r = records[i]
            r[0], r[1], r[2], r[3] = x, y, s[SLOPE + l], hx
            r[4], r[5], r[6], r[7] = s[XTOP + l], s[XIS + l], s[ETAS + l], s[RATIO + l]
            tx0, tx1 = x0 // TILE_WIDTH, (x1 - 1) // TILE_WIDTH + 1
            ty0, ty1 = y0 // TILE_HEIGHT, (y1 - 1) // TILE_HEIGHT + 1
            tiles[i, 0], tiles[i, 1], tiles[i, 2], tiles[i, 3] = tx0, tx1, ty0, ty1
            total += (tx1 - tx0) * (ty1 - ty0)
            for ty in range(ty0, ty1):
                for tx in range(tx0, tx1):
                    histogram[block, 1 + ty * across + tx] += 1
        histogram[block, 0] = total


@helper
def project_lane(
    s: np.ndarray, l: int, R: Any, t: Any, f: Any, limits: Any, width: int, height: int, eps2d: float,  # noqa: E741
    antialiased: bool, through: Any, lens: Any,
) -> None:  # fmt: skip
    """Project one lane `through` a lens; DEPTH becomes -1 where the Gaussian is invisible."""
    mx, my, mz, o = s[MX + l], s[MY + l], s[MZ + l], s[OP + l]
    qw, qx, qy, qz = s[QW + l], s[QX + l], s[QY + l], s[QZ + l]
    sx, sy, sz = s[SX + l], s[SY + l], s[SZ + l]
    everything = mx + my + mz + qw + qx + qy + qz + sx + sy + sz + o
    s[BAD + l] = 0.0 if everything - everything == 0.0 else 1.0
    x, y = R[0] * mx + R[1] * my + R[2] * mz + t[0], R[3] * mx + R[4] * my + R[5] * mz + t[1]
    z = R[6] * mx + R[7] * my + R[8] * mz + t[2]
    inverse_z = 1.0 / max(z, NEAR)
    u, v = x * inverse_z, y * inverse_z
    q = rotation(qw, qx, qy, qz)
    a = (q[0] * sx, q[1] * sy, q[2] * sz, q[3] * sx, q[4] * sy, q[5] * sz, q[6] * sx, q[7] * sy, q[8] * sz)
    _, _, b0, b1 = half_covariance(R, jacobian(f, limits, u, v, inverse_z), a)
    u, v, shown, b0, b1 = through(lens, f, limits, u, v, b0, b1)
    g = cross(b0, b1)
    det_sharp = dot(g, g)  # = |B B^T| by Cauchy-Binet; xx yy - xy^2 would cancel for needles
    xx, xy, yy = dot(b0, b0), dot(b0, b1), dot(b1, b1)
    det = det_sharp + eps2d * (xx + yy) + eps2d * eps2d
    xx, yy = xx + eps2d, yy + eps2d
    o = o * math.sqrt(det_sharp / det) if antialiased else o
    reach = max(log2(255.0 * max(o, ALPHA_MIN)), 0.0)  # xi^2 + eta^2 where alpha = 1/255
    half_width, half_height = math.sqrt(reach / HALF_LOG2E * xx), math.sqrt(reach / HALF_LOG2E * yy)
    cx, cy = f[0] * u + f[2], f[1] * v + f[3]
    across = (cx + half_width >= 0.5) & (cx - half_width <= width - 0.5)
    down = (cy + half_height >= 0.5) & (cy - half_height <= height - 0.5)
    visible = (o >= ALPHA_MIN) & (det > 0.0) & (det < math.inf) & (qw * qw + qx * qx + qy * qy + qz * qz > 0.0)
    s[DEPTH + l] = z if (z >= NEAR) & shown & visible & across & down else -1.0
    s[CX + l], s[CY + l], s[SLOPE + l] = cx, cy, xy / xx
    s[HX + l], s[HY + l], s[XTOP + l] = half_width, half_height, xy / yy * half_height
    s[XIS + l], s[ETAS + l] = math.sqrt(HALF_LOG2E / xx), math.sqrt(HALF_LOG2E * xx / det)
    s[RATIO + l] = math.sqrt(det) / xx
