"""The inner loops of the HexPlane lookup in vector code: one point, all features of one level, eight at a time.

At a point the planes xy, xz, yz have bilinear values P_m, and the three time planes, of one time, linear ones L_a. The
feature is P_0 P_1 P_2 L_0 L_1 L_2. With the gradient g of it, a plane's own is g times the other five factors, a corner
of its cell gets that times the corner's weight, and the point gets it times the slope of the plane's value.

numba leaves the plain loop scalar, as any of 18 rows that are written may be one of 18 that are read: 370 ns a point of
16 features, against 60. Sums over features have one order on every processor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from spike4dgs.method.splat.kernels.vector_ir import F32, I32, Lanes, array_data, int64, offset

AXES = ((0, 1), (0, 2), (1, 2))  # of the planes
WIDTH = 8  # features in a vector; what is left over goes one by one

_Body = Callable[[Lanes, Any], None]


@dataclass(frozen=True)
class _Cell:
    """A point's cell along one axis: index of its lower node, and a pair of weights as vectors."""

    index: Any
    lower: Any
    upper: Any


class _Level:
    """One level's planes [3, R, R, F] and lines [3, R, F], or their gradients, as pointers."""

    def __init__(self, builder: Any, space: Any, lines: Any, size: Any, features: Any) -> None:
        self.b, self.space, self.lines, self.size, self.features = builder, space, lines, size, features

    def corners(self, plane: int, first: Any, second: Any, f: Any) -> list[Any]:
        """Return pointers to feature f at a cell's four corners: (0, 0), (0, 1), (1, 0), (1, 1)."""
        b, found = self.b, []
        for row in (first, b.add(first, int64(1))):
            line = b.mul(b.add(b.mul(int64(plane), self.size), row), self.size)
            at = b.add(b.mul(b.add(line, second), self.features), f)
            found += [offset(b, self.space, at), offset(b, self.space, b.add(at, self.features))]
        return found

    def ends(self, axis: int, index: Any, f: Any) -> list[Any]:
        """Return pointers to feature f at both ends of an axis's cell."""
        b = self.b
        at = b.add(b.mul(b.add(b.mul(int64(axis), self.size), index), self.features), f)
        return [offset(b, self.lines, at), offset(b, self.lines, b.add(at, self.features))]


def _each_feature(builder: Any, features: Any, body: _Body) -> None:
    """Emit `body(lanes, f)` for all features: whole vectors first, then single ones."""
    whole = builder.and_(features, int64(-WIDTH))
    for lanes, start, stop in ((Lanes(builder, WIDTH), int64(0), whole), (Lanes(builder, 1), whole, features)):
        with cgutils.for_range_slice(builder, start, stop, int64(lanes.count)) as (f, _):
            body(lanes, f)


def _cells(v: Lanes, at: Any) -> list[_Cell]:
    indices, weights = (cgutils.unpack_tuple(v.b, part, 3) for part in cgutils.unpack_tuple(v.b, at, 2))
    one = v.const(1)
    return [_Cell(i, v.sub(one, v.splat(w)), v.splat(w)) for i, w in zip(indices, weights, strict=True)]


def _mix(v: Lanes, cell: _Cell, low: Any, high: Any) -> Any:
    return v.add(v.mul(cell.lower, low), v.mul(cell.upper, high))


class _Values:
    """The six factors at a point, and their slopes along the cell's axes."""

    def __init__(self, v: Lanes, level: _Level, cells: list[_Cell], f: Any) -> None:
        self.planes, self.plane_slopes, self.lines, self.line_slopes = [], [], [], []
        for m, (a, b) in enumerate(AXES):
            c = [v.load(p) for p in level.corners(m, cells[a].index, cells[b].index, f)]
            low, high = _mix(v, cells[b], c[0], c[1]), _mix(v, cells[b], c[2], c[3])
            self.planes.append(_mix(v, cells[a], low, high))
            along = _mix(v, cells[a], v.sub(c[1], c[0]), v.sub(c[3], c[2]))
            self.plane_slopes.append((v.sub(high, low), along))
        for a, cell in enumerate(cells):
            low, high = (v.load(p) for p in level.ends(a, cell.index, f))
            self.lines.append(_mix(v, cell, low, high))
            self.line_slopes.append(v.sub(high, low))


def _others(v: Lanes, x: list[Any]) -> list[Any]:
    return [v.mul(x[1], x[2]), v.mul(x[0], x[2]), v.mul(x[0], x[1])]


def _product(v: Lanes, x: list[Any]) -> Any:
    return v.mul(v.mul(x[0], x[1]), x[2])


