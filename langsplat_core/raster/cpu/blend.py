"""Blending on the CPU: the kernels of ``W x``, ``W^T y`` and the depth of half transmittance (see `walk`).

Below: ``W^T onehot(labels)`` in one walk.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from langsplat_core.arrays import Array
from langsplat_core.compiled import Workers, helper, kernel
from langsplat_core.raster.cpu.lanes import (
    Lanes,
    lanes,
    load,
    prefetch,
    store,
    where_at_least,
    where_greater,
)
from langsplat_core.raster.cpu.tiles import (
    AHEAD,
    PIXELS,
    TILE,
    Tiles,
    add_weighted,
    correlate,
    load_tile,
    nothing_to_close,
    nothing_to_open,
    padded_inside,
    tile_at,
    walk,
    write_tile,
)


@helper
def _fetch_values(work: Any, s: int, later: int) -> Array:
    ranks, values, _ = work
    lines = values.shape[1]
    prefetch(values, np.int64(ranks[later]) * lines)
    prefetch(values, np.int64(ranks[later]) * lines + lines - 1)
    return values[ranks[s]]


@helper
def _add_values(work: Any, x: Array, s: int, row: int, low: int, weight: Lanes, before: Lanes) -> None:
    channels = x.shape[0]
    add_weighted(work[2], row * padded_inside(channels) * TILE, channels, weight, x)


@kernel
def splat(first: int, last: int, tiles: Tiles, values: Array, image: Array, alpha: Array) -> None:
    """(M, C) values in depth order -> fills (H, W, C) image and (H, W, 1) alpha, all float32."""
    sums = np.empty(PIXELS * padded_inside(image.shape[2]), np.float32)
    for i in range(first, last):
        tile = tile_at(i, tiles)
        sums[:] = 0
        work = (tiles.ranks, values, sums)
        transmittance, _ = walk(tile, tiles, work, _fetch_values, _add_values, nothing_to_close)
        for n in range(PIXELS):
            transmittance[n] = np.float32(1) - abs(transmittance[n])
        write_tile(transmittance, alpha, tile, tiles)
        write_tile(sums, image, tile, tiles)


@helper
def _store_weight(work: Any, mine: Any, s: int, row: int, low: int, weight: Lanes, before: Lanes) -> None:
    store(work[0], (row - low) * TILE, weight)


@helper
def _correlate(work: Any, mine: Any, s: int, low: int, high: int) -> None:
    weights, planes, partial, start = work
    correlate(planes, partial.shape[1], weights, low, high, partial, s - start, 0)


@kernel
def gather(first: int, last: int, tiles: Tiles, image: Array, partial: Array) -> None:
    """(H, W, C) float32 image -> fills (I, padded(C)) partial sums of ``W^T y``, a row per intersection."""
    planes, weights = np.empty(PIXELS * partial.shape[1], np.float32), np.empty(PIXELS, np.float32)
    for i in range(first, last):
        tile = tile_at(i, tiles)
        load_tile(planes, image, tile, tiles)
        _, end = walk(tile, tiles, (weights, planes, partial, 0), nothing_to_open, _store_weight, _correlate)
        partial[end : tiles.starts[tile + 1]] = 0


@kernel
def sum_partials(first: int, last: int, tiles: Tiles, order: Array, partial: Array, out: Array) -> None:
    """out[order[rank]] <- sum of the rank's partial sums, in the order of its tiles (so: reproducible)."""
    sums = np.empty(out.shape[1])
    end = tiles.slots.shape[0] - 1
    for rank in range(first, last):
        sums[:] = 0
        for n in range(tiles.firsts[rank], tiles.firsts[rank + 1]):
            prefetch(partial, np.int64(tiles.slots[min(n + 2 * AHEAD, end)]) * partial.shape[1])
            for channel in range(sums.shape[0]):
                sums[channel] += partial[tiles.slots[n], channel]
        for channel in range(out.shape[1]):
            out[order[rank], channel] = sums[channel]


@helper
def _fetch_depth(work: Any, s: int, later: int) -> Any:
    ranks, depths, _ = work
    return np.float32(depths[ranks[s]])


@helper
def _note_half(work: Any, depth: Any, s: int, row: int, low: int, weight: Lanes, before: Lanes) -> None:
    found, at, half = work[2], row * TILE, np.float32(0.5)
    passed = where_greater(before, half, lanes(depth), load(found, at))
    store(found, at, where_at_least(half, before - weight, passed, load(found, at)))


@kernel
def median_depth(first: int, last: int, tiles: Tiles, depths: Array, out: Array) -> None:
    """(M,) depths in depth order -> (H, W, 1) depth of the Gaussian that takes T to 0.5 or below, else 0."""
    found = np.empty(PIXELS, np.float32)
    for i in range(first, last):
        tile = tile_at(i, tiles)
        found[:] = 0
        walk(tile, tiles, (tiles.ranks, depths, found), _fetch_depth, _note_half, nothing_to_close)
        write_tile(found, out, tile, tiles)


