"""Eight floats at a time inside numba kernels.

Numba leaves vectorising to LLVM, which gives up on the loops of a rasterizer or of stereo. Here the vectors are
values of the kernel: ``F8`` (eight float32) and ``M8`` (eight truth values). ``+ - * /`` and comparisons work
on them, with plain numbers too; what else is needed is a function below. Each is an LLVM vector instruction or
a few of them, and LLVM makes of them what the machine has: AVX2 registers, pairs of NEON registers. Nothing is
reordered or contracted, so that two kernels which write the same formula get the same bits.

Numba's cache does not notice a change of this file: remove ``__pycache__`` after editing it.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

LANES = 8

FLOAT, INT = ir.FloatType(), ir.IntType(32)
FLOATS, INTS = ir.VectorType(FLOAT, LANES), ir.VectorType(INT, LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)

# Makes a function of numba types, and of the LLVM code for them, a function that kernels can call.
operation: Any = intrinsic


class _Vector(types.Type):
    """Numba's name for one of the vector types."""


F8 = _Vector(name="float32x8")
M8 = _Vector(name="mask8")


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    """A vector is a value, kept in a register."""

    def __init__(self, manager: Any, kind: _Vector) -> None:
        super().__init__(manager, kind, FLOATS if kind == F8 else _BITS)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(FLOATS, [value] * LANES)


def _splat(builder: ir.IRBuilder, value: ir.Value) -> ir.Value:
    undefined = ir.Constant(FLOATS, ir.Undefined)
    single = builder.insert_element(undefined, value, ir.Constant(INT, 0))
    return builder.shuffle_vector(single, undefined, ir.Constant(INTS, [0] * LANES))


def _call(builder: ir.IRBuilder, name: str, *args: ir.Value) -> ir.Value:
    """Call the LLVM intrinsic of this name on vectors of floats."""
    kind = ir.FunctionType(FLOATS, [FLOATS] * len(args))
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32")
    return builder.call(function, args)


# --- operators ---------------------------------------------------------------------------------------------------


def _vector(context: Any, builder: ir.IRBuilder, value: ir.Value, kind: Any) -> ir.Value:
    """Return the operand as a vector: plain numbers go into every lane as float32."""
    if isinstance(kind, _Vector):
        return value
    return _splat(builder, context.cast(builder, value, kind, types.float32))


