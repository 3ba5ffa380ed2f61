"""Sixteen float32, or eight float64, lanes as one value inside compiled code.

A row of a tile, 16 pixels, is one `<16 x float>` of LLVM: a single AVX-512 register, two AVX or four SSE or
NEON ones, whatever an optimiser would make of a loop. Eight Gaussians are projected as one value of doubles,
which round at every step as numbers do. Lanes take `+ - * /`, `min`, `max`, `abs`, `np.sqrt` and the
functions below; scalars broadcast.
"""

import math
import operator
from collections.abc import Callable, Iterator
from inspect import signature as parameters_of
from itertools import product
from typing import Any

import llvmlite.ir as ir
import numpy as np
from numba import types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

LANES, EIGHT = 16, 8
Lanes = Any  # how a value of lanes is annotated in kernels
FLOAT, DOUBLE, INT, LONG = ir.FloatType(), ir.DoubleType(), ir.IntType(32), ir.IntType(64)
FLOATS, INTS, WIDE = (ir.VectorType(kind, LANES) for kind in (FLOAT, INT, DOUBLE))
DOUBLES, LONGS = ir.VectorType(DOUBLE, EIGHT), ir.VectorType(LONG, EIGHT)
_FUSE = ("contract",)  # a * b + c may round once; nothing is reordered

# 2^x on [-0.5, 0.5], minimax in relative error (7.5e-8, found by iteratively reweighted least squares).
_EXP2 = [1.00000007, 0.693146967, 0.240221197, 0.0555071327, 0.00967554133, 0.00132764715]
_EXP2_SERIES = [math.log(2) ** n / math.factorial(n) for n in range(14)]
_LOG2_SERIES = [2 / math.log(2) / (2 * n + 1) for n in range(11)]  # of 2 artanh(x) / x / ln 2, in x^2


class _Lanes(types.Type):
    def __init__(self, kind: Any) -> None:
        super().__init__(name=f"lanes{kind.count}")
        self.kind = kind


lanes16, lanes8 = _Lanes(FLOATS), _Lanes(DOUBLES)


@register_model(_Lanes)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, numba_type: Any) -> None:
        super().__init__(manager, numba_type, numba_type.kind)


def _of_llvm(builder: Any, name: str, x: Any) -> Any:
    """Return LLVM's function `name` of each lane, of floats or doubles."""
    name = f"llvm.{name}.v{x.type.count}f{32 if x.type == FLOATS else 64}"
    kind = ir.FunctionType(x.type, [x.type])
    return builder.call(builder.module.declare_intrinsic(name, (), kind), [x])


def _kept(builder: Any, value: float, kind: Any = FLOATS) -> Any:
    """Return a constant that loops keep in a register; LLVM would fetch it from memory at every use."""
    return _of_llvm(builder, "arithmetic.fence", ir.Constant(kind, [float(value)] * kind.count))


def as_lanes(builder: Any, value: Any, kind: Any = FLOATS) -> Any:
    """Return an integer, float, double or lanes as lanes of a kind."""
    if value.type == kind:
        return value
    if isinstance(value.type, ir.IntType):
        value = builder.sitofp(value, kind.element)
    elif isinstance(value.type, ir.DoubleType) and kind == FLOATS:
        value = builder.fptrunc(value, FLOAT)
    undefined = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(undefined, value, INT(0))
    return shuffle(builder, first, undefined, [0] * kind.count)


def lanewise(build: Callable[..., Any], symbol: Any = None) -> Any:
    """Let kernels call `build`, or use the operator `symbol`, without its first argument, the builder.

    The other arguments may be lanes or numbers; at least one must be lanes, and all lanes of one kind.
    """
    symbol, arity = symbol or build, len(parameters_of(build).parameters) - 1

    class Typing(AbstractTemplate):
        key = symbol

        def generic(self, arguments: Any, keywords: Any) -> Any:
            kinds = {a for a in arguments if isinstance(a, _Lanes)}
            fits = len(arguments) == arity and all(isinstance(a, (_Lanes, types.Number)) for a in arguments)
            return signature(*kinds, *map(types.unliteral, arguments)) if fits and len(kinds) == 1 else None

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        return build(builder, *(as_lanes(builder, argument, sig.return_type.kind) for argument in arguments))

    infer_global(symbol, types.Function(Typing))
    for kinds in product((_Lanes, types.Float, types.Integer), repeat=arity):
        if _Lanes in kinds:
            lower_builtin(symbol, *kinds)(lower)
    return build


