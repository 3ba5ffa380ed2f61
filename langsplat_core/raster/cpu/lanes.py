"""Sixteen float32 lanes as one value inside compiled code.

A tile is 16 pixels wide, so one row of it is one `<16 x float>` of LLVM: a single AVX-512 register, two
AVX or four SSE/NEON ones. Writing rows as values of that type, instead of as loops that an optimiser may
or may not vectorise, makes the kernels' speed a property of their source. Lanes are added, subtracted,
multiplied and divided with `+ - * /`, scalars broadcast; the rest are the functions below, used in kernels.
"""

import operator
from collections.abc import Callable
from inspect import signature as parameters_of
from itertools import product
from typing import Any

import llvmlite.ir as ir
from numba import types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES = 16
Lanes = Any  # how a value of sixteen lanes is annotated in kernels
FLOAT, INT = ir.FloatType(), ir.IntType(32)
FLOATS, INTS, DOUBLES = (ir.VectorType(kind, LANES) for kind in (FLOAT, INT, ir.DoubleType()))
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


def _kept(builder: Any, value: float) -> Any:
    """Return a constant that loops keep in a register; LLVM would fetch it from memory at every use."""
    kind = ir.FunctionType(FLOATS, [FLOATS])
    fence = builder.module.declare_intrinsic(f"llvm.arithmetic.fence.v{LANES}f32", (), kind)
    return builder.call(fence, [ir.Constant(FLOATS, [float(value)] * LANES)])


def as_lanes(builder: Any, value: Any, kind: Any = FLOATS) -> Any:
    """Return a float, double or lanes as lanes; as sixteen doubles if `kind` is that."""
    if value.type == kind:
        return value
    if isinstance(value.type, ir.DoubleType) and kind == FLOATS:
        value = builder.fptrunc(value, FLOAT)
    undefined = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(undefined, value, INT(0))
    return builder.shuffle_vector(first, undefined, ir.Constant(INTS, [0] * LANES))


def lanewise(build: Callable[..., Any], symbol: Any = None) -> Any:
    """Let kernels call `build`, or use the operator `symbol`, without its first argument, the builder.

    The others may be lanes or floats, of which one at least must be lanes.
    """
    symbol, arity = symbol or build, len(parameters_of(build).parameters) - 1

    class Typing(AbstractTemplate):
        key = symbol

        def generic(self, arguments: Any, keywords: Any) -> Any:
            fits = len(arguments) == arity and all(isinstance(a, (_Lanes, types.Float)) for a in arguments)
            return signature(lanes16, *arguments) if fits and lanes16 in arguments else None

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return build(builder, *(as_lanes(builder, argument) for argument in arguments))

    infer_global(symbol, types.Function(Typing))
    for kinds in product((_Lanes, types.Float), repeat=arity):
        if _Lanes in kinds:
            lower_builtin(symbol, *kinds)(lower)
    return build


lanewise(lambda builder, a, b: builder.fadd(a, b, flags=_FUSE), operator.add)
lanewise(lambda builder, a, b: builder.fsub(a, b, flags=_FUSE), operator.sub)
lanewise(lambda builder, a, b: builder.fmul(a, b, flags=_FUSE), operator.mul)
lanewise(lambda builder, a, b: builder.fdiv(a, b), operator.truediv)


@intrinsic
def lanes(typing: Any, value: Any) -> Any:
    """Sixteen times the same float."""
    return lanes16(value), lambda context, builder, sig, args: as_lanes(builder, args[0])


@intrinsic
def ramp(typing: Any, start: Any, step: Any) -> Any:
    """Return start + step * (0, 1, ... 15), computed in float64."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        start, step = (as_lanes(builder, argument, DOUBLES) for argument in arguments)
        steps = builder.fmul(step, ir.Constant(DOUBLES, [float(i) for i in range(LANES)]), flags=_FUSE)
        return builder.fptrunc(builder.fadd(start, steps, flags=_FUSE), FLOATS)

    return lanes16(types.float64, types.float64), lower


@lanewise
def where_at_least(builder: Any, a: Any, b: Any, yes: Any, no: Any) -> Any:
    """Return a >= b ? yes : no."""
    return builder.select(builder.fcmp_ordered(">=", a, b), yes, no)


@lanewise
def smaller(builder: Any, a: Any, b: Any) -> Any:
    """Return min(a, b)."""
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


@lanewise
def exp2(builder: Any, power: Any) -> Any:
    """2^power for -126 <= power <= 127, relative error 2e-7; other powers give any number."""
    # So large a float has no digits behind the point: the sum is rounded to an integer, in its lowest bits.
    large = _kept(builder, 1.5 * 2**23)
    shifted = builder.fadd(power, large)
    rest = builder.fsub(power, builder.fsub(shifted, large))
    result = _kept(builder, _EXP2[-1])
    for coefficient in _EXP2[-2::-1]:
        scaled = builder.fmul(result, rest, flags=_FUSE)
        result = builder.fadd(scaled, _kept(builder, coefficient), flags=_FUSE)
    # Multiplying by a power of two is an addition to the exponent's bits.
    exponent = builder.shl(builder.bitcast(shifted, INTS), ir.Constant(INTS, [23] * LANES))
    return builder.bitcast(builder.add(builder.bitcast(result, INTS), exponent), FLOATS)


def shuffle(builder: Any, a: Any, b: Any, picks: list[int]) -> Any:
    """Lanes of a (0 to n - 1) and b (n to 2 n - 1)."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(INT, len(picks)), picks))


