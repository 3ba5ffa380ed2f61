"""Which Gaussians touch which tile of 16x16 pixels, front to back: sorting for the CPU backend."""

from typing import NamedTuple

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import Workers, helper, kernel
from langsplat_core.errors import BackendError
from langsplat_core.raster.cpu import projection as cp

TILE = 16
_BLOCKS = 16  # pieces of the depth order that are binned side by side; the result does not depend on it
_SLACK = 1e-3  # px by which footprints are widened here; the blending kernels test alpha itself
_MOST = 2**31 - 1  # intersections of Gaussians and tiles in one view
_DIGIT = 11  # bits per pass of the radix sort


class Grid(NamedTuple):
    """An image cut into tiles."""

    width: float  # px; a float, as it is compared with floats
    height: float
    columns: int  # tiles per row of tiles


class Tiles(NamedTuple):
    """I intersections of M drawn Gaussians (numbered front to back) with T tiles (row by row)."""

    starts: Array  # (T + 1,) int64: tile t owns intersections starts[t] to starts[t + 1]
    ranks: Array  # (I,) int32 Gaussian of each intersection, ascending within a tile
    rows: Array  # (I,) uint16 spans of rows that the footprint touches in the tile, see `pack_span`
    firsts: Array  # (M + 1,) int64: Gaussian r has intersections slots[firsts[r] : firsts[r + 1]]
    slots: Array  # (I,) int32
    columns: int  # tiles per row of tiles


@helper
def pack_span(low: int, high: int) -> int:
    """Rows [low, high) of a tile as one number of sixteen bits."""
    return low + 256 * high


@helper
def unpack_span(packed: int) -> tuple[int, int]:
    """The inverse of `pack_span`."""
    return packed & 255, packed >> 8


@kernel
def depth_order(status: Array, depth_bits: Array) -> Array:
    """(N,) status and depths reinterpreted as uint64 -> (M,) int32 drawn rows, by depth, ties by index.

    Positive floats order as their bits do. Least significant digit first, each pass stable.
    """
    count = 0
    low, high = np.uint64(2**64 - 1), np.uint64(0)
    for i in range(status.shape[0]):
        if status[i] == cp.DRAWN:
            count += 1
            low, high = min(low, depth_bits[i]), max(high, depth_bits[i])
    keys, order = np.empty(count, np.uint64), np.empty(count, np.int32)
    count = 0
    for i in range(status.shape[0]):
        if status[i] == cp.DRAWN:
            keys[count], order[count] = depth_bits[i] - low, i
            count += 1
    other_keys, other_order = np.empty_like(keys), np.empty_like(order)
    shift = np.uint64(0)
    while count > 1 and (high - low) >> shift > 0:
        ends = np.zeros(1 << _DIGIT, np.int64)
        for i in range(count):
            ends[(keys[i] >> shift) & np.uint64((1 << _DIGIT) - 1)] += 1
        total = 0
        for digit in range(1 << _DIGIT):
            total, ends[digit] = total + ends[digit], total
        for i in range(count):
            digit = (keys[i] >> shift) & np.uint64((1 << _DIGIT) - 1)
            place = ends[digit]
            ends[digit] = place + 1
            other_keys[place], other_order[place] = keys[i], order[i]
        keys, other_keys = other_keys, keys
        order, other_order = other_order, order
        shift += np.uint64(_DIGIT)
        if shift >= np.uint64(64):
            break
    return order


@helper
def _span(centre: float, low: float, high: float, size: float) -> tuple[int, int]:
    """Pixels [first, last) of `size` whose centres lie in [centre + low, centre + high]."""
    first = min(max(np.ceil(centre + low - 0.5 - _SLACK), 0.0), size)
    last = min(max(np.floor(centre + high - 0.5 + _SLACK) + 1, 0.0), size)
    return int(first), int(last)


@helper
def _rows_in_column(g: Array, column: int, height: float) -> tuple[int, int]:
    """Pixel rows [first, last) in which the footprint `g` meets a column of tiles.

    At abscissa dx the ellipse spans dy = slope dx +- bulge sqrt(half_width^2 - dx^2); its lowest point over
    a strip of columns is the ellipse's own, or else on the strip's border nearest to that.
    """
    a2, c2, k = g[cp.FACTOR_A] * g[cp.FACTOR_A], g[cp.FACTOR_C] * g[cp.FACTOR_C], g[cp.FACTOR_K]
    across = a2 * k * k + c2
    slope, bulge = a2 * k / across, g[cp.FACTOR_A] * g[cp.FACTOR_C] / across
    wide, peak = g[cp.HALF_WIDTH], k * g[cp.HALF_HEIGHT]
    left = max(column * TILE + 0.5 - _SLACK - g[cp.MEAN_X], -wide)
    right = min(column * TILE + TILE - 0.5 + _SLACK - g[cp.MEAN_X], wide)
    bottom, top = min(max(peak, left), right), min(max(-peak, left), right)
    high = slope * bottom + bulge * np.sqrt(max(wide * wide - bottom * bottom, 0.0))
    low = slope * top - bulge * np.sqrt(max(wide * wide - top * top, 0.0))
    return _span(g[cp.MEAN_Y], low, high, height)