def _add_to(v: Lanes, pointer: Any, value: Any, weight: Any) -> None:
    v.store(v.fma(value, weight, v.load(pointer)), pointer)


def _total(v: Lanes, x: Any) -> Any:
    """Return the sum of a vector's lanes, by halves."""
    while (half := x.type.count // 2) > 0:
        low, high = (v.shuffle(x, x, list(range(start, start + half))) for start in (0, half))
        x = v.add(low, high)
    return v.b.extract_element(x, ir.Constant(I32, 0))


def _gradient_of(b: Any, level: _Level, to: _Level, grad: Any, at: Any) -> list[Any]:
    """Emit the gradients of one point; return its own, per cell, along x, y and z."""
    sums = [cgutils.alloca_once_value(b, ir.Constant(F32, 0.0)) for _ in range(3)]

    def body(v: Lanes, f: Any) -> None:
        cells, g = _cells(v, at), v.load(offset(b, grad, f))
        values = _Values(v, level, cells, f)
        slopes: list[list[Any]] = [[], [], []]
        of_planes = v.mul(g, _product(v, values.lines))
        for m, ((i, j), others) in enumerate(zip(AXES, _others(v, values.planes), strict=True)):
            own = v.mul(of_planes, others)
            first, second = cells[i], cells[j]
            corners = to.corners(m, first.index, second.index, f)
            both = [v.mul(own, first.lower), v.mul(own, first.upper)]
            for n, pointer in enumerate(corners):
                _add_to(v, pointer, both[n // 2], second.upper if n % 2 else second.lower)
            slopes[i].append(v.mul(own, values.plane_slopes[m][0]))
            slopes[j].append(v.mul(own, values.plane_slopes[m][1]))
        of_lines = v.mul(g, _product(v, values.planes))
        for a, (cell, others) in enumerate(zip(cells, _others(v, values.lines), strict=True)):
            own = v.mul(of_lines, others)
            low, high = to.ends(a, cell.index, f)
            _add_to(v, low, own, cell.lower)
            _add_to(v, high, own, cell.upper)
            slopes[a].append(v.mul(own, values.line_slopes[a]))
        for total, (x, y, z) in zip(sums, slopes, strict=True):
            b.store(b.fadd(b.load(total), _total(v, v.add(v.add(x, y), z))), total)

    _each_feature(b, level.features, body)
    return [b.load(total) for total in sums]


_INTEGERS, _FLOATS = types.UniTuple(types.int64, 3), types.UniTuple(types.float32, 3)


def _look_up(
    typing_context: Any, space: Any, lines: Any, size: Any, features: Any, at: Any, out: Any, first: Any
) -> Any:
    """Set F features from element `first` of `out` on.

    `at` is ((i, j, k), (wi, wj, wk)), by axis the lower node of the point's cell and the weight of the upper one.
    """
    signature = types.void(space, lines, types.int64, types.int64, types.Tuple([_INTEGERS, _FLOATS]), out, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        planes, axes = (array_data(context, builder, t, a) for t, a in zip(sig.args[:2], args[:2], strict=True))
        level = _Level(builder, planes, axes, *args[2:4])
        row = offset(builder, array_data(context, builder, sig.args[5], args[5]), args[6])

        def body(v: Lanes, f: Any) -> None:
            values = _Values(v, level, _cells(v, args[4]), f)
            v.store(v.mul(_product(v, values.planes), _product(v, values.lines)), offset(builder, row, f))

        _each_feature(builder, args[3], body)
        return context.get_dummy_value()

    return signature, generate


def _add_gradients(
    typing_context: Any, space: Any, lines: Any, size: Any, features: Any, at: Any, grad: Any, first: Any,
    to_space: Any, to_lines: Any,
) -> Any:  # fmt: skip
    """Add what F gradients, from element `first` of `grad` on, give to planes and lines.

    Return the point's own gradient, per cell of each axis. All but `grad` are C-contiguous.
    """
    place = types.Tuple([_INTEGERS, _FLOATS])
    signature = _FLOATS(space, lines, types.int64, types.int64, place, grad, types.int64, to_space, to_lines)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = [array_data(context, builder, sig.args[x], args[x]) for x in (0, 1, 7, 8)]
        level, to = (_Level(builder, *pair, *args[2:4]) for pair in (data[:2], data[2:]))
        row = offset(builder, array_data(context, builder, sig.args[5], args[5]), args[6])
        own = _gradient_of(builder, level, to, row, args[4])
        return context.make_tuple(builder, sig.return_type, own)

    return signature, generate


look_up: Any = intrinsic(_look_up)
add_gradients: Any = intrinsic(_add_gradients)
