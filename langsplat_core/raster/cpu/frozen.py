"""Frozen geometry: the blending weights W of one CPU view, kept.

`splat` and `gather` then need no exponential and no transmittance again.
A weight is kept as sixteen bits of fixed point, a row of a tile as sixteen of them: W is off by at most
1 / 131070 in every entry, and `gather` is still the exact adjoint of `splat`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.compiled import helper, kernel
from langsplat_core.raster.cpu.blend import TileOperator, write_alpha
from langsplat_core.raster.cpu.lanes import UNIT, Lanes, largest, load_units, prefetch, store, store_units
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
    pack_span,
    padded_inside,
    spread,
    start_tile,
    unpack_span,
    walk,
    write_tile,
)

VISIBLE = 0.5 / UNIT  # weights below round to 0


@helper
def _forget_rows(work: Any, s: int, later: int) -> int:
    seen = work[1]
    seen[0], seen[1] = TILE, 0
    return 0


@helper
def _look_at_row(work: Any, mine: Any, s: int, row: int, low: int, added: Lanes, before: Lanes) -> None:
    """Note the first and the last row in which one of the weights counts."""
    seen = work[1]
    if largest(added * before) >= VISIBLE:
        seen[0], seen[1] = min(seen[0], row), row + 1


@helper
def _keep_span(work: Any, mine: Any, s: int, low: int, high: int) -> None:
    spans, seen = work
    if seen[1] > 0:
        spans[s] = pack_span(seen[0], seen[1])


@kernel
def find_spans(
    first: int, last: int, tiles: Tiles, geometry: Array, cutoffs: Cutoffs, spans: Array, alpha: Array
) -> None:
    """Fill (I,) uint16 spans, 0 at first, and (H, W, 1) alpha.

    A span has the rows of an intersection that have a weight, packed as `Tiles.rows`.
    """
    count = tiles.starts.shape[0] - 1
    height, width, _ = alpha.shape
    seen = np.empty(2, np.int64)
    for i in range(first, last):
        tile = spread(i, count)
        transmittance = start_tile(tile, tiles, width, height)
        work = (spans, seen)
        walk(tile, tiles, geometry, cutoffs, transmittance, work, _forget_rows, _look_at_row, _keep_span)
        write_alpha(transmittance, alpha, tile, tiles)


@helper
def _rows_kept(work: Any, s: int, later: int) -> tuple[int, int, int]:
    """Return the rows of intersection s that are kept, and where row 0 of them would lie."""
    spans, firsts, _ = work
    start, end = unpack_span(spans[s])
    return start, end, firsts[s] - start


@helper
def _keep_row(work: Any, kept: Any, s: int, row: int, low: int, added: Lanes, before: Lanes) -> None:
    start, end, at = kept
    if start <= row < end:
        store_units(work[2], (at + row) * TILE, added * before)


@kernel
def keep_weights(
    first: int,
    last: int,
    tiles: Tiles,
    geometry: Array,
    cutoffs: Cutoffs,
    size: tuple[int, int],
    spans: Array,
    firsts: Array,
    weights: Array,
) -> None:
    """Fill (R, 16) uint16 weights, those of intersection s from row firsts[s] on. size: width, height."""
    count = tiles.starts.shape[0] - 1
    for i in range(first, last):
        tile = spread(i, count)
        transmittance = start_tile(tile, tiles, size[0], size[1])
        work = (spans, firsts, weights)
        walk(tile, tiles, geometry, cutoffs, transmittance, work, _rows_kept, _keep_row, nothing_to_close)


@kernel
def splat(
    first: int, last: int, tiles: Tiles, firsts: Array, weights: Array, values: Array, image: Array
) -> None:
    """(M, C) values in depth order -> fills (H, W, C) image; `tiles.rows` are the spans of `find_spans`."""
    count, channels = tiles.starts.shape[0] - 1, values.shape[1]
    lines = padded_inside(channels)
    sums = np.empty(PIXELS * lines, np.float32)
    for i in range(first, last):
        tile = spread(i, count)
        sums[:] = 0
        end = tiles.starts[tile + 1]
        for s in range(tiles.starts[tile], end):
            low, high = unpack_span(tiles.rows[s])
            prefetch(values, np.int64(tiles.ranks[min(s + AHEAD, end - 1)]) * channels)
            x = values[tiles.ranks[s]]
            at = firsts[s] * TILE
            for row in range(low, high):
                add_weighted(sums, row * lines * TILE, channels, load_units(weights, at), x)
                at += TILE
        write_tile(sums, image, tile, tiles.columns)


@kernel
def gather(
    first: int, last: int, tiles: Tiles, firsts: Array, weights: Array, image: Array, partial: Array
) -> None:
    """(H, W, C) image -> fills (I, padded(C)) partial sums of ``W^T y``."""
    count, lines = tiles.starts.shape[0] - 1, partial.shape[1]
    planes, buffer = np.empty(PIXELS * lines, np.float32), np.empty(PIXELS, np.float32)
    for i in range(first, last):
        tile = spread(i, count)
        load_tile(planes, image, tile, tiles.columns)
        for s in range(tiles.starts[tile], tiles.starts[tile + 1]):
            low, high = unpack_span(tiles.rows[s])
            for row in range(high - low):
                store(buffer, row * TILE, load_units(weights, (firsts[s] + row) * TILE))
            correlate(planes, lines, buffer, low, high, partial, s, 0)


class FrozenView(TileOperator):
    """A view whose blending weights are kept, each to 1 / 131070."""

    def __init__(self, view: TileOperator, run: Callable[..., None]) -> None:
        """`run(kernel, *arguments)` runs a kernel over the view's tiles."""
        super().__init__(view.camera, view.count, view.order, view.tiles, view.workers)
        self.dropped, self._view = view.dropped, view
        size = (view.camera.width, view.camera.height)
        spans = np.zeros(len(view.tiles.ranks), np.uint16)
        self._alpha = np.empty((size[1], size[0], 1), np.float32)
        run(find_spans, spans, self._alpha)
        rows = (spans >> 8).astype(np.int64) - (spans & 255)
        self._firsts = np.concatenate([[0], np.cumsum(rows)])
        self._weights = np.empty((int(self._firsts[-1]), TILE), np.uint16)
        run(keep_weights, size, spans, self._firsts, self._weights)
        self.tiles = view.tiles._replace(rows=spans)

    @property
    def nbytes(self) -> int:
        """Memory of what is kept beyond the view itself."""
        return self._weights.nbytes + self._firsts.nbytes + self.tiles.rows.nbytes + self._alpha.nbytes

    def depth(self) -> Array:
        return self._view.depth()

    def median_depth(self) -> Array:
        return self._view.median_depth()

    def _splat_part(self, values: Array, image: Array, alpha: Array) -> None:
        alpha[:] = self._alpha
        self._run(splat, values, image)

    def _gather_part(self, image: Array, partial: Array) -> None:
        self._run(gather, image, partial)

    def _run(self, kernel: Callable[..., None], *arguments: Array) -> None:
        tiles = len(self.tiles.starts) - 1
        self.workers.run(kernel, tiles, self.tiles, self._firsts, self._weights, *arguments)
