"""Blending on the CPU: ``W x``, ``W^T y`` and the depth of half transmittance, tile by tile (see `walk`).

Below: ``W^T onehot(labels)`` in one walk, and the view that runs these kernels in parts of a few channels.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from langsplat_core.arrays import Array, check_array
from langsplat_core.compiled import Workers, helper, kernel, plain
from langsplat_core.raster.cpu.lanes import Lanes, lanes, load, prefetch, store, where_at_least, where_greater
from langsplat_core.raster.cpu.tiles import (
    AHEAD,
    PIXELS,
    TILE,
    Cutoffs,
    Tiles,
    add_weighted,
    correlate,
    load_tile,
    nothing_to_close,
    nothing_to_open,
    padded,
    padded_inside,
    spread,
    start_tile,
    walk,
    write_tile,
)
from langsplat_core.raster.protocol import LiftingView
from langsplat_core.scene import Camera


@helper
def write_alpha(transmittance: Array, alpha: Array, tile: int, tiles: Tiles) -> None:
    """Write 1 - |T| to the tile of (H, W, 1) alpha; changes `transmittance`."""
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
    channels = x.shape[0]
    add_weighted(sums, row * padded_inside(channels) * TILE, channels, added * before, x)


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
    """(M, C) values in depth order -> fills (H, W, C) image and (H, W, 1) alpha, all float32."""
    count = tiles.starts.shape[0] - 1
    height, width, channels = image.shape
    sums = np.empty(PIXELS * padded_inside(channels), np.float32)
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
def _keep_weight(work: Any, mine: Any, s: int, row: int, low: int, added: Lanes, before: Lanes) -> None:
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
            _keep_weight,
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
    """Add up the first numbers of the rank's partial sums into `sums`, in the order of its tiles."""
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


# ``W^T onehot(labels)`` in one walk: how much of every Gaussian lies in every region of label maps.
#
# A tile of 256 pixels meets few regions. It gets one plane of ones and zeros for each that it meets, whatever
# their number in the whole image; the weights of an intersection are correlated with those planes, and a
# Gaussian's partial sums are added up over its tiles.


class TileRegions(NamedTuple):
    """The regions that each of T tiles meets."""

    firsts: Array  # (T + 1,) int64: tile t has labels[firsts[t] : firsts[t + 1]]
    labels: Array  # (R,) int32


class LabelSums(NamedTuple):
    """The partial sums: tile t has a row of lines[t] numbers per intersection, from offsets[t] on."""

    offsets: Array  # (T + 1,) int64
    lines: Array  # (T,) int64: regions met, rounded up to fours
    sums: Array  # float32


class LabelRows(NamedTuple):
    """Entries of each Gaussian, in depth order: counts[rank] of them from room[rank] on."""

    room: Array  # (M + 1,) int64
    columns: Array  # int32 labels, ascending
    values: Array  # float32 weights, pixels
    counts: Array  # (M,) int64


@kernel
def _meet_regions(
    first: int, last: int, maps: Array, columns: int, regions: TileRegions, counts: Array
) -> None:
    """Count the labels >= 0 in each of tiles [first, last) of (L, H, W) maps.

    counts[tile] <- how many; and, where there is room in `regions`, which.
    """
    levels, height, width = maps.shape
    found = np.empty(levels * PIXELS, np.int32)
    for tile in range(first, last):
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        count = 0
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
        counts[tile] = count
        if regions.labels.shape[0] > 0:
            for n in range(count):
                regions.labels[regions.firsts[tile] + n] = found[n]


@helper
def _fill_planes(
    planes: Array, maps: Array, tile: int, columns: int, regions: TileRegions, lines: int
) -> None:
    """planes[(row, region, column)] <- 1 where a label of the pixel is that region, else 0."""
    levels, height, width = maps.shape
    x0, y0 = tile % columns * TILE, tile // columns * TILE
    first, count = regions.firsts[tile], regions.firsts[tile + 1] - regions.firsts[tile]
    planes[: PIXELS * lines] = 0
    for level in range(levels):
        last, slot = -1, 0
        for y in range(min(TILE, height - y0)):
            for x in range(min(TILE, width - x0)):
                label = maps[level, y0 + y, x0 + x]
                if label < 0:
                    continue
                if label != last:
                    last = label
                    for n in range(count):
                        if regions.labels[first + n] == label:
                            slot = n
                            break
                planes[(y * lines + slot) * TILE + x] = 1


