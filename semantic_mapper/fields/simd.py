"""Eight float32 lanes as one value in compiled kernels.

LLVM turns plain loops over a few dozen numbers into vector code only in part: it keeps sums in memory, and leaves
short softmaxes scalar. A kernel that names its lanes gets one instruction an operation, on any processor: where there
are no vectors of 256 bits, LLVM splits them.
"""

from __future__ import annotations

# numba and llvmlite are untyped.
# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportUnknownMemberType=false
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false, reportUntypedFunctionDecorator=false
# pyright: reportUntypedClassDecorator=false, reportMissingTypeStubs=false, reportUntypedBaseClass=false
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel.models import PrimitiveModel
from numba.core.errors import TypingError
from numba.core.extending import intrinsic, register_model

LANES = 8

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)
_FAST = ("contract", "reassoc", "nsz", "arcp")  # NaN and infinity keep their meaning
_LOG2E = 1.4426950408889634
_LN2_HIGH, _LN2_LOW = 0.693359375, -2.12194440e-4  # of ln 2: the product of the first with k is exact


class Lanes(types.Type):
    """Numba's type of eight float32."""

    def __init__(self) -> None:
        super().__init__(name="float32x8")


lanes = Lanes()


@register_model(Lanes)
class _LanesModel(PrimitiveModel):
    def __init__(self, dmm, fe_type) -> None:
        super().__init__(dmm, fe_type, _FLOATS)


def _operation(function: Callable[..., Any]) -> Any:
    """An intrinsic for compiled code, which calls it without the typing context."""
    return intrinsic(function)


def _constant(value):
    return ir.Constant(_FLOATS, [ir.Constant(ir.FloatType(), float(np.float32(value)))] * LANES)


def _check(array) -> None:
    if not (isinstance(array, types.Array) and array.dtype == types.float32 and array.layout == "C"):
        raise TypingError(f"lanes are of contiguous float32 arrays, got {array}")


def _pointer(context, builder, array_type, array, index):
    """Address of a row-major array's flat element."""
    data = context.make_array(array_type)(context, builder, array).data
    address = builder.gep(data, [index])
    return builder.bitcast(address, _FLOATS.as_pointer())


@_operation
def load(typingctx, array, index):
    """Elements index to index + 7 of a contiguous float32 array, counted flat."""
    _check(array)

    def codegen(context, builder, signature, args):
        return builder.load(_pointer(context, builder, signature.args[0], args[0], args[1]), align=4)

    return lanes(array, types.intp), codegen


@_operation
def store(typingctx, array, index, value):
    """Write the lanes to elements index to index + 7 of a contiguous float32 array, counted flat."""
    _check(array)

    def codegen(context, builder, signature, args):
        builder.store(args[2], _pointer(context, builder, signature.args[0], args[0], args[1]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), codegen


@_operation
def splat(typingctx, number):
    """One number in all lanes."""

    def codegen(context, builder, signature, args):
        first = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), args[0], cgutils.int32_t(0))
        every = ir.Constant(_INTS, [0] * LANES)
        return builder.shuffle_vector(first, ir.Constant(_FLOATS, ir.Undefined), every)

    return lanes(types.float32), codegen


@_operation
def multiply_add(typingctx, a, b, c):
    """a * b + c."""

    def codegen(context, builder, signature, args):
        product = builder.fmul(args[0], args[1], flags=_FAST)
        return builder.fadd(product, args[2], flags=_FAST)

    return lanes(lanes, lanes, lanes), codegen


@_operation
def add(typingctx, a, b):
    """a + b."""

    def codegen(context, builder, signature, args):
        return _sum(builder, args[0], args[1])

    return lanes(lanes, lanes), codegen


@_operation
def multiply(typingctx, a, b):
    """a * b."""

    def codegen(context, builder, signature, args):
        return builder.fmul(args[0], args[1], flags=_FAST)

    return lanes(lanes, lanes), codegen


@_operation
def larger(typingctx, a, b):
    """The larger of each two."""

    def codegen(context, builder, signature, args):
        return _larger(builder, args[0], args[1])

    return lanes(lanes, lanes), codegen


def _sum(builder, a, b):
    return builder.fadd(a, b, flags=_FAST)


def _larger(builder, a, b):
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


