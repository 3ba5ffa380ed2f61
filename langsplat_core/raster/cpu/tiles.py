"""Tiles of 16x16 pixels and the Gaussians that touch each, front to back, for the CPU backend.

From top to bottom: the depth order, binning, a tile's own memory, and the walk over a tile that blending,
its adjoint and its gradients share.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import Workers, helper, kernel
from langsplat_core.config import RasterSettings
from langsplat_core.errors import BackendError
from langsplat_core.raster.cpu import projection as cp
from langsplat_core.raster.cpu.lanes import (
    Lanes,
    exp2,
    lanes,
    largest,
    load,
    load_four,
    load_three,
    prefetch,
    ramp,
    smaller,
    store,
    store_four,
    store_three,
    store_totals,
    total,
    where_at_least,
    where_greater,
)
from langsplat_core.raster.cpu.memory import Memory

TILE = 16
_SLACK = 1e-3  # px by which footprints are widened here; the blending kernels test alpha itself
_MOST = 2**31 - 1  # intersections of Gaussians and tiles in one view
_DIGIT, _PASSES = 11, 3  # bits per pass of the radix sort, of 32
_MOVES = 4  # for each depth, after which sorting by neighbours is given up
_FEW = 32  # tiles, too few to count more closely
_PIECES = 16  # of the depth order that are binned side by side; the result does not depend on it


# Of a footprint: centre, half width, abscissa of its lowest point, slope and bulge of `_rows_in_column`; px.
Ellipse = tuple[float, float, float, float, float, float]


class TileGrid(NamedTuple):
    """An image cut into tiles."""

    width: float  # px; a float, as it is compared with floats
    height: float
    columns: int  # tiles per row of tiles
    lines: int  # rows of tiles


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
    """Return the inverse of `pack_span`."""
    return packed & 255, packed >> 8


class Sorting(NamedTuple):
    """Memory for what is sorted."""

    keys: Array  # (2, M) uint32
    order: Array  # (2, M) int32 rows; the second one is the result
    depth_bits: Array  # (M,) uint64


@helper
def _fill_keys(status: Array, depth_bits: Array, out: Sorting, counts: Array) -> None:
    """keys[0], order[0] <- the 32 leading bits in which drawn depths differ, and their rows.

    Counts[digit, value] <- how often.
    """
    low, high = np.uint64(2**64 - 1), np.uint64(0)
    for i in range(status.shape[0]):
        if status[i] == cp.DRAWN:
            low, high = min(low, depth_bits[i]), max(high, depth_bits[i])
    shift = np.uint64(0)
    while low < high and (high - low) >> shift >= np.uint64(1 << 32):
        shift += np.uint64(1)
    n = 0
    for i in range(status.shape[0]):
        if status[i] == cp.DRAWN:
            key = np.uint32((depth_bits[i] - low) >> shift)
            out.keys[0, n], out.order[0, n] = key, i
            n += 1
            for digit in range(_PASSES):
                counts[digit, _digit_of(key, digit)] += 1


@helper
def _digit_of(key: Any, digit: int) -> Any:
    return (key >> np.uint32(_DIGIT * digit)) & np.uint32((1 << _DIGIT) - 1)


@kernel
def _depth_order(status: Array, depth_bits: Array, out: Sorting) -> bool:
    """(N,) status and depths reinterpreted as uint64 -> fills `out`, of the length of what is drawn.

    By depth, ties by index. False where it gave up, as very many depths are nearly equal.
    Positive floats order as their bits do. Sorted by their 32 leading bits that differ (radix, least
    significant digit first, each pass stable); then neighbours that are still in the wrong order change
    places.
    """
    ends = np.zeros((_PASSES, 1 << _DIGIT), np.int64)
    _fill_keys(status, depth_bits, out, ends)
    for digit in range(_PASSES):
        here, total = digit % 2, 0
        for value in range(1 << _DIGIT):
            total, ends[digit, value] = total + ends[digit, value], total
        for i in range(out.depth_bits.shape[0]):
            key = out.keys[here, i]
            value = _digit_of(key, digit)
            place = ends[digit, value]
            ends[digit, value] = place + 1
            out.keys[1 - here, place], out.order[1 - here, place] = key, out.order[here, i]
    order, ordered_bits, moves = out.order[_PASSES % 2], out.depth_bits, 0
    for i in range(order.shape[0]):
        row, bits, place = order[i], depth_bits[order[i]], i
        while place > 0 and ordered_bits[place - 1] > bits and moves <= _MOVES * order.shape[0]:
            order[place], ordered_bits[place] = order[place - 1], ordered_bits[place - 1]
            place -= 1
            moves += 1
        order[place], ordered_bits[place] = row, bits
    return moves <= _MOVES * order.shape[0]


def depth_order(status: Array, depths: Array, memory: Memory) -> tuple[Array, Array]:
    """(N,) status and positive depths -> (M,) int32 drawn rows, by depth, ties by index, and their depths."""
    count = int(np.count_nonzero(status == cp.DRAWN))
    keys, orders = memory.empty((2, count), np.uint32), memory.empty((2, count), np.int32)
    bits = memory.empty((count,), np.uint64)
    if _depth_order(status, depths.view(np.uint64), Sorting(keys, orders, bits)):
        return orders[_PASSES % 2], bits.view(np.float64)
    drawn = np.flatnonzero(status == cp.DRAWN)
    order = drawn[np.argsort(depths[drawn], kind="stable")].astype(np.int32)
    return order, depths[order]


@helper
def _span(centre: float, low: float, high: float, size: float) -> tuple[int, int]:
    """Pixels [first, last) of `size` whose centres lie in [centre + low, centre + high]."""
    first = min(max(np.ceil(centre + low - 0.5 - _SLACK), 0.0), size)
    last = min(max(np.floor(centre + high - 0.5 + _SLACK) + 1, 0.0), size)
    return int(first), int(last)


@helper
def _ellipse(g: Array) -> Ellipse:
    a, c, k = g[cp.FACTOR_A], g[cp.FACTOR_C], g[cp.FACTOR_K]
    across = a * a * k * k + c * c
    wide = g[cp.HALF_WIDTH]
    return g[cp.MEAN_X], g[cp.MEAN_Y], wide, k * g[cp.HALF_HEIGHT], a * a * k / across, a * c / across


@helper
def _rows_in_column(ellipse: Ellipse, column: int, height: float) -> tuple[int, int]:
    """Pixel rows [first, last) in which a footprint meets a column of tiles.

    At abscissa dx the ellipse spans dy = slope dx +- bulge sqrt(half_width^2 - dx^2); its lowest point over
    a strip of columns is the ellipse's own, or else on the strip's border nearest to that.
    """
    x, y, wide, peak, slope, bulge = ellipse
    left = max(column * TILE + 0.5 - _SLACK - x, -wide)
    right = min(column * TILE + TILE - 0.5 + _SLACK - x, wide)
    bottom, top = min(max(peak, left), right), min(max(-peak, left), right)
    high = slope * bottom + bulge * np.sqrt(max(wide * wide - bottom * bottom, 0.0))
    low = slope * top - bulge * np.sqrt(max(wide * wide - top * top, 0.0))
    return _span(y, low, high, height)


@helper
def _columns_touched(g: Array, grid: TileGrid) -> tuple[int, int]:
    first, last = _span(g[cp.MEAN_X], -g[cp.HALF_WIDTH], g[cp.HALF_WIDTH], grid.width)
    return first // TILE, (last + TILE - 1) // TILE if last > first else first // TILE


@helper
def _at_most(g: Array, grid: TileGrid) -> float:
    """Return a bound of the tiles that a footprint touches.

    Those of its box, or, for a needle, of the area within a tile's side of it (Steiner).
    """
    wide, high = 2 * g[cp.HALF_WIDTH] / TILE, 2 * g[cp.HALF_HEIGHT] / TILE
    box = min(float(grid.columns), wide + 2) * min(float(grid.lines), high + 2)  # in this order also of a NaN
    if box <= _FEW:
        return box
    a, c, k = g[cp.FACTOR_A], g[cp.FACTOR_C], g[cp.FACTOR_K]
    area = 0.25 * np.pi * wide * wide * a * c / (a * a * k * k + c * c)
    return min(box, area + 2 * (wide + high) + 5)


@kernel
def _touch(
    first: int, last: int, order: Array, footprints: Array, grid: TileGrid, geometry: Array, firsts: Array
) -> tuple[tuple[Array, Array, Array], int, Array]:
    """Find the tiles that ranks [first, last) touch.

    geometry[rank] <- footprints[order[rank]], firsts[rank + 1] <- how many tiles it touches. Returns the
    ranks, tiles and spans of rows of these intersections, their number, and how often each tile was touched.
    """
    most = 0.0
    for rank in range(first, last):
        prefetch(footprints, np.int64(order[min(rank + 2 * AHEAD, last - 1)]) * cp.COLUMNS)
        for n in range(cp.COLUMNS):
            geometry[rank, n] = footprints[order[rank], n]
        most += _at_most(geometry[rank], grid)
    room = int(most) + 3  # two places are always written
    touched = np.empty(room, np.int32), np.empty(room, np.int32), np.empty(room, np.uint16)
    ranks, where, spans = touched
    counts = np.zeros((grid.lines + 2) * grid.columns, np.int64)  # the last two lines: the same
    used = 0
    for rank in range(first, last):
        g, before = geometry[rank], used
        left, right = _columns_touched(g, grid)
        ellipse = _ellipse(g)
        for column in range(left, right):
            low, high = _rows_in_column(ellipse, column, grid.height)
            line = low // TILE
            lines = (high + TILE - 1) // TILE - line if low < high else 0
            tile, top = line * grid.columns + column, line * TILE
            # Most columns have one tile or two: writing two always, without a branch to foretell, is faster.
            ranks[used], ranks[used + 1] = rank, rank
            where[used], where[used + 1] = tile, tile + grid.columns
            spans[used] = pack_span(low - top, min(high - top, TILE))
            spans[used + 1] = pack_span(0, min(high - top - TILE, TILE))
            counts[tile] += lines >= 1
            counts[tile + grid.columns] += lines >= 2
            for n in range(2, lines):
                ranks[used + n], where[used + n] = rank, tile + n * grid.columns
                spans[used + n] = pack_span(0, min(high - top - n * TILE, TILE))
                counts[tile + n * grid.columns] += 1
            used += lines
        firsts[rank + 1] = used - before
    return touched, used, counts


@kernel
def _place(
    first: int, last: int, touched: tuple[Array, Array, Array], places: Array, start: int, tiles: Tiles
) -> None:
    """Write intersections [first, last) that `_touch` found into their tiles.

    Those of a tile go to places[tile] and on: within a tile ranks ascend, whoever runs which piece. They are
    the view's from `start` on.
    """
    ranks, where, spans = touched
    for n in range(first, last):
        tile = where[n]
        place = places[tile]
        places[tile] = place + 1
        tiles.ranks[place], tiles.rows[place] = ranks[n], spans[n]
        tiles.slots[start + n] = place


def bin_tiles(
    footprints: Array, order: Array, size: tuple[int, int], workers: Workers, memory: Memory
) -> tuple[Array, Tiles]:
    """(N, 8) footprints, (M,) the drawn ones in depth order -> (M, 8) geometry in that order, and the tiles.

    size: width and height of the image.
    """
    geometry = memory.empty((len(order), cp.COLUMNS), np.float64)
    width, height = size
    grid = TileGrid(float(width), float(height), -(-width // TILE), -(-height // TILE))
    firsts = memory.empty((len(order) + 1,), np.int64)
    firsts[0] = 0
    edges = [len(order) * i // _PIECES for i in range(_PIECES + 1)]
    pieces = list(pairwise(edges))
    shared = order, footprints, grid, geometry, firsts
    found = workers.each(_touch, [(*piece, *shared) for piece in pieces])
    np.cumsum(firsts, out=firsts)
    total = int(firsts[-1])
    if total > _MOST:
        raise BackendError(
            f"{total} overlaps of Gaussians and tiles are too many for the CPU rasterizer: "
            "render a smaller image"
        )
    # Where each piece writes in each tile: tile by tile, and in a tile piece by piece.
    counts = np.stack([counts[: grid.columns * grid.lines] for _, _, counts in found], 1)
    ends = np.cumsum(counts).reshape(counts.shape)
    places = np.ascontiguousarray((ends - counts).T)
    starts = np.append(places[0], total)
    ranks, rows, slots = (memory.empty((total,), kind) for kind in (np.int32, np.uint16, np.int32))
    tiles = Tiles(starts, ranks, rows, firsts, slots, grid.columns)
    calls = []
    for (first, _), (touched, used, _), places_of_it in zip(pieces, found, places, strict=True):
        calls.append((0, used, touched, places_of_it, int(firsts[first]), tiles))
    workers.each(_place, calls)
    return geometry, tiles


@helper
def spread(index: int, count: int) -> int:
    """Return a permutation of range(count) whose every stretch samples the whole image evenly.

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


