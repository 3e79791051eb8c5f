"""The inner loops of the rasteriser in vector code: composite one Gaussian into the blocks it meets, and the reverse.

A tile's pixels lie in planes of floats; block rows are interleaved so that one block is one contiguous vector. Plane 0
is T, whose sign bit marks a finished pixel. Behind it come the colours (forward), or R, the colour gradients and the
alpha gradient (backward), where R is what the Gaussians not yet visited contribute to sum_f dL/dC_f C_f + dL/dA A.

A Gaussian's record (8 float64): centre x, y; slope of its ridge line y = y0 + slope (x - x0); half width hx; offset
of its topmost point; xi and eta scales; ratio. In the whitened coordinates xi = xi_scale dx and
eta = eta_scale (dy - slope dx), log2(alpha) = L - xi^2 - eta^2: two multiply-adds a lane, and no cancellation however
thin the Gaussian is. L = log2(opacity) = (hx xi_scale)^2 - log2(255), since the half width is where alpha = 1/255.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from spike4dgs.method.splat.kernels.vector_ir import (
    BLOCK_WIDTH,
    I64,
    Lanes,
    array_data,
    int64,
    offset,
)
from spike4dgs.method.splat.types import ALPHA_MAX, ALPHA_MIN, T_MIN

TILE_WIDTH, TILE_HEIGHT = 64, 32  # pixels; large, because a Gaussian visits only the blocks of its own ellipse
ROW_WIDTH = TILE_WIDTH + BLOCK_WIDTH  # blocks start at any column and may overhang the tile
PLANE = TILE_HEIGHT * ROW_WIDTH  # floats
LOG2_255 = math.log2(255.0)
MOMENTS = 6  # sums of s, s xi, s eta, s xi^2, s xi eta, s eta^2, where s = dL/d ln(alpha)

Generated = tuple[Any, Any]


@dataclass(frozen=True)
class Variant:
    """The properties of one compiled kernel, packed in an integer that numba sees as a literal type.

    The digest of the kernel sources rides along, because numba's cache key knows only the text of one file.
    """

    lanes: int
    channels: int
    digest: int = 0

    def pack(self) -> int:
        """Return the integer code."""
        return self.lanes + 256 * self.channels + 65536 * self.digest

    @classmethod
    def unpack(cls, code: int) -> Variant:
        """Return the variant of an integer code."""
        return cls(code % 256, code // 256 % 256, code // 65536)

    @property
    def block_rows(self) -> int:
        """Pixel rows of a block."""
        return self.lanes // BLOCK_WIDTH


class BlockLoop:
    """`for i in range(begin, end)` over a Gaussian's blocks, with everything that does not change hoisted out."""

    def __init__(self, builder: Any, variant: Variant, pointers: dict[str, Any], gaussian: Any) -> None:
        self.b, self.v, self.p, rows = builder, Lanes(builder, variant.lanes), pointers, variant.block_rows
        v, channels = self.v, variant.channels
        record = offset(builder, pointers["records"], builder.mul(gaussian, int64(8)))
        slope, half_width, xi_scale, eta_scale = (builder.load(offset(builder, record, int64(i))) for i in (2, 3, 5, 6))
        reach = builder.fmul(half_width, xi_scale)
        log_opacity = builder.fsub(builder.fmul(reach, reach), ir.Constant(reach.type, LOG2_255))
        columns, lines = v.of([i // rows for i in range(v.count)]), v.of([i % rows for i in range(v.count)])
        self.xi_offsets = v.mul(v.splat(xi_scale), columns)
        self.eta_offsets = v.mul(v.splat(eta_scale), v.sub(lines, v.mul(v.splat(slope), columns)))
        self.log_opacity = v.splat(log_opacity)
        color = offset(builder, pointers["colors"], builder.mul(gaussian, int64(channels)))
        self.color = [v.splat(builder.load(offset(builder, color, int64(f)))) for f in range(channels)]

    def open(self, begin: Any, end: Any, totals: int) -> list[Any]:
        """Start the loop and return `totals` vectors that are carried from turn to turn, zero at first."""
        self.end, self.entry = end, self.b.block
        self.body, self.done = (self.b.append_basic_block(name) for name in ("blocks", "blocks_done"))
        self.b.cbranch(self.b.icmp_signed("<", begin, end), self.body, self.done)
        self.b.position_at_end(self.body)
        self.i = self.b.phi(I64)
        self.i.add_incoming(begin, self.entry)
        self.totals = [self.b.phi(self.v.type) for _ in range(totals)]
        for total in self.totals:
            total.add_incoming(self.v.const(0), self.entry)
        return self.totals

    def close(self, new_totals: list[Any]) -> list[Any]:
        """End the loop and return the totals after the last turn."""
        following = self.b.add(self.i, int64(1))
        for phi, value in zip([self.i, *self.totals], [following, *new_totals], strict=True):
            phi.add_incoming(value, self.body)
        self.b.cbranch(self.b.icmp_signed("<", following, self.end), self.body, self.done)
        self.b.position_at_end(self.done)
        finals = []
        for value in new_totals:
            final = self.b.phi(self.v.type)
            final.add_incoming(self.v.const(0), self.entry)
            final.add_incoming(value, self.body)
            finals.append(final)
        return finals

    def block(self) -> tuple[Any, Any, Any, Any]:
        """Return the current block: address of its first pixel, xi, eta, and the unclamped alpha."""
        b, v = self.b, self.v
        start, xi, eta = (b.load(offset(b, self.p[name], self.i)) for name in ("starts", "xis", "etas"))
        xi, eta = v.add(v.splat(xi), self.xi_offsets), v.add(v.splat(eta), self.eta_offsets)
        exponent = v.sub(v.sub(self.log_opacity, v.mul(xi, xi)), v.mul(eta, eta))
        return offset(b, self.p["tile"], b.sext(start, I64)), xi, eta, v.exp2(exponent)

    def blend(self, raw: Any, T: Any) -> tuple[Any, Any, Any, Any, Any]:
        """Return alpha, T of unfinished pixels, weight, T to store, and the pixels that composite the Gaussian."""
        b, v = self.b, self.v
        hit, alpha = b.fcmp_ordered(">=", raw, v.const(ALPHA_MIN)), v.min(raw, v.const(ALPHA_MAX))
        before = v.max(T, v.const(0))
        weight = b.select(hit, v.mul(before, alpha), v.const(0))
        after = v.sub(before, weight)
        live = b.fcmp_ordered(">", after, v.const(T_MIN))
        stored = b.select(live, after, v.minus_abs(T))
        return alpha, before, b.select(live, weight, v.const(0)), stored, b.and_(hit, live)

    def pass_on(self, pixel: Any, stored: Any, weight: Any) -> tuple[list[Any], Any, Any]:
        """Store T and R behind the Gaussian; return dL/dC_f, cg (see `differentiate_blocks`), and that R."""
        b, v = self.b, self.v
        v.store(stored, pixel)
        rest = offset(b, pixel, int64(PLANE))
        *grads, own = (v.load(offset(b, pixel, int64(PLANE * (2 + f)))) for f in range(len(self.color) + 1))
        for value, grad in zip(self.color, grads, strict=True):
            own = v.fma(value, grad, own)
        behind = v.sub(v.load(rest), v.mul(weight, own))
        v.store(behind, rest)
        return grads, own, behind


def pointers_of(context: Any, builder: Any, sig: Any, args: Any, names: str) -> dict[str, Any]:
    """Return the data pointers of the array arguments 1, 2, ... (argument 0 is the variant)."""
    return {n: array_data(context, builder, sig.args[i], args[i]) for i, n in enumerate(names.split(), start=1)}


def _over_blocks(turn: Callable[[BlockLoop], None]) -> Any:
    """Return the intrinsic that does a `turn` for each of the blocks [begin, end) of the list (starts, xis, etas)."""

    @intrinsic(prefer_literal=True)  # type: ignore[untyped-decorator]
    def blocks(
        typing_context: Any, variant: Any, tile: Any, records: Any, colors: Any, starts: Any, xis: Any, etas: Any,
        begin: Any, end: Any, gaussian: Any,
    ) -> Generated:  # fmt: skip
        integer = types.int64
        signature = types.void(variant, tile, records, colors, starts, xis, etas, integer, integer, integer)
        chosen = Variant.unpack(variant.literal_value)

        def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            pointers = pointers_of(context, builder, sig, args, "tile records colors starts xis etas")
            loop = BlockLoop(builder, chosen, pointers, args[9])
            loop.open(args[7], args[8], 0)
            turn(loop)
            loop.close([])
            return context.get_dummy_value()

        return signature, generate

    return blocks


def _composite(loop: BlockLoop) -> None:
    """Blend the Gaussian into the current block."""
    v = loop.v
    pixel, _, _, raw = loop.block()
    _, _, weight, stored, _ = loop.blend(raw, v.load(pixel))
    v.store(stored, pixel)
    for value in loop.color:
        pixel = offset(loop.b, pixel, int64(PLANE))
        v.store(v.fma(weight, value, v.load(pixel)), pixel)


def _replay(loop: BlockLoop) -> None:
    """Bring T and R behind a Gaussian that wants no gradients, as `differentiate_blocks` does."""
    pixel, _, _, raw = loop.block()
    _, _, weight, stored, _ = loop.blend(raw, loop.v.load(pixel))
    loop.pass_on(pixel, stored, weight)


composite_blocks, replay_blocks = _over_blocks(_composite), _over_blocks(_replay)


@intrinsic(prefer_literal=True)  # type: ignore[untyped-decorator]
def differentiate_blocks(
    typing_context: Any, variant: Any, tile: Any, records: Any, colors: Any, starts: Any, xis: Any, etas: Any,
    sums: Any, begin: Any, end: Any, gaussian: Any, row: Any,
) -> Generated:  # fmt: skip
    """Write the six moments of s = dL/d ln(alpha) and the colour gradients to sums[row:], front to back.

    With cg = sum_f dL/dC_f c_f + dL/dA, a Gaussian's own share of the loss is w cg, and everything behind it
    scales with 1 - alpha: dL/dalpha = T cg - R_behind / (1 - alpha). T and R are replayed, never divided back.
    """
    integer = types.int64
    signature = types.void(
        variant, tile, records, colors, starts, xis, etas, sums, integer, integer, integer, integer
    )  # fmt: skip
    chosen = Variant.unpack(variant.literal_value)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointers = pointers_of(context, builder, sig, args, "tile records colors starts xis etas sums")
        loop = BlockLoop(builder, chosen, pointers, args[10])
        v, b = loop.v, builder
        total = loop.open(args[8], args[9], MOMENTS + chosen.channels)
        pixel, xi, eta, raw = loop.block()
        alpha, before, weight, stored, composited = loop.blend(raw, v.load(pixel))
        grads, own, behind = loop.pass_on(pixel, stored, weight)
        dalpha = v.sub(v.mul(before, own), v.div(behind, v.sub(v.const(1.0), alpha)))
        moves = b.and_(composited, b.fcmp_ordered("<=", raw, v.const(ALPHA_MAX)))  # a clamped alpha does not
        s = b.select(moves, v.mul(dalpha, raw), v.const(0))
        s_xi, s_eta = v.mul(s, xi), v.mul(s, eta)
        new = [v.add(total[0], s), v.add(total[1], s_xi), v.add(total[2], s_eta)]
        new += [v.fma(s_xi, xi, total[3]), v.fma(s_xi, eta, total[4]), v.fma(s_eta, eta, total[5])]
        new += [v.fma(weight, grad, total[MOMENTS + f]) for f, grad in enumerate(grads)]
        final = loop.close(new)
        for first in range(0, len(final), 8):
            out = offset(b, pointers["sums"], b.add(args[11], int64(first)))
            Lanes(b, 8).store(_sum_across(v, final[first : first + 8]), out)
        return context.get_dummy_value()

    return signature, generate


def _sum_across(v: Lanes, vectors: list[Any]) -> Any:
    """Return the sums over the lanes of up to 8 vectors, as one vector of 8 floats, by a tree of shuffles."""
    half = Lanes(v.b, 8)
    if v.count == 16:
        low, high = list(range(8)), list(range(8, 16))
        vectors = [half.add(v.shuffle(x, x, low), v.shuffle(x, x, high)) for x in vectors]
    vectors = vectors + [half.const(0)] * (8 - len(vectors))

    def add_neighbours(x: Any, y: Any) -> Any:  # within 128-bit halves, where shuffles are cheap
        even, odd = [0, 2, 8, 10, 4, 6, 12, 14], [1, 3, 9, 11, 5, 7, 13, 15]
        return half.add(half.shuffle(x, y, even), half.shuffle(x, y, odd))

    pairs = [add_neighbours(vectors[i], vectors[i + 1]) for i in range(0, 8, 2)]
    first, second = add_neighbours(pairs[0], pairs[1]), add_neighbours(pairs[2], pairs[3])
    low = half.shuffle(first, second, [0, 1, 2, 3, 8, 9, 10, 11])
    return half.add(low, half.shuffle(first, second, [4, 5, 6, 7, 12, 13, 14, 15]))


@intrinsic(prefer_literal=True)  # type: ignore[untyped-decorator]
def any_unfinished(typing_context: Any, variant: Any, tile: Any, vectors: Any) -> Generated:
    """Return whether any of the first `vectors` vectors of T has a pixel that is not finished."""
    signature = types.boolean(variant, tile, types.int64)
    lanes = Variant.unpack(variant.literal_value).lanes

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        b, v, entry = builder, Lanes(builder, lanes), builder.block
        tile_pointer = array_data(context, b, sig.args[1], args[1])
        body, done = b.append_basic_block("scan"), b.append_basic_block("scan_done")
        b.branch(body)
        b.position_at_end(body)
        i, largest = b.phi(I64), b.phi(v.type)
        i.add_incoming(int64(0), entry)
        largest.add_incoming(v.const(-1), entry)
        larger = v.max(largest, v.load(offset(b, tile_pointer, b.mul(i, int64(lanes)))))
        following = b.add(i, int64(1))
        i.add_incoming(following, body)
        largest.add_incoming(larger, body)
        b.cbranch(b.icmp_signed("<", following, args[2]), body, done)
        b.position_at_end(done)
        bits = b.bitcast(b.fcmp_ordered(">", larger, v.const(0)), ir.IntType(lanes))
        return b.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(lanes), 0))

    return signature, generate
