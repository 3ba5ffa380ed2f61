"""The CPU backend: compiled, parallel over tiles, with the exact adjoint and exact gradients.

Results do not depend on the number of threads: tiles are independent, and sums over tiles are made
per Gaussian in a fixed order. From top to bottom: the kernels of ``W x``, ``W^T y`` and the depth of half
transmittance (see `tiles.walk`), ``W^T onehot(labels)`` in one walk, memory, and the rasterizer.
"""

import math
from collections.abc import Callable
from threading import Lock
from typing import Any
from weakref import finalize

import numpy as np
import scipy

from langsplat_core.arrays import Array, check_array
from langsplat_core.compiled import Workers, helper, kernel, plain, shared_workers
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.errors import InputError
from langsplat_core.raster.cpu import backward, projection
from langsplat_core.raster.cpu import lanes as ln
from langsplat_core.raster.cpu import tiles as tiling
from langsplat_core.raster.cpu.backward import GaussianGradients
from langsplat_core.raster.cpu.lanes import Lanes
from langsplat_core.raster.cpu.tiles import PIXELS, TILE, Tiles
from langsplat_core.raster.protocol import CHANNELS_AT_ONCE, LiftingView
from langsplat_core.scene import Camera, Gaussians


@helper
def _fetch_values(work: Any, rank: int, later: int) -> Array:
    values, _ = work
    lines = values.shape[1]
    ln.prefetch(values, later * lines)
    ln.prefetch(values, later * lines + lines - 1)
    return values[rank]


@helper
def _add_values(work: Any, x: Array, s: int, row: int, low: int, alpha: Lanes, before: Lanes) -> None:
    channels = x.shape[0]
    tiling.add_weighted(work[1], row * tiling.padded_inside(channels) * TILE, channels, alpha * before, x)


@kernel
def splat_tiles(first: int, last: int, tiles: Tiles, values: Array, image: Array, alpha: Array) -> None:
    """Fill (H, W, C) image and (H, W, 1) alpha by blending (M, C) values in depth order, all float32."""
    sums = np.empty(PIXELS * tiling.padded_inside(image.shape[2]), np.float32)
    for i in range(first, last):
        tile = tiling.tile_at(i, tiles)
        sums[:] = 0
        work = ln.borrowed((values, sums))
        transmittance, _ = tiling.walk(tile, tiles, work, _fetch_values, _add_values, tiling.nothing_to_close)
        for n in range(PIXELS):
            transmittance[n] = np.float32(1) - abs(transmittance[n])
        tiling.write_tile(transmittance, alpha, tile, tiles)
        tiling.write_tile(sums, image, tile, tiles)


@helper
def _store_weight(work: Any, mine: Any, s: int, row: int, low: int, alpha: Lanes, before: Lanes) -> None:
    ln.store(work[0], (row - low) * TILE, alpha * before)


@helper
def _correlate(work: Any, mine: Any, s: int, low: int, high: int) -> None:
    weights, planes, partial, start = work
    tiling.correlate(planes, partial.shape[1], weights, low, high, partial, s - start, 0)


@kernel
def gather_tiles(first: int, last: int, tiles: Tiles, image: Array, partial: Array) -> None:
    """Fill (I, padded(C)) partial sums of ``W^T y``, a row per intersection; image: (H, W, C) float32."""
    planes, weights = np.empty(PIXELS * partial.shape[1], np.float32), np.empty(PIXELS, np.float32)
    for i in range(first, last):
        tile = tiling.tile_at(i, tiles)
        tiling.load_tile(planes, image, tile, tiles)
        _, end = tiling.walk(
            tile, tiles, (weights, planes, partial, 0), tiling.nothing_to_open, _store_weight, _correlate
        )
        partial[end : tiles.starts[tile + 1]] = 0


@kernel
def sum_partials(first: int, last: int, tiles: Tiles, order: Array, partial: Array, out: Array) -> None:
    """out[order[rank]] <- sum of the rank's partial sums, in the order of its tiles (so: reproducible)."""
    sums = np.empty(out.shape[1])
    end = tiles.slots.shape[0] - 1
    for rank in range(first, last):
        sums[:] = 0
        for n in range(tiles.firsts[rank], tiles.firsts[rank + 1]):
            ln.prefetch(partial, np.int64(tiles.slots[min(n + 2 * tiling.AHEAD, end)]) * partial.shape[1])
            for channel in range(sums.shape[0]):
                sums[channel] += partial[tiles.slots[n], channel]
        for channel in range(out.shape[1]):
            out[order[rank], channel] = sums[channel]


