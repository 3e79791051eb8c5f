"""The inner loop of `sensor.model`: 64 pixels of a tick become one word.

numba vectorises the loops over 64 pixels; only the collection of their sign bits is vector code written by hand.
Shot noise has loops of its own, so that it costs nothing when it is off.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from spike4dgs.benchmark.spikes.bits import kernel
from spike4dgs.benchmark.spikes.sensor_model import THRESHOLD

BLOCK = 64  # pixels whose spikes make one word
STRIP = 16  # blocks that go through all intervals of a batch before the next strip: 128 bytes of a row, two cache lines


@intrinsic
def _sign_bits(typing_context: Any, values: Any) -> Any:
    """Return the sign bits of an int32 array's first 64 entries as one uint64, entry 0 in the lowest bit.

    Written as vector IR because no compiler finds this from a loop; it becomes a few mask instructions.
    """

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        vector = ir.VectorType(ir.IntType(32), BLOCK)
        data = context.make_array(signature.args[0])(context, builder, args[0]).data
        loaded = builder.load(builder.bitcast(data, vector.as_pointer()), align=4)
        return builder.bitcast(builder.icmp_signed("<", loaded, ir.Constant(vector, None)), ir.IntType(64))

    return types.uint64(values), codegen


@kernel
def integrate(
    window: Any,
    ticks: Any,
    tangents: Any,
    radiance_gain: Any,
    gain: Any,
    dark: Any,
    charge: Any,
    unit: Any,
    noise: Any,
    key: Any,
    means: Any,
    words: Any,
    first_block: Any,
    last_block: Any,
) -> None:
    """Fill words[:, first_block:last_block] and advance `charge`: strips outer, intervals, blocks, ticks inner.

    window [S + 3, P], ticks [S + 1], tangents [S, 2], gain and dark [P] or [64], charge [P], words [T, P / 64].
    `unit`: charge units of one threshold, 2^31 without noise; `noise`: charge units of one step of `deviate`, 0 is off;
    `key`: of its random numbers; `means`: keys are means of their interval and are used as they are.
    """
    c = np.empty(BLOCK, np.int32)
    w = np.empty(6 * BLOCK, np.float32)
    increment = np.empty(BLOCK, np.int32)
    pixel = np.empty(BLOCK, np.uint32)
    for strip in range(first_block, last_block, STRIP):
        for s in range(len(ticks) - 1):
            n = ticks[s + 1] - ticks[s]
            start = ticks[s] - ticks[0]
            stop = min(start + n, len(words))
            for block in range(strip, min(strip + STRIP, last_block)):
                p = block * BLOCK
                k0, k1 = window[s][p : p + BLOCK], window[s + 1][p : p + BLOCK]
                k2, k3 = window[s + 2][p : p + BLOCK], window[s + 3][p : p + BLOCK]
                g = gain[p : p + BLOCK] if len(gain) > BLOCK else gain
                d = dark[p : p + BLOCK] if len(dark) > BLOCK else dark
                for i in range(BLOCK):  # an assignment of arrays compiles for as long as all the rest
                    c[i] = charge[p + i]
                out = words[start:stop, block]
                constant = means or _equal(k0, k1, k2, k3)
                if constant:
                    _steady(k1, g, d, radiance_gain, unit, increment)
                else:
                    weights = tangents[s, 0], tangents[s, 1]
                    _prepare(k0, k1, k2, k3, weights, g, d, np.float32(radiance_gain), np.float32(unit), n, w)
                if noise != 0:
                    for i in range(BLOCK):
                        pixel[i] = np.uint32((p + i) * 0x9E3779B1)
                    _noisy(constant, increment, w, n, c, pixel, ticks[s], key, np.int32(unit), noise, out)
                elif constant:
                    _constant(increment, c, out)
                else:
                    _changing(w, n, c, out)
                for i in range(BLOCK):
                    charge[p + i] = c[i]


@kernel
def _equal(k0: Any, k1: Any, k2: Any, k3: Any) -> bool:
    """Return whether the four keys [64] are equal."""
    different = np.uint32(0)
    for i in range(BLOCK):
        different += np.uint32((k0[i] != k1[i]) | (k1[i] != k2[i]) | (k2[i] != k3[i]))
    return different == 0


@kernel
def _steady(k: Any, g: Any, d: Any, radiance_gain: Any, unit: Any, increment: Any) -> None:
    """Write the increments [64] of pixels whose radiance does not change."""
    top = np.float64(THRESHOLD - 1)
    for i in range(BLOCK):
        x = (np.float64(g[i]) * radiance_gain * np.float64(k[i]) + np.float64(d[i])) * unit
        x = 0.0 if x < 0.0 else x
        increment[i] = np.int32(top if x > top else x)


@kernel
def _constant(increment: Any, c: Any, words: Any) -> None:
    """Write the ticks of 64 pixels whose radiance does not change: one integer addition each."""
    for j in range(len(words)):
        for i in range(BLOCK):
            c[i] = (c[i] & np.int32(0x7FFFFFFF)) + increment[i]
        words[j] = _sign_bits(c)  # type: ignore[call-arg]
    for i in range(BLOCK):
        c[i] &= np.int32(0x7FFFFFFF)


@kernel
def _prepare(
    k0: Any, k1: Any, k2: Any, k3: Any, weights: Any, g: Any, d: Any, radiance_gain: Any, one: Any, n: Any, w: Any
) -> None:
    """Write polynomial in u (rows 0..3 of `w` [6 * 64]) and limits (rows 4, 5) of the increment, in charge units."""
    zero, top = np.float32(0.0), np.float32(THRESHOLD - 128)  # the largest float32 below
    width2, width3 = np.float32(1.0 / (12.0 * n * n)), np.float32(1.0 / (4.0 * n * n))
    for i in range(BLOCK):
        scale = g[i] * radiance_gain * one
        d2 = k2[i] - k1[i]
        m1 = weights[0] * (k2[i] - k0[i])
        m2 = weights[1] * (k3[i] - k1[i])
        a2 = scale * (np.float32(3.0) * d2 - np.float32(2.0) * m1 - m2)
        a3 = scale * (m1 + m2 - np.float32(2.0) * d2)
        level = scale * k1[i] + d[i] * one
        level2 = scale * k2[i] + d[i] * one
        w[i] = level + a2 * width2
        w[BLOCK + i] = scale * m1 + a3 * width3
        w[2 * BLOCK + i] = a2
        w[3 * BLOCK + i] = a3
        low = level if level < level2 else level2
        high = level2 if level < level2 else level
        low = low if low < top else top
        w[4 * BLOCK + i] = low if low > zero else zero
        high = high if high < top else top
        w[5 * BLOCK + i] = high if high > zero else zero


@kernel
def _changing(w: Any, n: Any, c: Any, words: Any) -> None:
    """Write the ticks of 64 pixels along the polynomials that `_prepare` left in `w`."""
    for j in range(len(words)):
        u = (np.float32(j) + np.float32(0.5)) / np.float32(n)
        for i in range(BLOCK):
            c[i] = (c[i] & np.int32(0x7FFFFFFF)) + np.int32(_along(w, i, u))
        words[j] = _sign_bits(c)  # type: ignore[call-arg]
    for i in range(BLOCK):
        c[i] &= np.int32(0x7FFFFFFF)


@kernel
def _along(w: Any, i: Any, u: Any) -> Any:
    """Return the increment of pixel i at u."""
    cubic = w[2 * BLOCK + i] + u * w[3 * BLOCK + i]
    x = w[i] + u * (w[BLOCK + i] + u * cubic)
    low, high = w[4 * BLOCK + i], w[5 * BLOCK + i]
    x = low if x < low else x
    return high if x > high else x


# ---------------------------------------------------------------- shot noise


@kernel
def mix(x: Any) -> Any:
    """Return 32 well mixed bits of 32 bits, one to one (multiplications and shifts of Ellis' lowbias32)."""
    x = np.uint32(x ^ (x >> np.uint32(16)))
    x = np.uint32(x * np.uint32(0x7FEB352D))
    x = np.uint32(x ^ (x >> np.uint32(15)))
    x = np.uint32(x * np.uint32(0x846CA68B))
    return np.uint32(x ^ (x >> np.uint32(16)))


@kernel
def deviate(pixel: Any, tick: Any) -> Any:
    """Return a nearly Gaussian integer in -510 .. 510, variance 21845: the sum of four random bytes, less its mean.

    It is a function of the hashes of pixel and tick alone.
    """
    x = mix(np.uint32(pixel ^ tick))
    pairs = np.uint32((x & np.uint32(0x00FF00FF)) + ((x >> np.uint32(8)) & np.uint32(0x00FF00FF)))
    return np.int32((pairs & np.uint32(0xFFFF)) + (pairs >> np.uint32(16))) - np.int32(510)


@kernel
def _noisy(
    constant: Any,
    increment: Any,
    w: Any,
    n: Any,
    c: Any,
    pixel: Any,
    tick: Any,
    key: Any,
    one: Any,
    noise: Any,
    words: Any,
) -> None:
    """Write the ticks of 64 pixels where every spike takes a slightly different charge; see `sensor.model`."""
    for j in range(len(words)):
        u = (np.float32(j) + np.float32(0.5)) / np.float32(n)
        for i in range(BLOCK):
            c[i] = c[i] + (increment[i] if constant else np.int32(_along(w, i, u)))
        words[j] = _sign_bits(c)  # type: ignore[call-arg]
        if words[j] == 0:
            continue
        now = mix(np.uint32(np.uint32(tick + j) ^ key))
        for i in range(BLOCK):
            spent = one + noise * deviate(pixel[i], now)
            left = np.int32(c[i] - (spent if c[i] < 0 else np.int32(0)))
            c[i] = left if left >= 0 else np.int32(0x7FFFFFFF)  # a full well