@helper
def _correlate_here(work: Any, mine: Any, s: int, low: int, high: int) -> None:
    weights, planes, partial, start = work
    correlate(planes, partial.shape[1], weights, low, high, partial, s - start, 0)


@kernel
def _gather(
    first: int,
    last: int,
    tiles: Tiles,
    geometry: Array,
    cutoffs: Cutoffs,
    maps: Array,
    regions: TileRegions,
    out: LabelSums,
) -> None:
    """(L, H, W) int32 maps -> fills `out.sums`."""
    count = tiles.starts.shape[0] - 1
    _, height, width = maps.shape
    planes, weights = np.empty(PIXELS * out.lines.max(), np.float32), np.empty(PIXELS, np.float32)
    for i in range(first, last):
        tile = spread(i, count)
        lines, start, stop = out.lines[tile], tiles.starts[tile], tiles.starts[tile + 1]
        if lines == 0 or stop == start:
            continue
        partial = out.sums[out.offsets[tile] : out.offsets[tile + 1]].reshape((stop - start, lines))
        _fill_planes(planes, maps, tile, tiles.columns, regions, lines)
        state = start_tile(tile, tiles, width, height)
        work = (weights, planes, partial, start)
        end = walk(
            tile, tiles, geometry, cutoffs, state, work, nothing_to_open, _keep_weight, _correlate_here
        )
        partial[end - start :] = 0


@kernel
def _merge(
    first: int,
    last: int,
    tiles: Tiles,
    tile_of: Array,
    regions: TileRegions,
    sums: LabelSums,
    least: float,
    total: Array,
    out: LabelRows,
) -> None:
    """For Gaussians [first, last) in depth order: their regions of more weight than `least`.

    total: (labels,) shows how many labels there are; each call works on a copy.
    """
    total = total.copy()
    touched = np.empty(total.shape[0], np.int32)
    for rank in range(first, last):
        seen = 0
        for n in range(tiles.firsts[rank], tiles.firsts[rank + 1]):
            s = tiles.slots[n]
            tile = tile_of[s]
            at = sums.offsets[tile] + (s - tiles.starts[tile]) * sums.lines[tile]
            for k in range(regions.firsts[tile], regions.firsts[tile + 1]):
                weight = sums.sums[at]
                at += 1
                if weight > 0:
                    label = regions.labels[k]
                    if total[label] == 0:
                        touched[seen] = label
                        seen += 1
                    total[label] += weight
        touched[:seen].sort()
        kept = out.room[rank]
        for n in range(seen):
            label = touched[n]
            if total[label] > least:
                out.columns[kept], out.values[kept] = label, total[label]
                kept += 1
            total[label] = 0
        out.counts[rank] = kept - out.room[rank]


def gather_labels(
    run: Callable[..., None], tiles: Tiles, workers: Workers, maps: Array, count: int, least: float
) -> sparse.csr_matrix:
    """(L, H, W) int32 maps of labels below `count`, -1 for none -> (M, count) float32 weights, pixels.

    A row per drawn Gaussian in depth order; entries of at most `least` are left out.
    `run(kernel, *arguments)` runs a kernel over the view's tiles.
    """
    number = len(tiles.starts) - 1
    met, nothing = np.empty(number, np.int64), TileRegions(np.zeros(1, np.int64), np.empty(0, np.int32))
    workers.run(_meet_regions, number, maps, tiles.columns, nothing, met)
    firsts = np.concatenate([[0], np.cumsum(met)])
    regions = TileRegions(firsts, np.empty(firsts[-1], np.int32))
    workers.run(_meet_regions, number, maps, tiles.columns, regions, met)
    here, lines = np.diff(tiles.starts), (met + 3) // 4 * 4
    offsets = np.concatenate([[0], np.cumsum(here * lines)])
    sums = LabelSums(offsets, lines, np.empty(offsets[-1], np.float32))
    run(_gather, maps, regions, sums)
    tile_of = np.repeat(np.arange(number, dtype=np.int32), here)
    room = _room(tiles, met[tile_of], count)
    columns, values = np.empty(room[-1], np.int32), np.empty(room[-1], np.float32)
    merged = LabelRows(room, columns, values, np.zeros(len(room) - 1, np.int64))
    ranks = len(merged.counts)
    workers.run(_merge, ranks, tiles, tile_of, regions, sums, least, np.zeros(count), merged)
    return _as_matrix(merged, count)


