"""Sixteen float32 lanes as one value inside compiled code.

A tile is 16 pixels wide, so one row of it is one `<16 x float>` of LLVM: a single AVX-512 register, two
AVX or four SSE/NEON ones. Writing rows as values of that type, instead of as loops that an optimiser may
or may not vectorise, makes the kernels' speed a property of their source. Lanes are added, subtracted and
multiplied with `+ - *`, scalars broadcast; the rest are the functions below, for use under `numba.njit`.
"""

import operator
from collections.abc import Callable
from typing import Any

import llvmlite.ir as ir
from numba import types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16
Lanes = Any  # how a value of sixteen lanes is annotated in kernels
FLOAT, INT = ir.FloatType(), ir.IntType(32)
FLOATS, INTS = ir.VectorType(FLOAT, LANES), ir.VectorType(INT, LANES)
_FUSE = ("contract",)  # a * b + c may round once; nothing is reordered

# 2^x on [-0.5, 0.5], minimax in relative error (7.5e-8, found by iteratively reweighted least squares).
_EXP2 = (1.00000007, 0.693146967, 0.240221197, 0.0555071327, 0.00967554133, 0.00132764715)


class _Lanes(types.Type):
    def __init__(self) -> None:
        super().__init__(name="lanes16")


lanes16 = _Lanes()


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: Any) -> None:
        super().__init__(manager, numba_type, FLOATS)


def _constant(value: float) -> ir.Constant:
    return ir.Constant(FLOATS, [float(value)] * LANES)


def as_lanes(builder: Any, value: Any) -> Any:
    """Return a float, double or lanes as lanes."""
    if value.type == FLOATS:
        return value
    if isinstance(value.type, ir.DoubleType):
        value = builder.fptrunc(value, FLOAT)
    undefined = ir.Constant(FLOATS, ir.Undefined)
    first = builder.insert_element(undefined, value, INT(0))
    return builder.shuffle_vector(first, undefined, ir.Constant(INTS, [0] * LANES))


def _is_lanes_or_float(*arguments: types.Type) -> bool:
    return all(isinstance(a, (_Lanes, types.Float)) for a in arguments)


def _add_operator(symbol: Callable[[Any, Any], Any], instruction: str) -> None:
    @infer_global(symbol)
    class Typing(AbstractTemplate):
        def generic(self, arguments: Any, keywords: Any) -> Any:
            if len(arguments) == 2 and lanes16 in arguments and _is_lanes_or_float(*arguments):
                return signature(lanes16, *arguments)
            return None

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        a, b = (as_lanes(builder, argument) for argument in arguments)
        return getattr(builder, instruction)(a, b, flags=_FUSE)

    for kinds in ((_Lanes, _Lanes), (_Lanes, types.Float), (types.Float, _Lanes)):
        lower_builtin(symbol, *kinds)(lower)


_add_operator(operator.add, "fadd")
_add_operator(operator.sub, "fsub")
_add_operator(operator.mul, "fmul")


def shuffle(builder: Any, a: Any, b: Any, picks: list[int]) -> Any:
    """Lanes of a (0 to n - 1) and b (n to 2 n - 1)."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(INT, len(picks)), picks))


@intrinsic
def lanes(typing: Any, value: Any) -> Any:
    """Sixteen times the same float."""
    return lanes16(value), lambda context, builder, sig, args: as_lanes(builder, args[0])


@intrinsic
def ramp(typing: Any) -> Any:
    """0, 1, ... 15."""
    values = ir.Constant(FLOATS, [float(i) for i in range(LANES)])
    return lanes16(), lambda context, builder, sig, args: values


@intrinsic
def where_greater(typing: Any, a: Any, b: Any, yes: Any, no: Any) -> Any:
    """Return a > b ? yes : no."""
    return lanes16(a, b, yes, no), lambda context, builder, sig, args: _select(builder, ">", *args)


@intrinsic
def where_at_least(typing: Any, a: Any, b: Any, yes: Any, no: Any) -> Any:
    """Return a >= b ? yes : no."""
    return lanes16(a, b, yes, no), lambda context, builder, sig, args: _select(builder, ">=", *args)


@intrinsic
def smaller(typing: Any, a: Any, b: Any) -> Any:
    """Return min(a, b), lane by lane."""
    return lanes16(a, b), lambda context, builder, sig, args: _select(builder, "<", *args, *args)


def _select(builder: Any, comparison: str, a: Any, b: Any, yes: Any, no: Any) -> Any:
    a, b, yes, no = (as_lanes(builder, value) for value in (a, b, yes, no))
    return builder.select(builder.fcmp_ordered(comparison, a, b), yes, no)


@intrinsic
def reciprocal(typing: Any, value: Any) -> Any:
    """Return 1 / value, lane by lane."""
    return lanes16(value), lambda context, builder, sig, args: builder.fdiv(_constant(1), args[0])


@intrinsic
def exp2(typing: Any, power: Any) -> Any:
    """2^power for power <= 0.5, relative error 2e-7; powers below -100 give 2^-100."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        low = _constant(-100)
        power = builder.select(builder.fcmp_ordered(">", arguments[0], low), arguments[0], low)
        # Conversion truncates, and power - 0.5 <= 0: so this rounds to the nearest integer.
        whole = builder.fptosi(builder.fsub(power, _constant(0.5)), INTS)
        rest = builder.fsub(power, builder.sitofp(whole, FLOATS))
        result = _constant(_EXP2[-1])
        for coefficient in _EXP2[-2::-1]:
            product = builder.fmul(result, rest, flags=_FUSE)
            result = builder.fadd(product, _constant(coefficient), flags=_FUSE)
        # Multiplying by 2^whole is an addition to the exponent's bits.
        bits = builder.add(builder.bitcast(result, INTS), builder.shl(whole, ir.Constant(INTS, [23] * LANES)))
        return builder.bitcast(bits, FLOATS)

    return lanes16(power), lower


