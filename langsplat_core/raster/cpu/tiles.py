"""Tiles of 16x16 pixels and the Gaussians that touch each, front to back, for the CPU backend.

From top to bottom: the depth order, binning, a tile's own memory, and the walk over a tile that blending,
its adjoint and its gradients share.
"""

import math
from collections.abc import Callable
from itertools import count, pairwise
from typing import Any, NamedTuple

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import Workers, helper, kernel
from langsplat_core.config import RasterSettings
from langsplat_core.errors import BackendError
from langsplat_core.raster.cpu import lanes as ln
from langsplat_core.raster.cpu import projection as cp
from langsplat_core.raster.cpu.lanes import Lanes

TILE = 16
PIXELS = TILE * TILE
_SLACK = 1e-3  # px by which footprints are widened here; the blending kernels test alpha itself
_MOST = 2**31 - 1  # intersections of Gaussians and tiles in one view
_SPAN, _PLACE = 10, 24  # bits of a span of rows and of a tile's number, beside those of a rank
_DIGIT, _PASSES = 11, 3  # bits per pass of the radix sort, of 32
_LOWEST = (1 << _DIGIT) - 1  # mask of a digit
_MOVES = 4  # moves per depth after which the insertion sort is given up
_BLOCK = 256  # pairs of a Gaussian and a column of tiles whose rows are found together
_PIECES = 16  # pieces of the depth order that are binned in parallel; the result does not depend on it

Size = tuple[int, int]  # width and height of an image, px


class Tiles(NamedTuple):
    """I intersections of M drawn Gaussians (numbered front to back) with T tiles (row by row)."""

    geometry: Array  # (M, 8) float64 footprints, see `projection`
    starts: Array  # (T + 1,) int64: tile t owns intersections starts[t] to starts[t + 1]
    met: Array  # (I,) int64: Gaussian, tile and rows that the footprint touches there, see `_pack`
    firsts: Array  # (M + 1,) int64: Gaussian r has intersections slots[firsts[r] : firsts[r + 1]]
    slots: Array  # (I,) int32
    columns: int  # tiles per row of tiles
    # from a tile to the one that is blended next: spreads busy tiles, which lie together, over the threads
    stride: int
    width: int  # of the image, px
    height: int
    log2_alpha_min: float  # at least -100; with the next two the constants of steps 3 and 4 of `reference.py`
    alpha_max: float
    transmittance_min: float


@helper
def _pack(rank: int, tile: int, low: int, high: int) -> int:
    """Return an intersection, rows [low, high) of a tile, as a number; in a tile these ascend as ranks do."""
    return (rank << _PLACE | tile) << _SPAN | high << 5 | low


@kernel
def _sort_depths(rows: Array, depths: Array, middle: float, near: bool) -> tuple[Array, bool]:
    """Sort those of (M,) int32 ascending rows before `middle` (near), or else behind it, by depth, then row.

    Return them and False if the sort gave up, since very many depths are nearly equal. A radix sort by
    float32 depth, whose bits order as the numbers do (least significant digit first, each pass stable), is
    followed by an insertion sort of equal keys by float64 depth.
    """
    rows, depths = ln.borrowed((rows, depths))
    number, moves = 0, 0
    ends = np.zeros((_PASSES, 1 << _DIGIT), np.int64)
    pairs = np.empty((2, rows.shape[0] + 1), np.int64)  # keys, above 32 bits of row
    rounded = np.empty(1, np.float32)
    key = rounded.view(np.int32)
    for row in rows:
        rounded[0] = depths[row]
        pairs[0, number] = np.int64(key[0]) << 32 | row
        some = (depths[row] < middle) == near
        number += some
        for digit in range(_PASSES):
            ends[digit, key[0] >> _DIGIT * digit & _LOWEST] += some
    for digit in range(_PASSES):
        here, total = digit % 2, 0
        for value in range(1 << _DIGIT):
            total, ends[digit, value] = total + ends[digit, value], total
        for i in range(number):
            pair = pairs[here, i]
            value = pair >> 32 + _DIGIT * digit & _LOWEST
            place = ends[digit, value]
            ends[digit, value] = place + 1
            pairs[1 - here, place] = pair
    by_key, order = pairs[_PASSES % 2], np.empty(number, np.int32)
    for i in range(number):
        row, place = np.int32(by_key[i] & 0xFFFFFFFF), i
        if i > 0 and by_key[i] >> 32 == by_key[i - 1] >> 32:
            while place > 0 and depths[order[place - 1]] > depths[row] and moves <= _MOVES * number:
                order[place] = order[place - 1]
                place -= 1
                moves += 1
        order[place] = row
    return order, moves <= _MOVES * number