def _flags(a: Any) -> tuple[str, ...]:
    return _FUSE if a.type == FLOATS else ()


lanewise(lambda builder, a, b: builder.fadd(a, b, flags=_flags(a)), operator.add)
lanewise(lambda builder, a, b: builder.fsub(a, b, flags=_flags(a)), operator.sub)
lanewise(lambda builder, a, b: builder.fmul(a, b, flags=_flags(a)), operator.mul)
lanewise(lambda builder, a, b: builder.fdiv(a, b), operator.truediv)
lanewise(lambda builder, a: builder.fneg(a), operator.neg)
lanewise(lambda builder, a: _of_llvm(builder, "fabs", a), abs)
lanewise(lambda builder, a: _of_llvm(builder, "sqrt", a), np.sqrt)
lanewise(lambda builder, a, b: builder.select(builder.fcmp_ordered("<", a, b), a, b), min)
lanewise(lambda builder, a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b), max)


@intrinsic
def lanes(typing: Any, value: Any) -> Any:
    """Return sixteen lanes of the same float32."""
    return lanes16(value), lambda context, builder, sig, args: as_lanes(builder, args[0])


@intrinsic
def ramp(typing: Any, start: Any, step: Any) -> Any:
    """Return start + step * (0, 1, ... 15), computed in float64."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        start, step = (as_lanes(builder, argument, WIDE) for argument in arguments)
        steps = builder.fmul(step, ir.Constant(WIDE, [float(i) for i in range(LANES)]), flags=_FUSE)
        return builder.fptrunc(builder.fadd(start, steps, flags=_FUSE), FLOATS)

    return lanes16(types.float64, types.float64), lower


@lanewise
def where_at_least(builder: Any, a: Any, b: Any, yes: Any, no: Any) -> Any:
    """Return a >= b ? yes : no."""
    return builder.select(builder.fcmp_ordered(">=", a, b), yes, no)


def _polynomial(builder: Any, x: Any, coefficients: list[float]) -> Any:
    """Return a polynomial in x; coefficients: of rising powers."""
    result = _kept(builder, coefficients[-1], x.type)
    for coefficient in coefficients[-2::-1]:
        scaled = builder.fmul(result, x, flags=_FUSE)
        result = builder.fadd(scaled, _kept(builder, coefficient, x.type), flags=_FUSE)
    return result


@lanewise
def exp2(builder: Any, power: Any) -> Any:
    """Return 2^power for -126 <= power <= 127, relative error 2e-7; undefined for other powers.

    For doubles: -1022 <= power <= 1023, relative error 2e-16.
    """
    # Adding so large a number rounds the power to an integer, which then stands in the sum's lowest bits.
    digits, whole = (23, INTS) if power.type == FLOATS else (52, LONGS)
    large = _kept(builder, 1.5 * 2**digits, power.type)
    shifted = builder.fadd(power, large)
    rest = builder.fsub(power, builder.fsub(shifted, large))
    result = _polynomial(builder, rest, _EXP2 if power.type == FLOATS else _EXP2_SERIES)
    # Multiplying by a power of two is an addition to the exponent's bits.
    exponent = builder.shl(builder.bitcast(shifted, whole), ir.Constant(whole, [digits] * whole.count))
    return builder.bitcast(builder.add(builder.bitcast(result, whole), exponent), power.type)


@lanewise
def log2(builder: Any, x: Any) -> Any:
    """Return log2 of positive normal doubles 2^k m, sqrt(1/2) <= m <= sqrt(2), relative error 4e-16."""
    one, digits = _kept(builder, 1, DOUBLES), ir.Constant(LONGS, [52] * EIGHT)
    root = builder.bitcast(_kept(builder, math.sqrt(0.5), DOUBLES), LONGS)
    bits = builder.bitcast(x, LONGS)
    k = builder.ashr(builder.sub(bits, root), digits)
    m = builder.bitcast(builder.sub(bits, builder.shl(k, digits)), DOUBLES)
    ratio = builder.fdiv(builder.fsub(m, one), builder.fadd(m, one))
    series = _polynomial(builder, builder.fmul(ratio, ratio), _LOG2_SERIES)
    return builder.fadd(builder.sitofp(k, DOUBLES), builder.fmul(ratio, series))


def shuffle(builder: Any, a: Any, b: Any, picks: list[int]) -> Any:
    """Return the lanes `picks` of a (numbered 0 to n - 1) and b (n to 2 n - 1)."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(INT, len(picks)), picks))


