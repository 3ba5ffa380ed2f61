"""Frozen geometry: the blending weights W of one CPU view, kept, so that `splat` and `gather` need no
exponential and no transmittance again.

A weight is kept as sixteen bits of fixed point, a row of a tile as sixteen of them: W is off by at most
1 / 131070 in every entry, and `gather` is still the exact adjoint of `splat`.
"""

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.raster import cpu_project as cp
from langsplat_core.raster.cpu_blend import (
    AHEAD,
    CHECK_EVERY,
    Cutoffs,
    blend_row,
    enter,
    row_offsets,
    rows_to_blend,
    running_rows,
    start_tile,
)
from langsplat_core.raster.cpu_planes import PIXELS, add_weighted, correlate, load_tile, write_tile
from langsplat_core.raster.cpu_tiles import TILE, Tiles, spread
from langsplat_core.raster.lanes import largest, ramp
from langsplat_core.raster.lanes_memory import UNIT, load_units, prefetch, store, store_units
from langsplat_core.raster.workers import helper, kernel

VISIBLE = 0.5 / UNIT  # weights below round to 0


@helper
def _walk_tile(
    tile: int,
    tiles: Tiles,
    geometry: Array,
    cutoffs: Cutoffs,
    spans: Array,
    firsts: Array,
    weights: Array,
    alpha: Array,
) -> None:
    """Blend once. Without `firsts` (empty): spans[s] <- rows that have a weight, packed as `Tiles.rows`. With
    them: fill the weights of those rows, and alpha."""
    height, width, _ = alpha.shape
    x0, y0 = tile % tiles.columns * TILE, tile // tiles.columns * TILE
    state = np.empty(PIXELS, np.float32)
    start_tile(state, x0, y0, width, height)
    first, last = tiles.starts[tile], tiles.starts[tile + 1]
    top, bottom = 0, TILE
    for s in range(first, last):
        if (s - first) % CHECK_EVERY == CHECK_EVERY - 1:
            top, bottom = running_rows(state, top, bottom)
            if top >= bottom:
                break
        low, high = rows_to_blend(tiles.rows[s], top, bottom)
        g = enter(geometry, tiles, s, min(s + AHEAD, last - 1))
        step, peak = ramp() * g[cp.FACTOR_A], g[cp.LOG2_OPACITY]
        w, v, w_step, v_step = row_offsets(g, x0 + 0.5, y0 + low + 0.5)
        seen_first, seen_last = TILE, 0
        kept_first, kept_last = int(spans[s]) & 255, int(spans[s]) >> 8
        for row in range(low, high):
            added, before = blend_row(state, row * TILE, step + w, peak - v * v, cutoffs)
            w, v = w + w_step, v + v_step
            weight = added * before
            if firsts.shape[0] > 0:
                if kept_first <= row < kept_last:
                    store_units(weights, (firsts[s] + row - kept_first) * TILE, weight)
            elif largest(weight) >= VISIBLE:
                seen_first, seen_last = min(seen_first, row), row + 1
        if firsts.shape[0] == 0 and seen_last > 0:
            spans[s] = seen_first + 256 * seen_last
    if firsts.shape[0] > 0:
        for n in range(PIXELS):
            state[n] = np.float32(1) - abs(state[n])
        write_tile(state, alpha, x0, y0)


@kernel
def walk(
    first: int,
    last: int,
    tiles: Tiles,
    geometry: Array,
    cutoffs: Cutoffs,
    spans: Array,
    firsts: Array,
    weights: Array,
    alpha: Array,
) -> None:
    """First with empty `firsts` and `weights`, to find (I,) uint16 spans; then to fill (R, 16) uint16
    weights, those of intersection s from row firsts[s] on, and (H, W, 1) alpha."""
    count = tiles.starts.shape[0] - 1
    for i in range(first, last):
        _walk_tile(spread(i, count), tiles, geometry, cutoffs, spans, firsts, weights, alpha)


@kernel
def splat(
    first: int, last: int, tiles: Tiles, firsts: Array, weights: Array, values: Array, image: Array
) -> None:
    """(M, padded(C)) values in depth order -> fills (H, W, C) image; `tiles.rows` are the spans of `walk`."""
    count, lines = tiles.starts.shape[0] - 1, values.shape[1]
    sums = np.empty(PIXELS * lines, np.float32)
    for i in range(first, last):
        tile = spread(i, count)
        sums[:] = 0
        end = tiles.starts[tile + 1]
        for s in range(tiles.starts[tile], end):
            low, high = rows_to_blend(tiles.rows[s], 0, TILE)
            prefetch(values, np.int64(tiles.ranks[min(s + AHEAD, end - 1)]) * lines)
            x = values[tiles.ranks[s]]
            at = firsts[s] * TILE
            for row in range(low, high):
                add_weighted(sums, row * lines * TILE, lines, load_units(weights, at), x)
                at += TILE
        write_tile(sums, image, tile % tiles.columns * TILE, tile // tiles.columns * TILE)


@kernel
def gather(
    first: int, last: int, tiles: Tiles, firsts: Array, weights: Array, image: Array, partial: Array
) -> None:
    """(H, W, C) image -> fills (I, padded(C)) partial sums of ``W^T y``."""
    count, lines = tiles.starts.shape[0] - 1, partial.shape[1]
    planes, buffer = np.empty(PIXELS * lines, np.float32), np.empty(PIXELS, np.float32)
    for i in range(first, last):
        tile = spread(i, count)
        load_tile(planes, image, tile % tiles.columns * TILE, tile // tiles.columns * TILE)
        for s in range(tiles.starts[tile], tiles.starts[tile + 1]):
            low, high = rows_to_blend(tiles.rows[s], 0, TILE)
            for row in range(high - low):
                store(buffer, row * TILE, load_units(weights, (firsts[s] + row) * TILE))
            correlate(planes, lines, buffer, low, high, partial, s, 0)