# ``W^T onehot(labels)`` in one walk: how much of every Gaussian lies in every region of label maps.
#
# A tile of 256 pixels meets few regions. It gets one plane of ones and zeros for each that it meets, whatever
# their number in the whole image; the weights of an intersection are correlated with those planes, and a
# Gaussian's partial sums are added up over its tiles by a sparse matrix.


class TileRegions(NamedTuple):
    """The regions that each of T tiles meets."""

    counts: Array  # (T,) int64
    labels: Array  # (T, 256 maps) int32, the first counts[t] of a row; 0 behind them


@kernel
def _meet_regions(first: int, last: int, maps: Array, columns: int, out: TileRegions) -> None:
    """Fill `out` with the labels >= 0 in tiles [first, last) of (L, H, W) maps."""
    levels, height, width = maps.shape
    for tile in range(first, last):
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        count, found = 0, out.labels[tile]
        for level in range(levels):
            for y in range(y0, min(y0 + TILE, height)):
                for x in range(x0, min(x0 + TILE, width)):
                    label = maps[level, y, x]
                    known = label < 0
                    for n in range(count - 1, -1, -1):
                        if known:
                            break
                        known = found[n] == label
                    if not known:
                        found[count] = label
                        count += 1
        out.counts[tile] = count
        found[count:] = 0


@helper
def _fill_planes(planes: Array, maps: Array, tile: int, tiles: Tiles, labels: Array, lines: int) -> None:
    """planes[(row, region, column)] <- 1 where a label of the pixel is that region, else 0."""
    levels, height, width = maps.shape
    x0, y0 = tile % tiles.columns * TILE, tile // tiles.columns * TILE
    planes[: PIXELS * lines] = 0
    for level in range(levels):
        last, slot = -1, 0
        for y in range(min(TILE, height - y0)):
            for x in range(min(TILE, width - x0)):
                label = maps[level, y0 + y, x0 + x]
                if label < 0:
                    continue
                if label != last:
                    last, slot = label, 0
                    while labels[slot] != label:
                        slot += 1
                planes[(y * lines + slot) * TILE + x] = 1


@kernel
def _gather_regions(
    first: int, last: int, tiles: Tiles, maps: Array, labels: Array, lines: Array, offsets: Array, sums: Array
) -> None:
    """(L, H, W) int32 maps -> tile t has lines[t] `sums` for each intersection, from offsets[t] on."""
    planes, weights = np.empty(PIXELS * lines.max(), np.float32), np.empty(PIXELS, np.float32)
    for i in range(first, last):
        tile = tile_at(i, tiles)
        start, stop = tiles.starts[tile], tiles.starts[tile + 1]
        if lines[tile] == 0 or stop == start:
            continue
        partial = sums[offsets[tile] : offsets[tile + 1]].reshape((stop - start, lines[tile]))
        _fill_planes(planes, maps, tile, tiles, labels[tile], lines[tile])
        work = (weights, planes, partial, start)
        _, end = walk(tile, tiles, work, nothing_to_open, _store_weight, _correlate)
        partial[end - start :] = 0


def gather_labels(
    tiles: Tiles, order: Array, workers: Workers, maps: Array, shape: tuple[int, int], least: float
) -> sparse.csr_matrix:
    """(L, H, W) int32 maps, labels -1 for none -> float32 weights, pixels, of `shape` (N, labels).

    `order`: (M,) rows of the drawn Gaussians. Entries of at most `least` are left out.
    """
    number = len(tiles.starts) - 1
    met = TileRegions(np.empty(number, np.int64), np.empty((number, len(maps) * PIXELS), np.int32))
    workers.run(_meet_regions, number, maps, tiles.columns, met)
    here, lines = np.diff(tiles.starts), (met.counts + 3) // 4 * 4  # in fours, as `correlate` likes them
    offsets = np.concatenate([[0], np.cumsum(here * lines)])
    sums = np.empty(offsets[-1], np.float32)
    workers.run(_gather_regions, number, tiles, maps, met.labels, lines, offsets, sums)
    # Sums of each intersection by label, added up in float64 in the order of a Gaussian's intersections.
    columns = [np.tile(met.labels[t, : lines[t]], here[t]) for t in range(number)]
    ends = np.concatenate([[0], np.cumsum(np.repeat(lines, here))])
    by_intersection = sparse.csr_matrix((sums, np.concatenate(columns), ends), (len(tiles.ranks), shape[1]))
    by_intersection.eliminate_zeros()
    drawn, ones = len(order), np.ones(len(tiles.slots))
    met_by = sparse.csr_matrix((ones, tiles.slots, tiles.firsts), (drawn, len(ones)))
    rows = sparse.csr_matrix((np.ones(drawn), (order, np.arange(drawn))), (shape[0], drawn))
    weights = rows @ (met_by @ by_intersection)
    weights.data[weights.data <= least] = 0
    weights.eliminate_zeros()
    weights.sort_indices()
    return weights.astype(np.float32)