def _fold(builder: Any, value: Any, combine: Callable[[Any, Any], Any], width: int = 1) -> Any:
    """Combine halves of the lanes until `width` are left; a single one is returned as a number."""
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
        return _fold(
            builder, arguments[0], lambda a, b: builder.select(builder.fcmp_ordered(">", a, b), a, b)
        )

    return types.float32(value), lower


@intrinsic
def borrowed(typing: Any, arrays: Any) -> Any:
    """Return a kernel's arguments, a nested tuple of arrays, without reference counts.

    The caller owns them until the kernel ends; numba would count, atomically, at every row that a loop takes.
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
    """Return a pointer of type `kind` to element arguments[1] of the array arguments[0]."""
    data = context.make_array(sig.args[0])(context, builder, arguments[0]).data
    return builder.bitcast(builder.gep(data, [arguments[1]]), kind.as_pointer())


@intrinsic
def load(typing: Any, array: Any, index: Any) -> Any:
    """Return array[index : index + 16] of a flat float32 array."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        value = builder.load(_pointer(context, builder, sig, arguments))
        value.align = 4
        return value

    return lanes16(array, types.intp), lower


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Set array[index : index + 16] of a flat float32 array to `value`."""

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
            """Add stretches of `run` lanes pairwise within x and within y; results of both alternate."""
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


def _elements(context: Any, builder: Any, sig: Any, arguments: Any) -> Iterator[Any]:
    """Yield pointers to array[rows[start + j], column] for eight j, of a 1D array (column 0) or a 2D one."""
    array, rows = (context.make_array(sig.args[i])(context, builder, arguments[i]) for i in (0, 1))
    columns = builder.extract_value(array.shape, 1) if sig.args[0].ndim == 2 else LONG(1)
    for j in range(EIGHT):
        row = builder.load(builder.gep(rows.data, [builder.add(arguments[2], LONG(j))]))
        yield builder.gep(array.data, [builder.add(builder.mul(row, columns), arguments[3])])


@intrinsic
def gathered(typing: Any, array: Any, rows: Any, start: Any, column: Any) -> Any:
    """Return array[rows[start + j], column], j < 8, of a 1D (column 0) or 2D float array; rows: int64."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        value = ir.Constant(ir.VectorType(context.get_value_type(array.dtype), EIGHT), ir.Undefined)
        for j, pointer in enumerate(_elements(context, builder, sig, arguments)):
            value = builder.insert_element(value, builder.load(pointer), INT(j))
        return value if value.type == DOUBLES else builder.fpext(value, DOUBLES)

    return lanes8(array, rows, types.intp, types.intp), lower


@intrinsic
def scatter(typing: Any, array: Any, rows: Any, start: Any, column: Any, value: Any) -> Any:
    """Set array[rows[start + j], column] to value[j] for eight doubles; array as in `gathered`."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        kind, value = context.get_value_type(array.dtype), arguments[4]
        value = value if kind == DOUBLE else builder.fptrunc(value, ir.VectorType(kind, EIGHT))
        for j, pointer in enumerate(_elements(context, builder, sig, arguments)):
            builder.store(builder.extract_element(value, INT(j)), pointer)
        return context.get_dummy_value()

    return types.void(array, rows, types.intp, types.intp, value), lower


@intrinsic
def prefetch(typing: Any, array: Any, index: Any) -> Any:
    """Prefetch the cache line of element `index`."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        byte = ir.IntType(8)
        kind = ir.FunctionType(ir.VoidType(), [byte.as_pointer(), INT, INT, INT])
        fetch = builder.module.declare_intrinsic("llvm.prefetch", [byte.as_pointer()], kind)
        read, keep, is_data = INT(0), INT(3), INT(1)
        builder.call(fetch, [_pointer(context, builder, sig, arguments, byte), read, keep, is_data])
        return context.get_dummy_value()

    return types.void(array, types.intp), lower