# A tile's own memory: sixteen numbers per row and channel, `planes[(row, channel, column)]`, one flat array.
#
# Images are (H, W, C) with the channels of a pixel side by side; here each channel's row is one vector.


def padded(channels: int) -> int:
    """Lines of a tile's planes for so many channels, which go in fours: three have room for a fourth."""
    return channels + (channels % 4 == 3)


padded_inside = helper(padded)


@helper
def add_weighted(sums: Array, at: int, channels: int, weight: Lanes, x: Array) -> None:
    """sums[at + 16 channel : + 16] += weight x[channel]."""
    for channel in range(0, channels & ~3, 4):
        store(sums, at, load(sums, at) + weight * x[channel])
        store(sums, at + TILE, load(sums, at + TILE) + weight * x[channel + 1])
        store(sums, at + 2 * TILE, load(sums, at + 2 * TILE) + weight * x[channel + 2])
        store(sums, at + 3 * TILE, load(sums, at + 3 * TILE) + weight * x[channel + 3])
        at += 4 * TILE
    for channel in range(channels & ~3, channels):
        store(sums, at, load(sums, at) + weight * x[channel])
        at += TILE


@helper
def write_tile(planes: Array, image: Array, tile: int, columns: int) -> None:
    """Copy planes[(row, channel, column)] to tile `tile` (`columns` to a row) of the (H, W, C) image."""
    x0, y0 = tile % columns * TILE, tile // columns * TILE
    height, width, channels = image.shape
    lines = padded_inside(channels)
    fours = channels & ~3 if x0 + TILE <= width else 0
    for row in range(min(TILE, height - y0)):
        first, at = row * lines * TILE, ((y0 + row) * width + x0) * channels
        if channels == 1 and x0 + TILE <= width:
            store(image, at, load(planes, first))
            continue
        if channels == 3 and x0 + TILE <= width:
            a, b, c = load(planes, first), load(planes, first + TILE), load(planes, first + 2 * TILE)
            store_three(image, at, a, b, c)
            continue
        for channel in range(0, fours, 4):
            f = first + channel * TILE
            a, b, c, d = (
                load(planes, f),
                load(planes, f + TILE),
                load(planes, f + 2 * TILE),
                load(planes, f + 3 * TILE),
            )
            store_four(image, at + channel, channels, a, b, c, d)
        for column in range(min(TILE, width - x0)):
            for channel in range(fours, channels):
                image[y0 + row, x0 + column, channel] = planes[first + channel * TILE + column]