def _operator(operation: Callable[..., Any], operand: _Vector, result: _Vector, emit: Callable[..., Any]) -> None:
    """Give a binary operator its meaning for two vectors, or a vector and a number."""

    def typing(context: Any) -> Callable[[Any, Any], Any]:
        def typer(a: Any, b: Any) -> Any:
            kinds = (a, b)
            fits = all(kind == operand or (operand == F8 and isinstance(kind, types.Number)) for kind in kinds)
            return result if fits and operand in kinds else None

        return typer

    def lowering(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        return emit(builder, *(_vector(context, builder, *pair) for pair in zip(args, signature.args, strict=True)))

    type_callable(operation)(typing)
    lower_builtin(operation, operand, operand)(lowering)
    if operand == F8:
        lower_builtin(operation, F8, types.Number)(lowering)
        lower_builtin(operation, types.Number, F8)(lowering)


_operator(operator.add, F8, F8, lambda builder, a, b: builder.fadd(a, b))
_operator(operator.sub, F8, F8, lambda builder, a, b: builder.fsub(a, b))
_operator(operator.mul, F8, F8, lambda builder, a, b: builder.fmul(a, b))
_operator(operator.truediv, F8, F8, lambda builder, a, b: builder.fdiv(a, b))
_operator(operator.gt, F8, M8, lambda builder, a, b: builder.fcmp_ordered(">", a, b))
_operator(operator.ge, F8, M8, lambda builder, a, b: builder.fcmp_ordered(">=", a, b))
_operator(operator.lt, F8, M8, lambda builder, a, b: builder.fcmp_ordered("<", a, b))
_operator(operator.le, F8, M8, lambda builder, a, b: builder.fcmp_ordered("<=", a, b))
_operator(operator.and_, M8, M8, lambda builder, a, b: builder.and_(a, b))
_operator(operator.xor, M8, M8, lambda builder, a, b: builder.xor(a, b))


# --- functions on vectors ----------------------------------------------------------------------------------------


@operation
def splat(typingctx: Any, value: Any) -> Any:
    """splat(x): F8 with the number x in every lane."""
    return F8(value), lambda context, builder, signature, args: _vector(
        context, builder, args[0], signature.args[0]
    )


@operation
def lanes(typingctx: Any) -> Any:
    """lanes(): F8 of 0, 1, ... 7."""
    return F8(), lambda context, builder, signature, args: ir.Constant(FLOATS, [float(i) for i in range(LANES)])


@operation
def fma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """fma(a, b, c): a b + c, rounded once."""
    return F8(F8, F8, F8), lambda context, builder, signature, args: _call(builder, "fma", *args)


@operation
def fnma(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """fnma(a, b, c): c - a b, rounded once."""
    return F8(F8, F8, F8), lambda context, builder, signature, args: _call(
        builder, "fma", builder.fneg(args[0]), args[1], args[2]
    )


@operation
def select(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """select(m, a, b): a where the mask is set, b elsewhere."""
    return F8(M8, F8, F8), lambda context, builder, signature, args: builder.select(*args)


@operation
def smaller(typingctx: Any, a: Any, b: Any) -> Any:
    """smaller(a, b): the lesser of each lane; b where one is NaN."""
    return F8(F8, F8), lambda context, builder, signature, args: builder.select(
        builder.fcmp_ordered("<", *args), *args
    )


@operation
def larger(typingctx: Any, a: Any, b: Any) -> Any:
    """larger(a, b): the greater of each lane; b where one is NaN."""
    return F8(F8, F8), lambda context, builder, signature, args: builder.select(
        builder.fcmp_ordered(">", *args), *args
    )


@operation
def root(typingctx: Any, a: Any) -> Any:
    """root(a): square root."""
    return F8(F8), lambda context, builder, signature, args: _call(builder, "sqrt", args[0])


@operation
def ceiling(typingctx: Any, a: Any) -> Any:
    """ceiling(a): the next integer up."""
    return F8(F8), lambda context, builder, signature, args: _call(builder, "ceil", args[0])


@operation
def floor(typingctx: Any, a: Any) -> Any:
    """floor(a): the next integer down."""
    return F8(F8), lambda context, builder, signature, args: _call(builder, "floor", args[0])


# 2^f for |f| <= 1/2, relative error 7.5e-8 (fitted by least squares, weights shifted towards the largest error).
_EXP2 = (
    1.0000000716539867,
    0.6931469670431798,
    0.24022119726104668,
    0.05550713308745511,
    0.009675541243487521,
    0.0013276460597890082,
)
# Adding this leaves the rounded integer in the lowest bits of the sum.
_TO_INTEGER = 1.5 * 2.0**23


@operation
def exp2(typingctx: Any, x: Any) -> Any:
    """exp2(x): 2^x for -126 < x < 127, relative error below 2e-7; rubbish, but no trap, elsewhere."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        shifted = builder.fadd(args[0], _constant(_TO_INTEGER))
        fraction = builder.fsub(args[0], builder.fsub(shifted, _constant(_TO_INTEGER)))
        power = _constant(_EXP2[-1])
        for coefficient in reversed(_EXP2[:-1]):
            power = _call(builder, "fma", power, fraction, _constant(coefficient))
        exponent = builder.shl(builder.bitcast(shifted, INTS), ir.Constant(INTS, [23] * LANES))
        return builder.bitcast(builder.add(builder.bitcast(power, INTS), exponent), FLOATS)

    return F8(F8), generate


@operation
def log2(typingctx: Any, x: Any) -> Any:
    """log2(x): base 2 logarithm of normal positive numbers, absolute error below 1e-6; rubbish elsewhere."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        # x = m 2^e with m in [sqrt(1/2), sqrt(2)); log m = 2 atanh(s), s = (m - 1) / (m + 1).
        bits = builder.bitcast(args[0], INTS)
        offset = ir.Constant(INTS, [0x3F3504F3] * LANES)
        exponent = builder.ashr(builder.sub(bits, offset), ir.Constant(INTS, [23] * LANES))
        mantissa = builder.sub(bits, builder.shl(exponent, ir.Constant(INTS, [23] * LANES)))
        m = builder.bitcast(mantissa, FLOATS)
        s = builder.fdiv(builder.fsub(m, _constant(1.0)), builder.fadd(m, _constant(1.0)))
        square = builder.fmul(s, s)
        series = _constant(1 / 9)
        for odd in (7, 5, 3, 1):
            series = _call(builder, "fma", series, square, _constant(1 / odd))
        two_over_log2 = 2.8853900817779268
        fraction = builder.fmul(builder.fmul(s, _constant(two_over_log2)), series)
        return builder.fadd(fraction, builder.sitofp(exponent, FLOATS))

    return F8(F8), generate


# --- across the lanes --------------------------------------------------------------------------------------------


def _as_integer(builder: ir.IRBuilder, mask: ir.Value) -> ir.Value:
    return builder.bitcast(mask, ir.IntType(LANES))


@operation
def some(typingctx: Any, mask: Any) -> Any:
    """some(m): True where at least one lane is set."""
    return types.boolean(M8), lambda context, builder, signature, args: builder.icmp_unsigned(
        "!=", _as_integer(builder, args[0]), ir.Constant(ir.IntType(LANES), 0)
    )


@operation
def bits(typingctx: Any, mask: Any) -> Any:
    """bits(m): uint32 whose lowest bit is the first lane."""
    return types.uint32(M8), lambda context, builder, signature, args: builder.zext(
        _as_integer(builder, args[0]), INT
    )


@operation
def lowest(typingctx: Any, number: Any) -> Any:
    """lowest(n): uint32, the position of the lowest bit of the uint32 n that is set; 32 for zero."""
    return types.uint32(types.uint32), lambda context, builder, signature, args: builder.cttz(
        args[0], ir.Constant(ir.IntType(1), 0)
    )


@operation
def ones(typingctx: Any, number: Any) -> Any:
    """ones(n): uint32, how many bits of the uint32 n are set."""
    return types.uint32(types.uint32), lambda context, builder, signature, args: builder.ctpop(args[0])


def _halves(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, width: int) -> ir.Value:
    """Add lanes that are ``width`` apart: those of a, then those of b, in each run of 2 ``width`` lanes."""
    first = [i if i % (2 * width) < width else LANES + i - width for i in range(LANES)]
    second = [i + width if i % (2 * width) < width else LANES + i for i in range(LANES)]
    return builder.fadd(
        builder.shuffle_vector(a, b, ir.Constant(INTS, first)),
        builder.shuffle_vector(a, b, ir.Constant(INTS, second)),
    )


@operation
def sums(typingctx: Any, a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, g: Any, h: Any) -> Any:
    """sums(a, ..., h): F8 of the eight horizontal sums; the order of the additions is fixed."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        pairs = [_halves(builder, args[i], args[i + 4], 4) for i in range(4)]
        quads = [_halves(builder, pairs[i], pairs[i + 2], 2) for i in range(2)]
        return _halves(builder, quads[0], quads[1], 1)

    return F8(*[F8] * 8), generate


@operation
def total(typingctx: Any, a: Any) -> Any:
    """total(a): float32 sum of the lanes, halves first; the order of the additions is fixed."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        vector = args[0]
        for width in (4, 2, 1):
            order = [(i + width) % LANES for i in range(LANES)]
            vector = builder.fadd(vector, builder.shuffle_vector(vector, vector, ir.Constant(INTS, order)))
        return builder.extract_element(vector, ir.Constant(INT, 0))

    return types.float32(F8), generate