@helper
def _fetch_depth(work: Any, rank: int, later: int) -> Any:
    return np.float32(work[0][rank])


@helper
def _note_half(work: Any, depth: Any, s: int, row: int, low: int, alpha: Lanes, before: Lanes) -> None:
    found, at, half = work[1], row * TILE, np.float32(0.5)
    passed = ln.where_at_least(half, before, ln.load(found, at), ln.lanes(depth))
    ln.store(found, at, ln.where_at_least(half, before - alpha * before, passed, ln.load(found, at)))


@kernel
def median_tiles(first: int, last: int, tiles: Tiles, depths: Array, out: Array) -> None:
    """Fill (H, W, 1) with the first of (M,) sorted depths behind which T is 0.5 or below, else 0."""
    found = np.empty(PIXELS, np.float32)
    for i in range(first, last):
        tile = tiling.tile_at(i, tiles)
        found[:] = 0
        tiling.walk(tile, tiles, (depths, found), _fetch_depth, _note_half, tiling.nothing_to_close)
        tiling.write_tile(found, out, tile, tiles)


# ``W^T onehot(labels)`` in one walk: how much of every Gaussian lies in every region of label maps.
#
# A tile of 256 pixels meets few regions. It gets one plane of ones and zeros for each that it meets, whatever
# their number in the whole image; the weights of an intersection are correlated with those planes, and a
# Gaussian's partial sums are added up over its tiles by a sparse matrix.


@kernel
def _meet_regions(first: int, last: int, maps: Array, columns: int, counts: Array, labels: Array) -> None:
    """Find the labels >= 0 in tiles [first, last) of (L, H, W) maps, in columns of tiles.

    counts: (T,) int64; labels: (T, 256 L) int32, the first counts[t] of row t, 0 behind them.
    """
    levels, height, width = maps.shape
    for tile in range(first, last):
        x0, y0 = tile % columns * TILE, tile // columns * TILE
        count, found = 0, labels[tile]
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
    """Fill `sums`, lines[t] for each intersection of tile t from offsets[t] on, by (L, H, W) int32 maps."""
    planes, weights = np.empty(PIXELS * lines.max(), np.float32), np.empty(PIXELS, np.float32)
    for i in range(first, last):
        tile = tiling.tile_at(i, tiles)
        start, stop = tiles.starts[tile], tiles.starts[tile + 1]
        if lines[tile] == 0 or stop == start:
            continue
        partial = sums[offsets[tile] : offsets[tile + 1]].reshape((stop - start, lines[tile]))
        _fill_planes(planes, maps, tile, tiles, labels[tile], lines[tile])
        work = (weights, planes, partial, start)
        _, end = tiling.walk(tile, tiles, work, tiling.nothing_to_open, _store_weight, _correlate)
        partial[end - start :] = 0


def label_weights(
    tiles: Tiles, order: Array, workers: Workers, maps: Array, shape: tuple[int, int], least: float
) -> "scipy.sparse.csr_matrix":
    """Return float32 mask weights, pixels, of `shape` (N, labels) by (L, H, W) int32 maps; -1: no label.

    `order`: (M,) rows of the drawn Gaussians. Entries of at most `least` are left out.
    """
    number = len(tiles.starts) - 1
    counts, labels = np.empty(number, np.int64), np.empty((number, len(maps) * PIXELS), np.int32)
    workers.run(_meet_regions, number, maps, tiles.columns, counts, labels)
    here, lines = np.diff(tiles.starts), (counts + 3) // 4 * 4  # multiples of 4, for `correlate`
    offsets = np.concatenate([[0], np.cumsum(here * lines)])
    sums = np.empty(offsets[-1], np.float32)
    workers.run(_gather_regions, number, tiles, maps, labels, lines, offsets, sums)
    # Sums of each intersection by label, added up in float64 in the order of a Gaussian's intersections.
    columns = [np.tile(labels[t, : lines[t]], here[t]) for t in range(number)]
    entries = sums, np.concatenate(columns), np.concatenate([[0], np.cumsum(np.repeat(lines, here))])
    by_intersection = scipy.sparse.csr_matrix(entries, (len(tiles.met), shape[1]))
    by_intersection.eliminate_zeros()
    drawn, ones = len(order), np.ones(len(tiles.slots))
    met_by = scipy.sparse.csr_matrix((ones, tiles.slots, tiles.firsts), (drawn, len(ones)))
    rows = scipy.sparse.csr_matrix((np.ones(drawn), (order, np.arange(drawn))), (shape[0], drawn))
    weights = rows @ (met_by @ by_intersection)
    weights.data[weights.data <= least] = 0
    weights.eliminate_zeros()
    weights.sort_indices()
    return weights.astype(np.float32)