@helper
def load_tile(planes: Array, image: Array, tile: int, columns: int) -> None:
    """planes[(row, channel, column)] <- that tile (of `columns` in a row of tiles) of (H, W, C) image.

    0 beyond its border and in the fourth channel of three.
    """
    x0, y0 = tile % columns * TILE, tile // columns * TILE
    height, width, channels = image.shape
    lines = padded_inside(channels)
    planes[:] = 0
    fours = channels & ~3 if x0 + TILE <= width else 0
    for row in range(min(TILE, height - y0)):
        first, at = row * lines * TILE, ((y0 + row) * width + x0) * channels
        if channels == 3 and x0 + TILE <= width:
            p, q, r = load_three(image, at)
            store(planes, first, p)
            store(planes, first + TILE, q)
            store(planes, first + 2 * TILE, r)
            continue
        for channel in range(0, fours, 4):
            a, b, c, d = load_four(image, at + channel, channels)
            f = first + channel * TILE
            store(planes, f, a)
            store(planes, f + TILE, b)
            store(planes, f + 2 * TILE, c)
            store(planes, f + 3 * TILE, d)
        for column in range(min(TILE, width - x0)):
            for channel in range(fours, channels):
                planes[first + channel * TILE + column] = image[y0 + row, x0 + column, channel]


