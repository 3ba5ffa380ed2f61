"""Blending on the CPU: ``W x``, ``W^T y`` and the depth of half transmittance, tile by tile.

Each tile walks its Gaussians front to back; each Gaussian walks the rows it touches; a row is sixteen
lanes, without branches. A tile's state is one flat float32 array, sixteen numbers per row and plane.

A pixel's transmittance is stored negative once the pixel has stopped: its size stays readable, and
`T - alpha T > transmittance_min` is then false for every later Gaussian.
"""

from typing import NamedTuple

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import RasterSettings
from langsplat_core.raster import cpu_project as cp
from langsplat_core.raster.cpu_planes import PIXELS, add_weighted, correlate, load_tile, write_tile
from langsplat_core.raster.cpu_tiles import TILE, Tiles, spread
from langsplat_core.raster.lanes import (
    Lanes,
    exp2,
    lanes,
    largest,
    ramp,
    smaller,
    where_at_least,
    where_greater,
)
from langsplat_core.raster.lanes_memory import load, prefetch, store
from langsplat_core.raster.workers import helper, kernel

AHEAD = 8  # intersections between asking for a footprint and using it
CHECK_EVERY = 16  # Gaussians between two looks at whether a tile still has running pixels


class Cutoffs(NamedTuple):
    """The constants of step 3 and 4 of `reference.py`."""

    alpha_min: float
    alpha_max: float
    transmittance_min: float


def make_cutoffs(settings: RasterSettings) -> Cutoffs:
    return Cutoffs(float(settings.alpha_min), float(settings.alpha_max), float(settings.transmittance_min))


@helper
def start_tile(transmittance: Array, x0: int, y0: int, width: int, height: int) -> None:
    """Transmittance 1 inside the image; pixels of the tile beyond its border have stopped already."""
    for row in range(TILE):
        for column in range(TILE):
            inside = (x0 + column < width) & (y0 + row < height)
            transmittance[row * TILE + column] = 1.0 if inside else -1.0


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
    """`Tiles.rows` of an intersection, within the running rows [top, bottom)."""
    return max(packed & 255, top), min(packed >> 8, bottom)


@helper
def enter(geometry: Array, tiles: Tiles, s: int, later: int) -> Array:
    """The footprint of intersection `s`; that of `later` is asked for, as memory is far away."""
    prefetch(geometry, np.int64(tiles.ranks[later]) * cp.COLUMNS)
    return geometry[tiles.ranks[s]]


@helper
def row_offsets(g: Array, x: float, y: float) -> tuple[float, float, float, float]:
    """w and v (see `cpu_project`) at the pixel centre (x, y), and what a step of one row adds to them.

    float64: across a long thin footprint w is the small difference of large numbers.
    """
    dy = y - g[cp.MEAN_Y]
    skew = g[cp.FACTOR_A] * g[cp.FACTOR_K]
    return g[cp.FACTOR_A] * (x - g[cp.MEAN_X]) - skew * dy, g[cp.FACTOR_C] * dy, -skew, g[cp.FACTOR_C]


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
def _splat_tile(
    tile: int, tiles: Tiles, geometry: Array, values: Array, cutoffs: Cutoffs, image: Array, alpha: Array
) -> None:
    height, width, _ = image.shape
    lines = values.shape[1]
    x0, y0 = tile % tiles.columns * TILE, tile // tiles.columns * TILE
    transmittance = np.empty(PIXELS, np.float32)
    start_tile(transmittance, x0, y0, width, height)
    sums = np.empty(PIXELS * lines, np.float32)
    sums[:] = 0
    first, last = tiles.starts[tile], tiles.starts[tile + 1]
    top, bottom = 0, TILE
    for s in range(first, last):
        if (s - first) % CHECK_EVERY == CHECK_EVERY - 1:
            top, bottom = running_rows(transmittance, top, bottom)
            if top >= bottom:
                break
        low, high = rows_to_blend(tiles.rows[s], top, bottom)
        later = min(s + AHEAD, last - 1)
        g = enter(geometry, tiles, s, later)
        prefetch(values, np.int64(tiles.ranks[later]) * lines)
        prefetch(values, np.int64(tiles.ranks[later]) * lines + lines - 1)
        x = values[tiles.ranks[s]]
        step, peak = ramp() * g[cp.FACTOR_A], g[cp.LOG2_OPACITY]
        w, v, w_step, v_step = row_offsets(g, x0 + 0.5, y0 + low + 0.5)
        for row in range(low, high):
            added, before = blend_row(transmittance, row * TILE, step + w, peak - v * v, cutoffs)
            w, v = w + w_step, v + v_step
            add_weighted(sums, row * lines * TILE, lines, added * before, x)
    write_tile(sums, image, x0, y0)
    for n in range(PIXELS):
        transmittance[n] = np.float32(1) - abs(transmittance[n])
    write_tile(transmittance, alpha, x0, y0)


