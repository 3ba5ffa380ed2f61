"""Lanes and memory: loads and stores of sixteen numbers, plain, transposed or as sixteen bits.

Indices count elements of a contiguous array as if it were flat; nothing is checked.
"""

from typing import Any

import llvmlite.ir as ir
from numba import types
from numba.extending import intrinsic

from langsplat_core.raster.cpu.lanes import (
    FLOAT,
    FLOATS,
    INT,
    INTS,
    LANES,
    as_lanes,
    constant,
    lanes16,
    shuffle,
)


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


def _fours(context: Any, builder: Any, array_type: Any, array: Any, index: Any, stride: Any) -> list[Any]:
    """Pointers to four floats each, at elements index, index + stride, ... (sixteen of them)."""
    data = context.make_array(array_type)(context, builder, array).data
    pointers, kind = [], ir.VectorType(FLOAT, 4).as_pointer()
    for _ in range(LANES):
        pointers.append(builder.bitcast(builder.gep(data, [index]), kind))
        index = builder.add(index, stride)
    return pointers


@intrinsic
def store_four(typing: Any, array: Any, index: Any, stride: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """array.flat[index + stride i : + 4] = a[i], b[i], c[i], d[i] for the sixteen i, unchecked."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        a, b, c, d = arguments[3:]
        pointers = _fours(context, builder, sig.args[0], *arguments[:3])
        for half in (0, 8):  # pixels half to half + 8
            pair = [n + k for n in range(half, half + 8) for k in (0, LANES)]
            ab, cd = shuffle(builder, a, b, pair), shuffle(builder, c, d, pair)
            for n in range(8):
                four = shuffle(builder, ab, cd, [2 * n, 2 * n + 1, LANES + 2 * n, LANES + 2 * n + 1])
                builder.store(four, pointers[half + n]).align = 4
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, a, b, c, d), lower


@intrinsic
def load_four(typing: Any, array: Any, index: Any, stride: Any) -> Any:
    """The inverse of `store_four`: a tuple of four lanes."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        pixels = []
        for pointer in _fours(context, builder, sig.args[0], *arguments):
            value = builder.load(pointer)
            value.align = 4
            pixels.append(value)
        while len(pixels) > 1:  # concatenate neighbours: one vector of 64, pixel by pixel
            width = 2 * pixels[0].type.count
            pixels = [
                shuffle(builder, pixels[n], pixels[n + 1], list(range(width)))
                for n in range(0, len(pixels), 2)
            ]
        picks = [[4 * n + k for n in range(LANES)] for k in range(4)]
        channels = [shuffle(builder, pixels[0], pixels[0], pick) for pick in picks]
        return context.make_tuple(builder, sig.return_type, channels)

    return types.UniTuple(lanes16, 4)(array, types.intp, types.intp), lower


@intrinsic
def store_three(typing: Any, array: Any, index: Any, a: Any, b: Any, c: Any) -> Any:
    """array.flat[index + 3 i : + 3] = a[i], b[i], c[i] for the sixteen i, unchecked."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        a, b, c = arguments[2:]
        both = shuffle(builder, a, b, list(range(2 * LANES)))
        wide = shuffle(builder, c, c, list(range(2 * LANES)))
        for block in range(3):
            picks = [n // 3 + LANES * (n % 3) for n in range(block * LANES, (block + 1) * LANES)]
            at = builder.add(arguments[1], ir.Constant(arguments[1].type, block * LANES))
            pointer = _pointer(context, builder, sig.args[0], arguments[0], at)
            builder.store(shuffle(builder, both, wide, picks), pointer).align = 4
        return context.get_dummy_value()

    return types.void(array, types.intp, a, b, c), lower


@intrinsic
def load_three(typing: Any, array: Any, index: Any) -> Any:
    """The inverse of `store_three`: a tuple of three lanes."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        blocks = []
        for block in range(3):
            at = builder.add(arguments[1], ir.Constant(arguments[1].type, block * LANES))
            value = builder.load(_pointer(context, builder, sig.args[0], arguments[0], at))
            value.align = 4
            blocks.append(value)
        both = shuffle(builder, blocks[0], blocks[1], list(range(2 * LANES)))
        wide = shuffle(builder, blocks[2], blocks[2], list(range(2 * LANES)))
        channels = [shuffle(builder, both, wide, [3 * n + k for n in range(LANES)]) for k in range(3)]
        return context.make_tuple(builder, sig.return_type, channels)

    return types.UniTuple(lanes16, 3)(array, types.intp), lower


UNIT = 65535  # what stands for 1 in sixteen bits


@intrinsic
def load_units(typing: Any, array: Any, index: Any) -> Any:
    """array.flat[index : index + 16] / UNIT of uint16, as lanes, unchecked."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, arguments[0]).data
        shorts = ir.VectorType(ir.IntType(16), LANES).as_pointer()
        value = builder.load(builder.bitcast(builder.gep(data, [arguments[1]]), shorts))
        value.align = 2
        return builder.fmul(builder.sitofp(builder.zext(value, INTS), FLOATS), constant(1 / UNIT))

    return lanes16(array, types.intp), lower


@intrinsic
def store_units(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """array.flat[index : index + 16] = lanes in [0, 1] times UNIT, rounded, as uint16, unchecked."""

    def lower(context: Any, builder: Any, sig: Any, arguments: Any) -> Any:
        scaled = builder.fadd(builder.fmul(arguments[2], constant(UNIT)), constant(0.5))
        shorts = ir.VectorType(ir.IntType(16), LANES)
        data = context.make_array(sig.args[0])(context, builder, arguments[0]).data
        pointer = builder.bitcast(builder.gep(data, [arguments[1]]), shorts.as_pointer())
        builder.store(builder.trunc(builder.fptosi(scaled, INTS), shorts), pointer).align = 2
        return context.get_dummy_value()

    return types.void(array, types.intp, value), lower