@helper
def correlate(
    planes: Array, lines: int, weights: Array, low: int, high: int, out: Array, s: int, column: int
) -> None:
    """out[s, column + line] <- sum over rows [low, high) of weights (stored from row `low`) times planes."""
    fours = lines & ~3
    for line in range(0, fours, 4):
        a = b = c = d = lanes(np.float32(0))
        f = (low * lines + line) * TILE
        for row in range(high - low):
            weight = load(weights, row * TILE)
            a = a + weight * load(planes, f)
            b = b + weight * load(planes, f + TILE)
            c = c + weight * load(planes, f + 2 * TILE)
            d = d + weight * load(planes, f + 3 * TILE)
            f += lines * TILE
        store_totals(out, s * out.shape[1] + column + line, a, b, c, d)
    for line in range(fours, lines):
        a = lanes(np.float32(0))
        for row in range(low, high):
            a = a + load(weights, (row - low) * TILE) * load(planes, (row * lines + line) * TILE)
        out[s, column + line] = total(a)


# The walk over a tile that every operation shares: its Gaussians front to back, of each the rows it touches.
#
# What an operation does on the way is given as three helpers, compiled into the walk:
#
# open_(work, s, later)          before the rows of intersection s; its result is handed to the next two
# row_(work, mine, s, at, low, added, before) at a row `at` of rows from `low`: alpha (0 where not added)
# and T before it close_(work, mine, s, low, high)  after rows [low, high)
#
# A row is sixteen lanes, without branches. A tile's state is one flat float32 array, sixteen numbers a row. A
# pixel's transmittance is stored negative once the pixel has stopped: its size stays readable, and
# `T - alpha T > transmittance_min` is then false for every later Gaussian.