def _fold(builder: Any, value: Any, combine: Callable[[Any, Any], Any]) -> Any:
    """Halve the lanes until one is left."""
    width = LANES
    while width > 1:
        width //= 2
        low, high = (
            ir.Constant(ir.VectorType(INT, width), list(range(start, start + width))) for start in (0, width)
        )
        value = combine(builder.shuffle_vector(value, value, low), builder.shuffle_vector(value, value, high))
    return builder.extract_element(value, INT(0))


@intrinsic
def total(typing: Any, value: Any) -> Any:
    """Sum of the lanes as a float32, added pairwise in a fixed order."""
    return types.float32(value), lambda context, builder, sig, args: _fold(builder, args[0], builder.fadd)


@intrinsic
def largest(typing: Any, value: Any) -> Any:
    """Return the greatest of the lanes as a float32."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return _fold(
            builder, arguments[0], lambda a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b)
        )

    return types.float32(value), lower


@intrinsic
def store_totals(typing: Any, array: Any, index: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """array.flat[index : index + 4] = the sums of the lanes of a, b, c, d, added pairwise, unchecked.

    All four at once take a third of the instructions of four times `total`.
    """

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        def merge(x: Any, y: Any, run: int) -> Any:
            """Add stretches of `run` lanes pairwise within x and within y; their results take turns."""
            starts = [n + side for n in range(0, LANES, 2 * run) for side in (0, LANES)]
            even = [n + k for n in starts for k in range(run)]
            odd = [n + run + k for n in starts for k in range(run)]
            return builder.fadd(shuffle(builder, x, y, even), shuffle(builder, x, y, odd))

        a, b, c, d = arguments[2:]
        value = merge(merge(a, b, 1), merge(c, d, 1), 2)  # lanes: a b c d a b c d ...
        for width in (8, 4):
            low, high = list(range(width)), list(range(width, 2 * width))
            value = builder.fadd(shuffle(builder, value, value, low), shuffle(builder, value, value, high))
        data = context.make_array(sig.args[0])(context, builder, arguments[0]).data
        pointer = builder.bitcast(builder.gep(data, [arguments[1]]), ir.VectorType(FLOAT, 4).as_pointer())
        builder.store(value, pointer).align = 4
        return context.get_dummy_value()

    return types.void(array, types.intp, a, b, c, d), lower


# Lanes and memory: loads and stores of sixteen numbers, plain, transposed or as sixteen bits.
#
# Indices count elements of a contiguous array as if it were flat; nothing is checked.


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), FLOATS.as_pointer())


@intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """array[index : index + 16] of a flat float32 array, unchecked."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        value = builder.load(_pointer(context, builder, sig.args[0], *arguments))
        value.align = 4
        return value

    return lanes16(array, types.intp), lower


@intrinsic
def prefetch(typing: Any, array: Any, index: Any) -> Any:
    """Ask for the cache line of element `index` (counted flat) of a contiguous array."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, arguments[0]).data
        byte = ir.IntType(8).as_pointer()
        signature = ir.FunctionType(ir.VoidType(), [byte, INT, INT, INT])
        fetch = builder.module.declare_intrinsic("llvm.prefetch", [byte], signature)
        read, keep, is_data = INT(0), INT(3), INT(1)
        builder.call(fetch, [builder.bitcast(builder.gep(data, [arguments[1]]), byte), read, keep, is_data])
        return context.get_dummy_value()

    return types.void(array, types.intp), lower


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index : index + 16] = value of a flat float32 array, unchecked."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        value = as_lanes(builder, arguments[2])
        builder.store(value, _pointer(context, builder, sig.args[0], *arguments[:2])).align = 4
        return context.get_dummy_value()

    return types.void(array, types.intp, value), lower


UNIT = 65535  # what stands for 1 in sixteen bits


@intrinsic
def load_units(typing: Any, array: Any, index: Any) -> Any:
    """array.flat[index : index + 16] / UNIT of uint16, as lanes, unchecked."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, arguments[0]).data
        shorts = ir.VectorType(ir.IntType(16), LANES).as_pointer()
        value = builder.load(builder.bitcast(builder.gep(data, [arguments[1]]), shorts))
        value.align = 2
        return builder.fmul(builder.sitofp(builder.zext(value, INTS), FLOATS), _constant(1 / UNIT))

    return lanes16(array, types.intp), lower


@intrinsic
def store_units(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """array.flat[index : index + 16] = lanes in [0, 1] times UNIT, rounded, as uint16, unchecked."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        scaled = builder.fadd(builder.fmul(arguments[2], _constant(UNIT)), _constant(0.5))
        shorts = ir.VectorType(ir.IntType(16), LANES)
        data = context.make_array(sig.args[0])(context, builder, arguments[0]).data
        pointer = builder.bitcast(builder.gep(data, [arguments[1]]), shorts.as_pointer())
        builder.store(builder.trunc(builder.fptosi(scaled, INTS), shorts), pointer).align = 2
        return context.get_dummy_value()

    return types.void(array, types.intp, value), lower