@helper
def _columns_touched(g: Array, grid: Grid) -> tuple[int, int]:
    first, last = _span(g[cp.MEAN_X], -g[cp.HALF_WIDTH], g[cp.HALF_WIDTH], grid.width)
    return first // TILE, (last + TILE - 1) // TILE if last > first else first // TILE


@kernel
def _count(first: int, last: int, geometry: Array, grid: Grid, counts: Array, firsts: Array) -> None:
    """For blocks [first, last): counts[block, tile] and firsts[rank + 1] <- how many intersections."""
    share = (geometry.shape[0] + _BLOCKS - 1) // _BLOCKS
    for block in range(first, last):
        for rank in range(block * share, min(geometry.shape[0], (block + 1) * share)):
            g = geometry[rank]
            left, right = _columns_touched(g, grid)
            touched = 0
            for column in range(left, right):
                low, high = _rows_in_column(g, column, grid.height)
                if low < high:
                    for row in range(low // TILE, (high - 1) // TILE + 1):
                        counts[block, row * grid.columns + column] += 1
                        touched += 1
            firsts[rank + 1] = touched


@kernel
def _accumulate(counts: Array, starts: Array, firsts: Array) -> None:
    """Running sums: starts, firsts, and counts[block, tile] <- where the block writes in the tile."""
    total = 0
    for tile in range(counts.shape[1]):
        starts[tile] = total
        for block in range(_BLOCKS):
            total, counts[block, tile] = total + counts[block, tile], total
    starts[counts.shape[1]] = total
    for rank in range(1, firsts.shape[0]):
        firsts[rank] += firsts[rank - 1]


@kernel
def _place(first: int, last: int, geometry: Array, grid: Grid, places: Array, tiles: Tiles) -> None:
    """The loop of `_count` again, now writing; within a tile ranks ascend, whoever runs which block."""
    share = (geometry.shape[0] + _BLOCKS - 1) // _BLOCKS
    for block in range(first, last):
        for rank in range(block * share, min(geometry.shape[0], (block + 1) * share)):
            g = geometry[rank]
            mine = tiles.firsts[rank]
            left, right = _columns_touched(g, grid)
            for column in range(left, right):
                low, high = _rows_in_column(g, column, grid.height)
                if low >= high:
                    continue
                for row in range(low // TILE, (high - 1) // TILE + 1):
                    tile = row * grid.columns + column
                    place = places[block, tile]
                    places[block, tile] = place + 1
                    tiles.ranks[place] = rank
                    tiles.rows[place] = pack_span(max(low - row * TILE, 0), min(high - row * TILE, TILE))
                    tiles.slots[mine] = place
                    mine += 1


def bin_tiles(geometry: Array, width: int, height: int, workers: Workers) -> Tiles:
    """(M, 8) geometry in depth order -> the intersections with the tiles of a width x height image."""
    columns, lines = -(-width // TILE), -(-height // TILE)
    grid = Grid(float(width), float(height), columns)
    counts = np.zeros((_BLOCKS, columns * lines), np.int64)
    starts = np.empty(columns * lines + 1, np.int64)
    firsts = np.zeros(len(geometry) + 1, np.int64)
    workers.run(_count, _BLOCKS, geometry, grid, counts, firsts)
    _accumulate(counts, starts, firsts)
    total = int(starts[-1])
    if total > _MOST:
        raise BackendError(
            f"{total} overlaps of Gaussians and tiles are too many for the CPU rasterizer: "
            "render a smaller image"
        )
    ranks, rows, slots = np.empty(total, np.int32), np.empty(total, np.uint16), np.empty(total, np.int32)
    tiles = Tiles(starts, ranks, rows, firsts, slots, columns)
    workers.run(_place, _BLOCKS, geometry, grid, counts, tiles)
    return tiles


@helper
def spread(index: int, count: int) -> int:
    """A permutation of range(count) whose every stretch samples the whole image evenly.

    Threads take contiguous pieces of a loop over tiles, and busy tiles lie together. The stride is near the
    golden section of `count` and prime to it.
    """
    stride = max(int(count * 0.6180339887), 1)
    while True:
        a, b = stride, count
        while b != 0:
            a, b = b, a % b
        if a == 1:
            return (index * stride) % count
        stride += 1