AHEAD = 8  # intersections between asking for a footprint and using it
CHECK_EVERY = 16  # Gaussians between two looks at whether a tile still has running pixels
PIXELS = TILE * TILE


class Cutoffs(NamedTuple):
    """The constants of step 3 and 4 of `reference.py`."""

    alpha_min: float
    alpha_max: float
    transmittance_min: float


def make_cutoffs(settings: RasterSettings) -> Cutoffs:
    """Return the settings as kernels take them."""
    return Cutoffs(float(settings.alpha_min), float(settings.alpha_max), float(settings.transmittance_min))


@helper
def start_tile(tile: int, tiles: Tiles, width: int, height: int) -> Array:
    """Return a tile's transmittance: 1 inside the image; pixels beyond its border have stopped already."""
    x0, y0 = tile % tiles.columns * TILE, tile // tiles.columns * TILE
    transmittance = np.empty(PIXELS, np.float32)
    for row in range(TILE):
        for column in range(TILE):
            inside = (x0 + column < width) & (y0 + row < height)
            transmittance[row * TILE + column] = 1.0 if inside else -1.0
    return transmittance


@helper
def running_rows(transmittance: Array, low: int, high: int) -> tuple[int, int]:
    """Shrink rows [low, high) to those that begin and end with a row that has a running pixel."""
    while low < high and largest(load(transmittance, low * TILE)) <= 0:
        low += 1
    while low < high and largest(load(transmittance, (high - 1) * TILE)) <= 0:
        high -= 1
    return low, high


