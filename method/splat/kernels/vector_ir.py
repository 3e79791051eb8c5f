"""Explicit vector code for numba: a small builder of LLVM float vectors, and the intrinsics every kernel needs.

numba vectorises short loops badly (6.6 ns a lane here against 0.3), so the inner loops are written as LLVM vectors.
A vector of 16 floats is one AVX-512 register; 8 floats are one AVX2 register, or two of SSE or NEON: LLVM splits it.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import llvmlite.binding
from llvmlite import ir
from numba import types
from numba.core import config as numba_config
from numba.extending import intrinsic

config: Any = numba_config  # its names are made from environment variables
F32, F64, I32, I64 = ir.FloatType(), ir.DoubleType(), ir.IntType(32), ir.IntType(64)
FAST = ("contract", "nsz")  # a * b + c may become one instruction; NaN and infinity keep their meaning
BLOCK_WIDTH = 8  # pixels; a vector covers a block of 8 x (lanes / 8) pixels
EXP2_POLYNOMIAL = (  # minimax on [-0.5, 0.5], relative error 2.4e-7
    1.0,
    0.6931469670549255,
    0.240221197248715,
    0.0555071328955985,
    0.009675541293018638,
    0.00132764668001264,
)


@cache
def host_lanes() -> int:
    """Return the vector length that suits the processor that numba compiles for: 16 floats with AVX-512, else 8.

    That is this machine's, unless numba's own variables NUMBA_CPU_NAME or NUMBA_CPU_FEATURES name another.
    """
    if config.CPU_FEATURES is not None:
        return 16 if "+avx512f" in config.CPU_FEATURES.split(",") else 8
    return 16 if llvmlite.binding.get_host_cpu_features().get("avx512f") else 8


def int64(value: int) -> ir.Constant:
    """Return an integer constant for address arithmetic."""
    return ir.Constant(I64, value)


def offset(builder: Any, pointer: Any, index: Any) -> Any:
    """Return `pointer + index`, in elements."""
    return builder.gep(pointer, [index])


def array_data(context: Any, builder: Any, array_type: Any, value: Any) -> Any:
    """Return the pointer to the first element of a numba array argument."""
    return context.make_array(array_type)(context, builder, value).data


class Lanes:
    """float32 vectors of one length, built at the position of an LLVM builder."""

    def __init__(self, builder: Any, count: int) -> None:
        self.b, self.count = builder, count
        self.type, self.int_type = ir.VectorType(F32, count), ir.VectorType(I32, count)

    def const(self, x: float) -> Any:
        """Return the same number in every lane."""
        return self.of([x] * self.count)

    def of(self, values: list[float]) -> Any:
        """Return one constant per lane."""
        return ir.Constant(self.type, [ir.Constant(F32, float(v)) for v in values])

    def int_const(self, x: int) -> Any:
        """Return the same integer in every lane."""
        return ir.Constant(self.int_type, [ir.Constant(I32, x)] * self.count)

    def splat(self, x: Any) -> Any:
        """Return a scalar, float or double, copied into every lane."""
        if x.type == F64:
            x = self.b.fptrunc(x, F32)
        element, vector = (F32, self.type) if x.type == F32 else (I32, self.int_type)
        undefined = ir.Constant(ir.VectorType(element, self.count), ir.Undefined)
        one = self.b.insert_element(undefined, x, ir.Constant(I32, 0))
        return self.b.shuffle_vector(one, undefined, ir.Constant(self.int_type, [ir.Constant(I32, 0)] * self.count))

    def shuffle(self, x: Any, y: Any, index: list[int]) -> Any:
        """Return lanes picked from the concatenation of x and y."""
        mask = ir.Constant(ir.VectorType(I32, len(index)), [ir.Constant(I32, i) for i in index])
        return self.b.shuffle_vector(x, y, mask)

    def load(self, pointer: Any) -> Any:
        """Return `count` floats from a pointer of any alignment."""
        return self.b.load(self.b.bitcast(pointer, self.type.as_pointer()), align=4)

    def store(self, value: Any, pointer: Any) -> None:
        """Write floats or integers to a pointer of any alignment."""
        self.b.store(value, self.b.bitcast(pointer, value.type.as_pointer()), align=4)

    def mul(self, x: Any, y: Any) -> Any:
        """Return x * y."""
        return self.b.fmul(x, y, flags=FAST)

    def add(self, x: Any, y: Any) -> Any:
        """Return x + y."""
        return self.b.fadd(x, y, flags=FAST)

    def sub(self, x: Any, y: Any) -> Any:
        """Return x - y."""
        return self.b.fsub(x, y, flags=FAST)

    def div(self, x: Any, y: Any) -> Any:
        """Return x / y, by way of the reciprocal where that is faster."""
        return self.b.fdiv(x, y, flags=(*FAST, "arcp"))

    def fma(self, x: Any, y: Any, z: Any) -> Any:
        """Return x * y + z, fused where the machine can."""
        return self.add(self.mul(x, y), z)

    def max(self, x: Any, y: Any) -> Any:
        """Return the larger of the two."""
        return self.b.select(self.b.fcmp_ordered(">", x, y), x, y)

    def min(self, x: Any, y: Any) -> Any:
        """Return the smaller of the two."""
        return self.b.select(self.b.fcmp_ordered("<", x, y), x, y)

    def minus_abs(self, x: Any) -> Any:
        """Return -|x|: sets the sign bit."""
        return self.b.bitcast(self.b.or_(self.b.bitcast(x, self.int_type), self.int_const(-(2**31))), self.type)

    def exp2(self, x: Any, polynomial: tuple[float, ...] = EXP2_POLYNOMIAL) -> Any:
        """Return 2**x for x <= 127; below -125 the result stays at 2**-125. `polynomial`: coefficients, lowest first.

        Adding 1.5 * 2**23 leaves round(x) in the low bits; shifted by 23 they are added to the exponent of the
        polynomial in the remainder.
        """
        x = self.max(x, self.const(-125.0))
        magic = self.const(12582912.0)
        rounded = self.b.fadd(x, magic)
        rest = self.b.fsub(x, self.b.fsub(rounded, magic))
        value = self.const(polynomial[-1])
        for c in reversed(polynomial[:-1]):
            value = self.fma(value, rest, self.const(c))
        exponent = self.b.shl(self.b.bitcast(rounded, self.int_type), self.int_const(23))
        return self.b.bitcast(self.b.add(exponent, self.b.bitcast(value, self.int_type)), self.type)


@intrinsic  # type: ignore[untyped-decorator]
def fetch_add(typing_context: Any, array: Any, index: Any, value: Any) -> Any:
    """Do `array[index] += value` atomically on int64 and return the old value."""
    signature = types.int64(array, types.int64, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = offset(builder, array_data(context, builder, sig.args[0], args[0]), args[1])
        return builder.atomic_rmw("add", pointer, args[2], "acq_rel")

    return signature, generate


@intrinsic  # type: ignore[untyped-decorator]
def prefetch(typing_context: Any, array: Any, index: Any) -> Any:
    """Prefetch the cache line of `array[index]`; harmless for any index."""
    signature = types.void(array, types.int64)

    def generate(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        pointer = offset(builder, array_data(context, builder, sig.args[0], args[0]), args[1])
        byte_pointer = ir.IntType(8).as_pointer()
        shape = ir.FunctionType(ir.VoidType(), [byte_pointer, I32, I32, I32])
        name = "llvm.prefetch.p0"
        function = builder.module.globals.get(name) or ir.Function(builder.module, shape, name)
        read, keep, data = (ir.Constant(I32, v) for v in (0, 3, 1))
        builder.call(function, [builder.bitcast(pointer, byte_pointer), read, keep, data])
        return context.get_dummy_value()

    return signature, generate


def _bitcast(source: Any, target: Any, llvm_type: Any) -> Any:
    @intrinsic  # type: ignore[untyped-decorator]
    def cast(typing_context: Any, x: Any) -> Any:
        return target(source), lambda context, builder, sig, args: builder.bitcast(args[0], llvm_type)

    return cast


float_bits = _bitcast(types.float32, types.int32, I32)  # float32 -> its bits as int32
double_bits = _bitcast(types.float64, types.int64, I64)  # float64 -> its bits as int64
bits_double = _bitcast(types.int64, types.float64, F64)  # int64 bits -> float64