def depth_order(depths: Array, rows: Array, workers: Workers) -> Array:
    """Return (M,) int32 ascending rows sorted by their depths, (N,) positive float64, ties by row."""
    sample = np.sort(depths[rows[::512]])
    middle = sample[len(sample) // 2] if len(sample) else 0.0
    halves = workers.each(_sort_depths, [(rows, depths, middle, near) for near in (True, False)])
    if all(done for _, done in halves):
        return np.concatenate([order for order, _ in halves])
    return rows[np.argsort(depths[rows], kind="stable")]


@helper
def _columns_of(g: Array, width: int) -> tuple[int, int]:
    """Return columns of tiles [first, last) in which a footprint may meet a pixel centre."""
    left = min(max(g[cp.MEAN_X] - g[cp.HALF_WIDTH] + 0.5 - _SLACK, 0.0), float(width))
    right = min(max(g[cp.MEAN_X] + g[cp.HALF_WIDTH] + 0.5 + _SLACK, 0.0), float(width))
    return int(left) // TILE, (int(right) + TILE - 1) // TILE if int(left) < int(right) else 0


@helper
def _rows_in_columns(geometry: Array, pairs: Array, k: int, height: int, out: Array) -> None:
    """out[0 and 1, k : k + 8] <- pixel rows [first, last) in which each footprint meets its column of tiles.

    The footprints' ranks and the columns are pairs[:2, k : k + 8]. At abscissa dx an ellipse spans
    dy = slope dx +- bulge sqrt(half_width^2 - dx^2); its lowest point over a strip of columns is that of the
    whole ellipse or lies on the strip's border nearest to that point.
    """
    ranks = pairs[0]
    x, y = ln.gathered(geometry, ranks, k, cp.MEAN_X), ln.gathered(geometry, ranks, k, cp.MEAN_Y)
    a, c = ln.gathered(geometry, ranks, k, cp.FACTOR_A), ln.gathered(geometry, ranks, k, cp.FACTOR_C)
    skew, wide = ln.gathered(geometry, ranks, k, cp.FACTOR_K), ln.gathered(geometry, ranks, k, cp.HALF_WIDTH)
    peak = skew * ln.gathered(geometry, ranks, k, cp.HALF_HEIGHT)
    across = a / (a * a * skew * skew + c * c)
    slope, bulge = across * a * skew, across * c
    start = ln.gathered(out[0], pairs[2], k, 0) * TILE - x
    left, right = max(start + (0.5 - _SLACK), -wide), min(start + (TILE - 0.5 + _SLACK), wide)
    bottom, top = min(max(peak, left), right), min(max(-peak, left), right)
    high = y + slope * bottom + bulge * np.sqrt(max(wide * wide - bottom * bottom, 0.0))
    low = y + slope * top - bulge * np.sqrt(max(wide * wide - top * top, 0.0))
    ln.scatter(out[0], pairs[2], k, 0, min(max(low + (0.5 - _SLACK), 0.0), float(height)))
    ln.scatter(out[1], pairs[2], k, 0, min(max(high + (0.5 + _SLACK), 0.0), float(height)))


@helper
def grown(array: Array, used: int) -> Array:
    """Return an array twice as long whose first `used` entries are those of `array`."""
    longer = np.empty(2 * array.shape[0], array.dtype)
    longer[:used] = array[:used]
    return longer


@kernel
def _touch(
    first: int, last: int, order: Array, footprints: Array, size: Size, geometry: Array, firsts: Array
) -> tuple[Array, int, Array]:
    """Find the tiles that ranks [first, last) touch, in an image of `size` (width, height).

    geometry[rank] <- footprints[order[rank]], firsts[rank + 1] <- how many tiles ranks [first, rank] touch.
    Return pairs of numbers, one for each column of tiles that a Gaussian touches: its first tile there,
    packed, and its end, in rows from that tile's top; how many numbers these are; and how many Gaussians
    touch each tile.
    """
    order, footprints, geometry, firsts = ln.borrowed((order, footprints, geometry, firsts))
    width, height = size
    columns, lines_of_tiles = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    found = np.empty(2 * (3 * (last - first) + _BLOCK + columns), np.int64)
    counts = np.zeros((lines_of_tiles + 1) * columns, np.int64)  # differences from the tile above
    pairs, rows = np.zeros((3, _BLOCK + columns + 8), np.int64), np.zeros((2, _BLOCK + columns + 8))
    pairs[2], used = np.arange(pairs.shape[1]), 0
    begun, total = first, 0
    while first < last:
        number = 0
        while first < last and number < _BLOCK:
            ln.prefetch(footprints, np.int64(order[min(first + 2 * AHEAD, last - 1)]) * cp.COLUMNS)
            for n in range(cp.COLUMNS):
                geometry[first, n] = footprints[order[first], n]
            begin, end = _columns_of(geometry[first], width)
            for column in range(begin, end):
                pairs[0, number], pairs[1, number], rows[0, number] = first, column, column
                number += 1
            firsts[first + 1] = 0
            first += 1
        for k in range(0, number, 8):
            _rows_in_columns(geometry, pairs, k, height, rows)
        for k in range(number):
            rank, column = pairs[0, k], pairs[1, k]
            low, high = int(rows[0, k]), int(rows[1, k])
            line, some = low // TILE, low < high
            lines = (high + TILE - 1) // TILE - line if some else 0
            tile, top = line * columns + column, line * TILE
            found[used], found[used + 1] = _pack(rank, tile, low - top, 0), high - top
            counts[tile] += some
            counts[tile + lines * columns] -= some
            used += 2 * some
            firsts[rank + 1] += lines
        if used + 2 * (_BLOCK + columns) > found.shape[0]:
            found = grown(found, used)
    for tile in range(columns, lines_of_tiles * columns):
        counts[tile] += counts[tile - columns]
    for rank in range(begun, last):
        total += firsts[rank + 1]
        firsts[rank + 1] = total
    return found, used, counts


@kernel
def _place(first: int, last: int, found: tuple[Array, int], places: Array, start: int, tiles: Tiles) -> None:
    """Write the intersections that `_touch` found for ranks [first, last) into their tiles.

    A tile's intersections go to places[tile] and on: ranks ascend within a tile, in any order of pieces.
    start: index into `tiles.slots` of the piece's first intersection.
    """
    (touched, used), places, tiles = ln.borrowed((found, places, tiles))
    for rank in range(first, last):
        tiles.firsts[rank + 1] += start
    for n in range(0, used, 2):
        met, high = touched[n], touched[n + 1]
        tile = met >> _SPAN & (1 << _PLACE) - 1
        while high > 0:
            place = places[tile]
            places[tile] = place + 1
            tiles.met[place] = met | min(high, TILE) << 5
            tiles.slots[start] = place
            start, tile, high = start + 1, tile + tiles.columns, high - TILE
            met = (met & ~31) + (tiles.columns << _SPAN)


def bin_tiles(
    footprints: Array,
    order: Array,
    size: Size,
    settings: RasterSettings,
    workers: Workers,
    empty: Callable[[tuple[int, ...], Any], Array],
) -> Tiles:
    """Find the tiles of an image of `size` that footprints (N, 8) meet; order: (M,) the drawn by depth.

    `empty` makes arrays as `numpy.empty` does.
    """
    geometry, firsts = empty((len(order), cp.COLUMNS), np.float64), np.empty(len(order) + 1, np.int64)
    firsts[0] = 0
    pieces = list(pairwise(len(order) * i // _PIECES for i in range(_PIECES + 1)))
    shared = order, footprints, size, geometry, firsts
    found = workers.each(_touch, [(*piece, *shared) for piece in pieces])
    starts = np.cumsum([0, *(firsts[last] if first < last else 0 for first, last in pieces)])
    total = int(starts[-1])
    if max(total, 4 * len(order)) > _MOST:  # ranks have two bits less, see `_pack`
        raise BackendError(
            f"{total} overlaps of Gaussians and tiles are too many for the CPU rasterizer: "
            "render a smaller image"
        )
    # Where each piece writes in each tile: tile by tile, and in a tile piece by piece.
    columns = -(-size[0] // TILE)
    number = columns * -(-size[1] // TILE)
    counts = np.stack([counts[:number] for _, _, counts in found], 1)
    ends = np.cumsum(counts).reshape(counts.shape)
    places = np.ascontiguousarray((ends - counts).T)
    golden = max(int(number * 0.6180339887), 1)  # every stretch of tiles then samples the whole image evenly
    tiles = Tiles(
        geometry=geometry,
        starts=np.append(places[0], total),
        met=empty((total,), np.int64),
        firsts=firsts,
        slots=empty((total,), np.int32),
        columns=columns,
        stride=next(stride for stride in count(golden) if math.gcd(stride, number) == 1),
        width=size[0],
        height=size[1],
        log2_alpha_min=math.log2(max(settings.alpha_min, 2.0**-100)),
        alpha_max=float(settings.alpha_max),
        transmittance_min=float(settings.transmittance_min),
    )
    of_each = zip(pieces, found, places, starts, strict=False)  # behind the last start is the total
    workers.each(_place, [(*piece, done[:2], to, int(at), tiles) for piece, done, to, at in of_each])
    return tiles


# A tile's own memory: sixteen numbers per row and channel, `planes[(row, channel, column)]`, one flat array.
#
# Images are (H, W, C) with the channels of a pixel side by side; here each channel's row is one vector.


def padded(channels: int) -> int:
    """Return the planes of a tile for so many channels, which go in fours: a rest of 3 is padded to 4."""
    return channels + (channels % 4 == 3)


padded_inside = helper(padded)


@helper
def add_weighted(sums: Array, at: int, channels: int, weight: Lanes, x: Array) -> None:
    """sums[at + 16 channel : + 16] += weight x[channel]."""
    if channels == 3:  # a constant, for images: rows need no branches
        for channel in range(3):
            ln.store(sums, at + channel * TILE, ln.load(sums, at + channel * TILE) + weight * x[channel])
        return
    for channel in range(0, channels & ~3, 4):
        ln.store(sums, at, ln.load(sums, at) + weight * x[channel])
        ln.store(sums, at + TILE, ln.load(sums, at + TILE) + weight * x[channel + 1])
        ln.store(sums, at + 2 * TILE, ln.load(sums, at + 2 * TILE) + weight * x[channel + 2])
        ln.store(sums, at + 3 * TILE, ln.load(sums, at + 3 * TILE) + weight * x[channel + 3])
        at += 4 * TILE
    for channel in range(channels & ~3, channels):
        ln.store(sums, at, ln.load(sums, at) + weight * x[channel])
        at += TILE


@helper
def _copy_row(
    planes: Array, at: int, image: Array, x0: int, y: int, columns: int, channels: int, out: bool
) -> None:
    for channel in range(channels):
        for column in range(columns):
            if out:
                image[y, x0 + column, channel] = planes[at + channel * TILE + column]
            else:
                planes[at + channel * TILE + column] = image[y, x0 + column, channel]


@helper
def _copy_rows(planes: Array, image: Array, tile: int, columns: int, out: bool) -> None:
    x0, y0 = tile % columns * TILE, tile // columns * TILE
    height, width, channels = image.shape
    for row in range(min(TILE, height - y0)):
        at = row * padded_inside(channels) * TILE
        if x0 + TILE > width:
            _copy_row(planes, at, image, x0, y0 + row, width - x0, channels, out)
        elif channels == 3:  # with constants, whole rows are shuffled instead of copied one by one
            _copy_row(planes, at, image, x0, y0 + row, TILE, 3, out)
        else:
            _copy_row(planes, at, image, x0, y0 + row, TILE, channels, out)


@helper
def write_tile(planes: Array, image: Array, tile: int, tiles: Tiles) -> None:
    """Copy planes[(row, channel, column)] to a tile of the (H, W, C) image."""
    _copy_rows(planes, image, tile, tiles.columns, True)


@helper
def load_tile(planes: Array, image: Array, tile: int, tiles: Tiles) -> None:
    """planes[(row, channel, column)] <- a tile of the (H, W, C) image, 0 beyond its border."""
    planes[:] = 0
    _copy_rows(planes, image, tile, tiles.columns, False)


@helper
def correlate(
    planes: Array, lines: int, weights: Array, low: int, high: int, out: Array, s: int, column: int
) -> None:
    """out[s, column + line] <- sum over rows [low, high) of weights (stored from row `low`) times planes."""
    fours = lines & ~3
    for line in range(0, fours, 4):
        a = b = c = d = ln.lanes(np.float32(0))
        f = (low * lines + line) * TILE
        for row in range(high - low):
            weight = ln.load(weights, row * TILE)
            a = a + weight * ln.load(planes, f)
            b = b + weight * ln.load(planes, f + TILE)
            c = c + weight * ln.load(planes, f + 2 * TILE)
            d = d + weight * ln.load(planes, f + 3 * TILE)
            f += lines * TILE
        ln.store_totals(out, s * out.shape[1] + column + line, a, b, c, d)
    for line in range(fours, lines):
        a = ln.lanes(np.float32(0))
        for row in range(low, high):
            a = a + ln.load(weights, (row - low) * TILE) * ln.load(planes, (row * lines + line) * TILE)
        out[s, column + line] = ln.total(a)


# The walk over a tile that every operation shares: its Gaussians front to back, of each the rows it touches.
#
# What an operation does on the way is given as three helpers, compiled into the walk:
#
# open_(work, rank, later)                     before an intersection's rows: its Gaussian, one to prefetch
# row_(work, mine, s, row, low, alpha, before)  at each row, the first is `low`: its alpha, T before it
# close_(work, mine, s, low, high)             after rows [low, high)
#
# A row is sixteen lanes, without branches. A tile's state is one flat float32 array, sixteen numbers a row. A
# pixel's transmittance is stored negative once the pixel has stopped: its size stays readable, and
# `T - alpha T > transmittance_min` is then false for every later Gaussian.

AHEAD = 16  # intersections between prefetching a footprint and using it
CHECK_EVERY = 16  # Gaussians between two tests whether a tile still has running pixels


@helper
def tile_at(i: int, tiles: Tiles) -> int:
    """Return the i-th tile that is blended."""
    return (i * tiles.stride) % (tiles.starts.shape[0] - 1)


@helper
def start_tile(tile: int, tiles: Tiles) -> Array:
    """Return a tile's transmittance: 1 inside the image; pixels beyond its border have stopped already."""
    x0, y0 = tile % tiles.columns * TILE, tile // tiles.columns * TILE
    transmittance = np.empty(PIXELS, np.float32)
    for row in range(TILE):
        for column in range(TILE):
            inside = (x0 + column < tiles.width) & (y0 + row < tiles.height)
            transmittance[row * TILE + column] = 1.0 if inside else -1.0
    return transmittance


@helper
def running_rows(transmittance: Array, low: int, high: int) -> tuple[int, int]:
    """Shrink rows [low, high) to those that begin and end with a row that has a running pixel."""
    while low < high and ln.largest(ln.load(transmittance, low * TILE)) <= 0:
        low += 1
    while low < high and ln.largest(ln.load(transmittance, (high - 1) * TILE)) <= 0:
        high -= 1
    return low, high


@helper
def rows_to_blend(tiles: Tiles, s: int, top: int, bottom: int) -> tuple[int, int]:
    """Return the rows that intersection `s` touches, of the running rows [top, bottom)."""
    return max(tiles.met[s] & 31, top), min(tiles.met[s] >> 5 & 31, bottom)


@helper
def enter(tiles: Tiles, s: int, later: int) -> tuple[int, int]:
    """Return the Gaussians of intersections `s` and `later`, and prefetch the later one's footprint."""
    coming = tiles.met[later] >> _SPAN + _PLACE
    ln.prefetch(tiles.geometry, coming * cp.COLUMNS)
    return tiles.met[s] >> _SPAN + _PLACE, coming


@helper
def begin_rows(g: Array, x: float, y: float, rows: Array) -> Lanes:
    """Begin sixteen rows whose first pixel centre is (x, y): return the steps in w of a row's pixels.

    rows[:16] <- w of each row's first pixel (see `projection`), rows[16:32] <- log2 of its peak alpha,
    rows[32:] <- v. float64: across a long thin footprint w is the small difference of large numbers.
    """
    dy = y - g[cp.MEAN_Y]
    skew = g[cp.FACTOR_A] * g[cp.FACTOR_K]
    v = ln.ramp(g[cp.FACTOR_C] * dy, g[cp.FACTOR_C])
    ln.store(rows, 0, ln.ramp(g[cp.FACTOR_A] * (x - g[cp.MEAN_X]) - skew * dy, -skew))
    ln.store(rows, TILE, g[cp.LOG2_OPACITY] - v * v)
    ln.store(rows, 2 * TILE, v)
    return ln.ramp(0.0, g[cp.FACTOR_A])


@helper
def blend_row(transmittance: Array, at: int, w: Lanes, peak: float, tiles: Tiles) -> tuple[Lanes, Lanes]:
    """Step 3 and 4 for one row: returns alpha (0 where the Gaussian is not added) and T before it.

    peak: log2 of the row's peak alpha.
    All sixteen lanes are stored: a masked store would stall the next Gaussian's load of the same row.
    """
    before, power = ln.load(transmittance, at), peak - w * w
    alpha = ln.where_at_least(power, tiles.log2_alpha_min, min(ln.exp2(power), tiles.alpha_max), 0.0)
    after = before - alpha * before
    ln.store(transmittance, at, ln.where_at_least(tiles.transmittance_min, after, -abs(before), after))
    return ln.where_at_least(tiles.transmittance_min, after, 0.0, alpha), before


@helper
def walk(
    tile: int,
    tiles: Tiles,
    work: Any,
    open_: Callable[..., Any],
    row_: Callable[..., None],
    close_: Callable[..., None],
) -> tuple[Array, int]:
    """Blend the tile until no pixel runs; return its transmittance and the end of visited intersections."""
    x, y = tile % tiles.columns * TILE + 0.5, tile // tiles.columns * TILE + 0.5
    first, last = tiles.starts[tile], tiles.starts[tile + 1]
    transmittance, rows = start_tile(tile, tiles), np.empty(3 * TILE, np.float32)
    top, bottom = 0, TILE
    for s in range(first, last):
        if (s - first) % CHECK_EVERY == CHECK_EVERY - 1:
            top, bottom = running_rows(transmittance, top, bottom)
            if top >= bottom:
                return transmittance, s
        low, high = rows_to_blend(tiles, s, top, bottom)
        rank, later = enter(tiles, s, min(s + AHEAD, last - 1))
        mine = open_(work, rank, later)
        steps = begin_rows(tiles.geometry[rank], x, y + low, rows)
        for n in range(high - low):
            row, w, peak = low + n, steps + rows[n], rows[TILE + n]
            alpha, before = blend_row(transmittance, row * TILE, w, peak, tiles)
            row_(work, mine, s, row, low, alpha, before)
        close_(work, mine, s, low, high)
    return transmittance, last


@helper
def nothing_to_open(work: Any, rank: int, later: int) -> int:
    """`open_` of operations that keep nothing per intersection."""
    return 0


@helper
def nothing_to_close(work: Any, mine: Any, s: int, low: int, high: int) -> None:
    """`close_` of operations that are done with an intersection after its last row."""