# Views.

_LINE = 64  # bytes of a cache line; arrays begin with one
_SPARE_BLOCKS = 16  # a view takes four, its gradients one more
_IDLE = 60  # requests after which a block that was not reused is freed


class _Loan:
    """Owner of a block of memory for as long as an array uses it."""

    def __init__(self, block: Array) -> None:
        self.__array_interface__ = block.__array_interface__


class Memory:
    """Pool of memory blocks that views reuse, since the system zeroes the pages that it hands out.

    Views of 500 000 Gaussians take three quarters of the time that they take with `numpy.empty`.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._requests = 0
        self._spare: list[tuple[int, Array]] = []  # request of the last use, and block

    def empty(self, shape: tuple[int, ...], dtype: Any) -> Array:
        """Return an array as `numpy.empty` does, in a block that no other array uses any more."""
        size = math.prod(shape) * np.dtype(dtype).itemsize
        with self._lock:
            self._requests += 1
            now, spare = self._requests, list(self._spare)
            del self._spare[: len(spare)]  # blocks returned meanwhile are appended behind them
            recent = [one for one in spare[-_SPARE_BLOCKS:] if now - one[0] < _IDLE]
            place = next((i for i, (_, one) in enumerate(recent) if size <= len(one) <= 2 * size), None)
            found = np.empty(size + size // 4 + _LINE, np.uint8) if place is None else recent.pop(place)[1]
            block = found[-found.ctypes.data % _LINE :]
            self._spare[:0] = recent
        loan = _Loan(block)
        finalize(loan, self._spare.append, (now, block))
        return np.asarray(loan)[:size].view(dtype).reshape(shape)


class CpuView(LiftingView):
    """View of N Gaussians, M of which are drawn: their depth order and their tiles."""

    def __init__(
        self, gaussians: Gaussians, camera: Camera, settings: RasterSettings, workers: Workers, memory: Memory
    ) -> None:
        self.camera, self.count, self.workers, self._empty = camera, len(gaussians), workers, memory.empty
        self._kernel_camera = projection.kernel_camera(camera, settings)
        self._rows = projection.rows_of(gaussians)
        found = projection.project_all(self._rows, self._kernel_camera, workers, self._empty)
        self.order = tiling.depth_order(found.depths, found.drawn, workers)  # (M,)
        self.depths = found.depths
        size = camera.width, camera.height
        self.tiles = tiling.bin_tiles(found.geometry, self.order, size, settings, workers, self._empty)

    @property
    def drawn(self) -> Array:
        """(N,) bool: has a footprint that meets a tile."""
        drawn = np.zeros(self.count, bool)
        drawn[self.order] = self.tiles.firsts[1:] > self.tiles.firsts[:-1]
        return drawn

    def splat(self, values: Array) -> tuple[Array, Array]:
        """Blend (N, C) finite values into (H, W, C) and alpha (H, W), float32."""
        check_array("values", values, (self.count, "C"))
        return self.splat_rows(values[self.order])

    @property
    def rows(self) -> Array:
        return self.order

    def splat_rows(self, values: Array) -> tuple[Array, Array]:
        check_array("values", values, (len(self.order), "C"), finite=True)
        size = self.camera.height, self.camera.width
        alpha, parts = np.empty((*size, 1), np.float32), []
        for start in range(0, max(values.shape[1], 1), CHANNELS_AT_ONCE):
            part = plain(values[:, start : start + CHANNELS_AT_ONCE])
            parts.append(np.empty((*size, part.shape[1]), np.float32))
            self._over_tiles(splat_tiles, part, parts[-1], alpha)
        return parts[0] if len(parts) == 1 else np.concatenate(parts, -1), alpha[..., 0]

    @property
    def nbytes(self) -> int:
        arrays = (self.order, self.depths, *self.tiles)
        return sum(array.nbytes for array in arrays if isinstance(array, np.ndarray))

    def gather(self, image: Array) -> Array:
        """Return W^T image, (N, C) float32, summed in float64 over tiles."""
        check_array("image", image, (self.camera.height, self.camera.width, "C"), finite=True)
        channels = image.shape[2]
        values = np.zeros((self.count, channels), np.float32)
        for start in range(0, channels, CHANNELS_AT_ONCE):
            part = plain(image[..., start : start + CHANNELS_AT_ONCE])
            partial = np.empty((len(self.tiles.met), tiling.padded(part.shape[2])), np.float32)
            out = np.zeros((self.count, part.shape[2]), np.float32)
            self._over_tiles(gather_tiles, part, partial)
            self.workers.run(sum_partials, len(self.order), self.tiles, self.order, partial, out)
            values[:, start : start + CHANNELS_AT_ONCE] = out
        return values

    def gather_labels(self, maps: Array, count: int, least: float = 0.0) -> "scipy.sparse.csr_matrix":
        self.check_labels(maps, count)
        labels = np.require(maps, np.int32, ["C", "W"])
        return label_weights(self.tiles, self.order, self.workers, labels, (self.count, count), least)

    def backward(
        self, values: Array, image_grad: Array, alpha_grad: Array | None = None
    ) -> GaussianGradients:
        """Return gradients of a loss, given those by `splat(values)`: (H, W, C) image and (H, W) alpha.

        They are exact for this image formation: nothing passes a capped alpha or a cut-off.
        """
        n, height, width = self.count, self.camera.height, self.camera.width
        channels = check_array("values", values, (n, "C"))["C"]
        check_array("image_grad", image_grad, (height, width, channels))
        alpha_grad = np.zeros((height, width), np.float32) if alpha_grad is None else alpha_grad
        check_array("alpha_grad", alpha_grad, (height, width))
        grads = (plain(image_grad), plain(alpha_grad)[..., None])
        met, columns = len(self.tiles.met), backward.MOMENTS + tiling.padded(channels)
        partial, reached = self._empty((met, columns), np.float32), np.empty(met, bool)
        self._over_tiles(backward.backward, plain(values[self.order]), grads, partial, reached)
        shapes = (3,), (3,), (4,), (), (channels,), (2,)
        out = GaussianGradients(*(np.zeros((n, *shape), np.float32) for shape in shapes))
        rank_of = np.full(n, -1, np.int32)
        rank_of[self.order] = np.arange(len(self.order), dtype=np.int32)
        sums = backward.Sums(rank_of, partial, reached)
        self.workers.run(backward.to_parameters, n, self.tiles, sums, self._rows, self._kernel_camera, out)
        return out

    def _over_tiles(self, kernel: Callable[..., None], *arguments: Any) -> None:
        self.workers.run(kernel, len(self.tiles.starts) - 1, self.tiles, *arguments)

    def median_depth(self) -> Array:
        return self._at_half(self.depths[self.order])

    def median_rows(self) -> Array:
        """Return (H, W) int64 Gaussian at which the transmittance falls to 0.5 or below, -1 where never.

        If more than 2^24 are drawn, it may be the next in depth: ranks are float32.
        """
        place = self._at_half(np.arange(1, len(self.order) + 1, dtype=np.float32)).astype(np.int64)
        return np.append(self.order, -1)[place - 1]

    def _at_half(self, values: Array) -> Array:
        """Return (H, W) the first of (M,) numbers > 0, in depth order, behind which T <= 0.5, else 0."""
        found = np.empty((self.camera.height, self.camera.width, 1), np.float32)
        self._over_tiles(median_tiles, values, found)
        return found[..., 0]


class CpuRasterizer:
    """Rasterizer `cpu`. Kernels are compiled at first use (some seconds), see `langsplat_core.compiled`."""

    name = "cpu"

    def __init__(self, threads: int | None = None) -> None:
        """`threads` defaults to all cores this process may use; results do not depend on it."""
        self.workers = shared_workers(threads)
        self._memory = Memory()

    def view(self, gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> CpuView:
        """Project on the CPU; InputError for an image that no memory can hold."""
        if camera.width * camera.height > 2**28:  # 16384 x 16384, which takes 11 GB while it is drawn
            raise InputError(
                f"an image of {camera.width}x{camera.height} pixels is too large; choose a smaller size"
            )
        return CpuView(gaussians, camera, settings, self.workers, self._memory)