@helper
def rows_to_blend(packed: int, top: int, bottom: int) -> tuple[int, int]:
    """Return the rows of a packed span that are within the running rows [top, bottom)."""
    low, high = unpack_span(packed)
    return max(low, top), min(high, bottom)


@helper
def enter(geometry: Array, tiles: Tiles, s: int, later: int) -> Array:
    """Return the footprint of intersection `s`; that of `later` is asked for, as memory is far away."""
    prefetch(geometry, np.int64(tiles.ranks[later]) * cp.COLUMNS)
    return geometry[tiles.ranks[s]]


@helper
def begin_rows(g: Array, x: float, y: float) -> tuple[Lanes, float, float, float, float, float]:
    """For rows whose first pixel centre is (x, y): of sixteen pixels the steps in w (see `projection`).

    The log2 of the peak alpha; w and v at (x, y), and what a step of one row adds to them.

    float64: across a long thin footprint w is the small difference of large numbers.
    """
    dy = y - g[cp.MEAN_Y]
    skew = g[cp.FACTOR_A] * g[cp.FACTOR_K]
    w, v = g[cp.FACTOR_A] * (x - g[cp.MEAN_X]) - skew * dy, g[cp.FACTOR_C] * dy
    return ramp() * g[cp.FACTOR_A], g[cp.LOG2_OPACITY], w, v, -skew, g[cp.FACTOR_C]


@helper
def blend_row(
    transmittance: Array, at: int, w: Lanes, log2_height: float, cutoffs: Cutoffs
) -> tuple[Lanes, Lanes]:
    """Step 3 and 4 for one row: returns alpha (0 where the Gaussian is not added) and T before it.

    All sixteen lanes are stored: a masked store would stall the next Gaussian's load of the same row.
    """
    before = load(transmittance, at)
    alpha = smaller(exp2(log2_height - w * w), cutoffs.alpha_max)
    alpha = where_at_least(alpha, cutoffs.alpha_min, alpha, 0.0)
    after = before - alpha * before
    stopped = smaller(before, 0.0 - before)
    store(transmittance, at, where_greater(after, cutoffs.transmittance_min, after, stopped))
    return where_greater(after, cutoffs.transmittance_min, alpha, 0.0), before


@helper
def walk(
    tile: int,
    tiles: Tiles,
    geometry: Array,
    cutoffs: Cutoffs,
    transmittance: Array,
    work: Any,
    open_: Callable[..., Any],
    row_: Callable[..., None],
    close_: Callable[..., None],
) -> int:
    """Blend the tile, changing its `transmittance`.

    Returns the end of the intersections visited, which comes early where no pixel runs any more.
    """
    x, y = tile % tiles.columns * TILE + 0.5, tile // tiles.columns * TILE + 0.5
    first, last = tiles.starts[tile], tiles.starts[tile + 1]
    top, bottom = 0, TILE
    for s in range(first, last):
        if (s - first) % CHECK_EVERY == CHECK_EVERY - 1:
            top, bottom = running_rows(transmittance, top, bottom)
            if top >= bottom:
                return s
        low, high = rows_to_blend(tiles.rows[s], top, bottom)
        later = min(s + AHEAD, last - 1)
        g = enter(geometry, tiles, s, later)
        mine = open_(work, s, later)
        step, peak, w, v, w_step, v_step = begin_rows(g, x, y + low)
        for row in range(low, high):
            added, before = blend_row(transmittance, row * TILE, step + w, peak - v * v, cutoffs)
            w, v = w + w_step, v + v_step
            row_(work, mine, s, row, low, added, before)
        close_(work, mine, s, low, high)
    return last


@helper
def nothing_to_open(work: Any, s: int, later: int) -> int:
    """For operations that keep nothing per intersection."""
    return 0


@helper
def nothing_to_close(work: Any, mine: Any, s: int, low: int, high: int) -> None:
    """For operations that are done with an intersection after its last row."""