def _reduce(builder, value, combine):
    for step in (4, 2, 1):
        order = ir.Constant(_INTS, [(i + step) % LANES for i in range(LANES)])
        value = combine(builder, value, builder.shuffle_vector(value, value, order))
    return builder.extract_element(value, cgutils.int32_t(0))


@_operation
def total(typingctx, value):
    """Sum of the lanes."""

    def codegen(context, builder, signature, args):
        return _reduce(builder, args[0], _sum)

    return types.float32(lanes), codegen


@_operation
def largest(typingctx, value):
    """The largest lane."""

    def codegen(context, builder, signature, args):
        return _reduce(builder, args[0], _larger)

    return types.float32(lanes), codegen


def _pick(builder, a, b, order):
    return builder.shuffle_vector(a, b, ir.Constant(_INTS, order))


def _add_pairs(builder, a, b):
    """Sums of neighbours: a0 + a1, a2 + a3, b0 + b1, b2 + b3, then the same of the upper four lanes."""
    even = _pick(builder, a, b, [0, 2, 8, 10, 4, 6, 12, 14])
    odd = _pick(builder, a, b, [1, 3, 9, 11, 5, 7, 13, 15])
    return builder.fadd(even, odd, flags=_FAST)


@_operation
def totals(typingctx, a, b, c, d, e, f, g, h):
    """Eight sums, one of each argument's lanes."""

    def codegen(context, builder, signature, args):
        pairs = [_add_pairs(builder, args[i], args[i + 1]) for i in range(0, LANES, 2)]
        near, far = _add_pairs(builder, pairs[0], pairs[1]), _add_pairs(builder, pairs[2], pairs[3])
        lower = _pick(builder, near, far, [0, 1, 2, 3, 8, 9, 10, 11])
        upper = _pick(builder, near, far, [4, 5, 6, 7, 12, 13, 14, 15])
        return builder.fadd(lower, upper, flags=_FAST)

    return lanes(*[lanes] * LANES), codegen


@_operation
def swap_halves(typingctx, value):
    """The upper four lanes, then the lower four."""

    def codegen(context, builder, signature, args):
        return _pick(builder, args[0], args[0], [4, 5, 6, 7, 0, 1, 2, 3])

    return lanes(lanes), codegen


def _exp_below(builder, value):
    least = _constant(-87.0)
    x = builder.select(builder.fcmp_ordered("<", value, least), least, value)  # NaN stays
    finite = builder.select(builder.fcmp_ordered(">", x, least), x, least)
    shifted = builder.fsub(builder.fmul(finite, _constant(_LOG2E), flags=_FAST), _constant(0.5), flags=_FAST)
    k = builder.fptosi(shifted, _INTS)
    whole = builder.sitofp(k, _FLOATS)
    r = builder.fsub(x, builder.fmul(whole, _constant(_LN2_HIGH)), flags=_FAST)
    r = builder.fsub(r, builder.fmul(whole, _constant(_LN2_LOW)), flags=_FAST)
    p = _constant(1 / 720)
    for divisor in (120, 24, 6, 2, 1, 1):
        p = builder.fadd(builder.fmul(p, r, flags=_FAST), _constant(1 / divisor), flags=_FAST)
    power = builder.shl(builder.add(k, ir.Constant(_INTS, [127] * LANES)), ir.Constant(_INTS, [23] * LANES))
    return builder.fmul(p, builder.bitcast(power, _FLOATS), flags=_FAST)


@_operation
def exp_below(typingctx, value):
    """exp of each lane, for values <= 0, relative error below 1e-6; values under -87 give e^-87."""

    def codegen(context, builder, signature, args):
        return _exp_below(builder, args[0])

    return lanes(lanes), codegen


@_operation
def logistic(typingctx, value):
    """1 / (1 + exp(-x)) of each lane."""

    def codegen(context, builder, signature, args):
        x = args[0]
        negative = builder.fcmp_ordered("<", x, _constant(0.0))
        e = _exp_below(builder, builder.select(negative, x, builder.fneg(x)))
        large = builder.fdiv(_constant(1.0), builder.fadd(_constant(1.0), e, flags=_FAST), flags=_FAST)
        return builder.select(negative, builder.fmul(e, large, flags=_FAST), large)

    return lanes(lanes), codegen