def _room(tiles: Tiles, met: Array, count: int) -> Array:
    """(M + 1,) where each Gaussian's entries begin, if it met every region of all its tiles."""
    running = np.concatenate([[0], np.cumsum(met[tiles.slots])])
    most = np.minimum(running[tiles.firsts[1:]] - running[tiles.firsts[:-1]], count)
    return np.concatenate([[0], np.cumsum(most)])


def _as_matrix(merged: LabelRows, count: int) -> sparse.csr_matrix:
    """Without the room that was not needed."""
    sizes = np.diff(merged.room)
    place = np.arange(merged.room[-1]) - np.repeat(merged.room[:-1], sizes)
    used = place < np.repeat(merged.counts, sizes)
    indptr = np.concatenate([[0], np.cumsum(merged.counts)])
    shape = (len(merged.counts), count)
    return sparse.csr_matrix((merged.values[used], merged.columns[used], indptr), shape=shape)


# ``W x`` and ``W^T y`` over tiles, whatever keeps or makes the weights of a tile.

_CHANNELS_AT_ONCE = 32  # a tile's state stays in the first level cache


class TileOperator(LiftingView):
    """The linear operator W of a view: M drawn of `count` Gaussians, in depth order, with their tiles."""

    def __init__(self, camera: Camera, count: int, order: Array, tiles: Tiles, workers: Workers) -> None:
        self.camera, self.count = camera, count
        self.order = order  # (M,) int32
        self.tiles, self.workers = tiles, workers
        self.dropped = 0

    @abstractmethod
    def _splat_part(self, values: Array, image: Array, alpha: Array) -> None:
        """(M, C) values in depth order -> fill (H, W, C) image and (H, W, 1) alpha."""

    @abstractmethod
    def _gather_part(self, image: Array, partial: Array) -> None:
        """(H, W, C) image -> fill (I, padded(C)) sums, one row per intersection."""

    def splat(self, values: Array) -> tuple[Array, Array]:
        """Blend (N, C) finite values into (H, W, C) and alpha (H, W), float32."""
        check_array("values", values, (self.count, "C"))
        return self.splat_rows(values[self.order])

    @property
    def rows(self) -> Array:
        return self.order

    def splat_rows(self, ordered: Array) -> tuple[Array, Array]:
        check_array("values", ordered, (len(self.order), "C"))
        height, width, channels = self.camera.height, self.camera.width, ordered.shape[1]
        alpha = np.empty((height, width, 1), np.float32)
        parts = []
        for start in range(0, max(channels, 1), _CHANNELS_AT_ONCE):
            part = ordered[:, start : start + _CHANNELS_AT_ONCE]
            image = np.empty((height, width, part.shape[1]), np.float32)
            self._splat_part(plain(part), image, alpha)
            parts.append(image)
        return parts[0] if len(parts) == 1 else np.concatenate(parts, -1), alpha[..., 0]

    def gather(self, image: Array) -> Array:
        """Return W^T image, (N, C) float32, summed in float64 over tiles."""
        check_array("image", image, (self.camera.height, self.camera.width, "C"))
        channels = image.shape[2]
        values = np.zeros((self.count, channels), np.float32)
        for start in range(0, channels, _CHANNELS_AT_ONCE):
            part = plain(image[..., start : start + _CHANNELS_AT_ONCE])
            partial = np.empty((len(self.tiles.ranks), padded(part.shape[2])), np.float32)
            out = np.zeros((self.count, part.shape[2]), np.float32)
            self._gather_part(part, partial)
            self.workers.run(sum_partials, len(self.order), self.tiles, self.order, partial, out)
            values[:, start : start + _CHANNELS_AT_ONCE] = out
        return values