def _fold(builder: Any, value: Any, combine: Callable[[Any, Any], Any], width: int = 1) -> Any:
    """Halve the lanes until `width` are left; one alone is a number."""
    while value.type.count > width:
        half = value.type.count // 2
        low, high = list(range(half)), list(range(half, 2 * half))
        value = combine(shuffle(builder, value, value, low), shuffle(builder, value, value, high))
    return value if width > 1 else builder.extract_element(value, INT(0))


@intrinsic
def total(typing: Any, value: Any) -> Any:
    """Sum of the lanes as a float32, added pairwise in a fixed order."""
    return types.float32(value), lambda context, builder, sig, args: _fold(builder, args[0], builder.fadd)


@intrinsic
def largest(typing: Any, value: Any) -> Any:
    """Return the greatest of the lanes as a float32."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        def larger(a: Any, b: Any) -> Any:
            return builder.select(builder.fcmp_ordered(">", a, b), a, b)

        return _fold(builder, arguments[0], larger)

    return types.float32(value), lower


@intrinsic
def borrowed(typing: Any, arrays: Any) -> Any:
    """Return a kernel's own arguments, a tuple of arrays and tuples of them, without counts of their users.

    Their owner waits for the kernel; numba counts, atomically, at every row of an array that a loop takes.
    """

    def bare(context: Any, builder: Any, kind: Any, value: Any) -> Any:
        if isinstance(kind, types.Array):
            array = context.make_array(kind)(context, builder, value)
            array.meminfo = array.meminfo.type(None)
            return array._getvalue()  # noqa: SLF001  numba has no other way to it
        if not isinstance(kind, types.BaseTuple):
            return value
        parts = [bare(context, builder, k, builder.extract_value(value, i)) for i, k in enumerate(kind.types)]
        return context.make_tuple(builder, kind, parts)

    return arrays(arrays), lambda context, builder, sig, args: bare(context, builder, arrays, args[0])


# Lanes and memory. Indices count elements of a contiguous array as if it were flat; nothing is checked.


def _pointer(context: Any, builder: Any, sig: Any, arguments: Any, kind: Any = FLOATS) -> Any:
    """Return where element arguments[1] of the array arguments[0] lies, as a pointer to `kind`."""
    data = context.make_array(sig.args[0])(context, builder, arguments[0]).data
    return builder.bitcast(builder.gep(data, [arguments[1]]), kind.as_pointer())


@intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """array[index : index + 16] of a flat float32 array."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        value = builder.load(_pointer(context, builder, sig, arguments))
        value.align = 4
        return value

    return lanes16(array, types.intp), lower


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """array[index : index + 16] = value of a flat float32 array."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        value = as_lanes(builder, arguments[2])
        builder.store(value, _pointer(context, builder, sig, arguments)).align = 4
        return context.get_dummy_value()

    return types.void(array, types.intp, value), lower


@intrinsic
def store_totals(typing: Any, array: Any, index: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """array.flat[index : index + 4] = the sums of the lanes of a, b, c, d, added pairwise.

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
        value = _fold(builder, value, builder.fadd, 4)
        builder.store(value, _pointer(context, builder, sig, arguments, value.type)).align = 4
        return context.get_dummy_value()

    return types.void(array, types.intp, a, b, c, d), lower


@intrinsic
def prefetch(typing: Any, array: Any, index: Any) -> Any:
    """Ask for the cache line of element `index`."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        byte = ir.IntType(8)
        kind = ir.FunctionType(ir.VoidType(), [byte.as_pointer(), INT, INT, INT])
        fetch = builder.module.declare_intrinsic("llvm.prefetch", [byte.as_pointer()], kind)
        read, keep, is_data = INT(0), INT(3), INT(1)
        builder.call(fetch, [_pointer(context, builder, sig, arguments, byte), read, keep, is_data])
        return context.get_dummy_value()

    return types.void(array, types.intp), lower