@kernel
def splat(
    first: int,
    last: int,
    tiles: Tiles,
    geometry: Array,
    values: Array,
    cutoffs: Cutoffs,
    image: Array,
    alpha: Array,
) -> None:
    """(M, padded(C)) values in depth order -> fills (H, W, C) image and (H, W, 1) alpha, all float32."""
    count = tiles.starts.shape[0] - 1
    for i in range(first, last):
        _splat_tile(spread(i, count), tiles, geometry, values, cutoffs, image, alpha)


@helper
def _gather_tile(
    tile: int, tiles: Tiles, geometry: Array, image: Array, cutoffs: Cutoffs, partial: Array
) -> None:
    height, width, _ = image.shape
    lines = partial.shape[1]
    x0, y0 = tile % tiles.columns * TILE, tile // tiles.columns * TILE
    transmittance = np.empty(PIXELS, np.float32)
    start_tile(transmittance, x0, y0, width, height)
    planes = np.empty(PIXELS * lines, np.float32)
    load_tile(planes, image, x0, y0)
    weights = np.empty(PIXELS, np.float32)
    first, last = tiles.starts[tile], tiles.starts[tile + 1]
    top, bottom = 0, TILE
    for s in range(first, last):
        if (s - first) % CHECK_EVERY == CHECK_EVERY - 1:
            top, bottom = running_rows(transmittance, top, bottom)
            if top >= bottom:
                partial[s:last] = 0
                break
        low, high = rows_to_blend(tiles.rows[s], top, bottom)
        g = enter(geometry, tiles, s, min(s + AHEAD, last - 1))
        step, peak = ramp() * g[cp.FACTOR_A], g[cp.LOG2_OPACITY]
        w, v, w_step, v_step = row_offsets(g, x0 + 0.5, y0 + low + 0.5)
        for row in range(low, high):
            added, before = blend_row(transmittance, row * TILE, step + w, peak - v * v, cutoffs)
            w, v = w + w_step, v + v_step
            store(weights, (row - low) * TILE, added * before)
        correlate(planes, lines, weights, low, high, partial, s, 0)


@kernel
def gather(
    first: int, last: int, tiles: Tiles, geometry: Array, image: Array, cutoffs: Cutoffs, partial: Array
) -> None:
    """(H, W, C) float32 image -> fills (I, padded(C)) partial sums of ``W^T y``, a row per intersection."""
    count = tiles.starts.shape[0] - 1
    for i in range(first, last):
        _gather_tile(spread(i, count), tiles, geometry, image, cutoffs, partial)


@kernel
def sum_partials(first: int, last: int, tiles: Tiles, order: Array, partial: Array, out: Array) -> None:
    """out[order[rank]] <- sum of the rank's partial sums, in the order of its tiles (so: reproducible)."""
    sums = np.empty(out.shape[1])
    end = tiles.slots.shape[0] - 1
    for rank in range(first, last):
        sums[:] = 0
        for n in range(tiles.firsts[rank], tiles.firsts[rank + 1]):
            prefetch(partial, np.int64(tiles.slots[min(n + 2 * AHEAD, end)]) * partial.shape[1])
            for channel in range(out.shape[1]):
                sums[channel] += partial[tiles.slots[n], channel]
        for channel in range(out.shape[1]):
            out[order[rank], channel] = sums[channel]


@helper
def _median_tile(
    tile: int, tiles: Tiles, geometry: Array, depths: Array, cutoffs: Cutoffs, out: Array
) -> None:
    height, width, _ = out.shape
    x0, y0 = tile % tiles.columns * TILE, tile // tiles.columns * TILE
    transmittance = np.empty(PIXELS, np.float32)
    start_tile(transmittance, x0, y0, width, height)
    found = np.empty(PIXELS, np.float32)
    found[:] = 0
    half = np.float32(0.5)
    first, last = tiles.starts[tile], tiles.starts[tile + 1]
    for s in range(first, last):
        rank = tiles.ranks[s]
        low, high = rows_to_blend(tiles.rows[s], 0, TILE)
        g = enter(geometry, tiles, s, min(s + AHEAD, last - 1))
        step, peak = ramp() * g[cp.FACTOR_A], g[cp.LOG2_OPACITY]
        w, v, w_step, v_step = row_offsets(g, x0 + 0.5, y0 + low + 0.5)
        for row in range(low, high):
            at = row * TILE
            added, before = blend_row(transmittance, at, step + w, peak - v * v, cutoffs)
            w, v = w + w_step, v + v_step
            passed = where_greater(before, half, lanes(np.float32(depths[rank])), load(found, at))
            after = before - added * before
            store(found, at, where_at_least(half, after, passed, load(found, at)))
    write_tile(found, out, x0, y0)


@kernel
def median_depth(
    first: int, last: int, tiles: Tiles, geometry: Array, depths: Array, cutoffs: Cutoffs, out: Array
) -> None:
    """(M,) depths in depth order -> (H, W, 1) depth of the Gaussian that takes T to 0.5 or below, else 0."""
    count = tiles.starts.shape[0] - 1
    for i in range(first, last):
        _median_tile(spread(i, count), tiles, geometry, depths, cutoffs, out)
