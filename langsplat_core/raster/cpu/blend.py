"""Blending on the CPU: ``W x``, ``W^T y`` and the depth of half transmittance, tile by tile (see `walk`)."""

from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import helper, kernel
from langsplat_core.raster.cpu.lanes import Lanes, lanes, where_at_least, where_greater
from langsplat_core.raster.cpu.lanes_memory import load, prefetch, store
from langsplat_core.raster.cpu.planes import add_weighted, correlate, load_tile, write_tile
from langsplat_core.raster.cpu.tiles import TILE, Tiles, spread
from langsplat_core.raster.cpu.walk import (
    AHEAD,
    PIXELS,
    Cutoffs,
    nothing_to_close,
    nothing_to_open,
    start_tile,
    walk,
)


@helper
def write_alpha(transmittance: Array, alpha: Array, tile: int, tiles: Tiles) -> None:
    """The tile of (H, W, 1) alpha <- 1 - |T|; changes `transmittance`."""
    for n in range(PIXELS):
        transmittance[n] = np.float32(1) - abs(transmittance[n])
    write_tile(transmittance, alpha, tile, tiles.columns)


@helper
def _fetch_values(work: Any, s: int, later: int) -> Array:
    ranks, values, _ = work
    lines = values.shape[1]
    prefetch(values, np.int64(ranks[later]) * lines)
    prefetch(values, np.int64(ranks[later]) * lines + lines - 1)
    return values[ranks[s]]


@helper
def _add_values(work: Any, x: Array, s: int, row: int, low: int, added: Lanes, before: Lanes) -> None:
    sums = work[2]
    lines = x.shape[0]
    add_weighted(sums, row * lines * TILE, lines, added * before, x)


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
    height, width, _ = image.shape
    sums = np.empty(PIXELS * values.shape[1], np.float32)
    for i in range(first, last):
        tile = spread(i, count)
        transmittance = start_tile(tile, tiles, width, height)
        sums[:] = 0
        work = (tiles.ranks, values, sums)
        walk(
            tile, tiles, geometry, cutoffs, transmittance, work, _fetch_values, _add_values, nothing_to_close
        )
        write_tile(sums, image, tile, tiles.columns)
        write_alpha(transmittance, alpha, tile, tiles)


@helper
def keep_weight(work: Any, mine: Any, s: int, row: int, low: int, added: Lanes, before: Lanes) -> None:
    store(work[0], (row - low) * TILE, added * before)


@helper
def _correlate_weights(work: Any, mine: Any, s: int, low: int, high: int) -> None:
    weights, planes, partial = work
    correlate(planes, partial.shape[1], weights, low, high, partial, s, 0)


@kernel
def gather(
    first: int, last: int, tiles: Tiles, geometry: Array, image: Array, cutoffs: Cutoffs, partial: Array
) -> None:
    """(H, W, C) float32 image -> fills (I, padded(C)) partial sums of ``W^T y``, a row per intersection."""
    count = tiles.starts.shape[0] - 1
    height, width, _ = image.shape
    planes, weights = np.empty(PIXELS * partial.shape[1], np.float32), np.empty(PIXELS, np.float32)
    for i in range(first, last):
        tile = spread(i, count)
        transmittance = start_tile(tile, tiles, width, height)
        load_tile(planes, image, tile, tiles.columns)
        work = (weights, planes, partial)
        end = walk(
            tile,
            tiles,
            geometry,
            cutoffs,
            transmittance,
            work,
            nothing_to_open,
            keep_weight,
            _correlate_weights,
        )
        partial[end : tiles.starts[tile + 1]] = 0


@kernel
def sum_partials(first: int, last: int, tiles: Tiles, order: Array, partial: Array, out: Array) -> None:
    """out[order[rank]] <- sum of the rank's partial sums, in the order of its tiles (so: reproducible)."""
    sums = np.empty(out.shape[1])
    for rank in range(first, last):
        sum_over_tiles(rank, tiles, partial, sums)
        for channel in range(out.shape[1]):
            out[order[rank], channel] = sums[channel]


@helper
def sum_over_tiles(rank: int, tiles: Tiles, partial: Array, sums: Array) -> None:
    """sums <- the first numbers of the rank's partial sums, added up in the order of its tiles."""
    sums[:] = 0
    end = tiles.slots.shape[0] - 1
    for n in range(tiles.firsts[rank], tiles.firsts[rank + 1]):
        prefetch(partial, np.int64(tiles.slots[min(n + 2 * AHEAD, end)]) * partial.shape[1])
        for channel in range(sums.shape[0]):
            sums[channel] += partial[tiles.slots[n], channel]


@helper
def _fetch_depth(work: Any, s: int, later: int) -> Any:
    ranks, depths, _ = work
    return np.float32(depths[ranks[s]])


@helper
def _note_half(work: Any, depth: Any, s: int, row: int, low: int, added: Lanes, before: Lanes) -> None:
    found, at, half = work[2], row * TILE, np.float32(0.5)
    passed = where_greater(before, half, lanes(depth), load(found, at))
    store(found, at, where_at_least(half, before - added * before, passed, load(found, at)))


@kernel
def median_depth(
    first: int, last: int, tiles: Tiles, geometry: Array, depths: Array, cutoffs: Cutoffs, out: Array
) -> None:
    """(M,) depths in depth order -> (H, W, 1) depth of the Gaussian that takes T to 0.5 or below, else 0."""
    count = tiles.starts.shape[0] - 1
    height, width, _ = out.shape
    found = np.empty(PIXELS, np.float32)
    for i in range(first, last):
        tile = spread(i, count)
        transmittance = start_tile(tile, tiles, width, height)
        found[:] = 0
        work = (tiles.ranks, depths, found)
        walk(tile, tiles, geometry, cutoffs, transmittance, work, _fetch_depth, _note_half, nothing_to_close)
        write_tile(found, out, tile, tiles.columns)
