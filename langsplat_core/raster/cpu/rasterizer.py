"""The CPU backend: compiled, parallel over tiles, exact adjoint, true gradients.

Results do not depend on the number of threads: tiles are independent, and sums over tiles are made
per Gaussian in a fixed order.
"""

import math
from collections.abc import Callable
from threading import Lock
from typing import Any
from weakref import finalize

import numpy as np
from scipy import sparse

from langsplat_core.arrays import Array, check_array
from langsplat_core.compiled import Workers, plain, shared_workers
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.raster.cpu import backward, blend, projection
from langsplat_core.raster.cpu.backward import GaussianGradients
from langsplat_core.raster.cpu.tiles import bin_tiles, depth_order, padded
from langsplat_core.raster.protocol import LiftingView, check_size, mean_depth
from langsplat_core.scene import Camera, Gaussians

_CHANNELS_AT_ONCE = 32  # a tile's state stays in the first level cache
_SPARE_BLOCKS = 16  # a view takes five, its gradients seven
_IDLE = 60  # requests after which a block that nobody asked for is given back


class _Loan:
    """Owner of a block's bytes for as long as an array lies in them."""

    def __init__(self, block: Array) -> None:
        self.__array_interface__ = block.__array_interface__


class Memory:
    """Blocks of memory that views use again: the system fills pages that it hands out with zeros.

    Views of 500 000 Gaussians take three quarters of the time with it, beside `numpy.empty`.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._requests = 0
        self._spare: list[tuple[int, Array]] = []  # when last asked for

    def empty(self, shape: tuple[int, ...], dtype: Any) -> Array:
        """Return an array like `numpy.empty` does, in a block that no other array lies in any more."""
        size = math.prod(shape) * np.dtype(dtype).itemsize
        with self._lock:
            self._requests += 1
            now, spare = self._requests, list(self._spare)
            del self._spare[: len(spare)]  # loans that end meanwhile come behind them
            recent = [one for one in spare[-_SPARE_BLOCKS:] if now - one[0] < _IDLE]
            place = next((i for i, (_, one) in enumerate(recent) if size <= len(one) <= 2 * size), None)
            block = np.empty(size + size // 4, np.uint8) if place is None else recent.pop(place)[1]
            self._spare[:0] = recent
        loan = _Loan(block)
        finalize(loan, self._spare.append, (now, block))
        return np.asarray(loan)[:size].view(dtype).reshape(shape)


class CpuView(LiftingView):
    """M drawn of N Gaussians, in depth order, with their tiles."""

    def __init__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        settings: RasterSettings,
        workers: Workers,
        memory: Memory,
    ) -> None:
        n = self.count = len(gaussians)
        self.camera, self.workers, self._empty = camera, workers, memory.empty
        self._kernel_camera = projection.kernel_camera(camera, settings)
        self._rows = projection.rows_of(gaussians)
        found = projection.Projection(
            self._empty((n, projection.COLUMNS), np.float64), np.empty(n), np.empty(n, np.uint8)
        )
        workers.run(projection.project, n, self._rows, self._kernel_camera, found)
        drawn = np.flatnonzero(found.status == projection.DRAWN).astype(np.int32)
        depths = found.depths[drawn]
        order = depth_order(depths)
        self.order, self._depths = drawn[order], depths[order]  # (M,) int32 rows, (M,) float64
        size = camera.width, camera.height
        self.tiles = bin_tiles(found.geometry, self.order, size, settings, workers, self._empty)
        self.dropped = int(np.count_nonzero(found.status == projection.INVALID))

    @property
    def radii(self) -> Array:
        """(N,) float32 px: the greater half extent of each footprint; 0 where nothing is drawn."""
        radii = np.zeros(self.count, np.float32)
        touches = np.diff(self.tiles.firsts) > 0
        radii[self.order] = np.where(touches, self.tiles.geometry[:, projection.HALF_WIDTH :].max(1), 0)
        return radii

    def splat(self, values: Array) -> tuple[Array, Array]:
        """Blend (N, C) finite values into (H, W, C) and alpha (H, W), float32."""
        check_array("values", values, (self.count, "C"))
        return self.splat_rows(values[self.order])

    @property
    def rows(self) -> Array:
        return self.order

    def splat_rows(self, values: Array) -> tuple[Array, Array]:
        check_array("values", values, (len(self.order), "C"))
        size = self.camera.height, self.camera.width
        alpha, parts = np.empty((*size, 1), np.float32), []
        for start in range(0, max(values.shape[1], 1), _CHANNELS_AT_ONCE):
            part = plain(values[:, start : start + _CHANNELS_AT_ONCE])
            parts.append(np.empty((*size, part.shape[1]), np.float32))
            self._over_tiles(blend.splat, part, parts[-1], alpha)
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
            self._over_tiles(blend.gather, part, partial)
            self.workers.run(blend.sum_partials, len(self.order), self.tiles, self.order, partial, out)
            values[:, start : start + _CHANNELS_AT_ONCE] = out
        return values

    def gather_labels(self, maps: Array, count: int, least: float = 0.0) -> sparse.csr_matrix:
        self.check_labels(maps, count)
        labels = np.require(maps, np.int32, ["C", "W"])
        return blend.gather_labels(self.tiles, self.order, self.workers, labels, (self.count, count), least)

    def backward(
        self, values: Array, image_grad: Array, alpha_grad: Array | None = None
    ) -> GaussianGradients:
        """Return gradients of a loss, given those by `splat(values)`: (H, W, C) image and (H, W) alpha.

        They are those of image formation as it is: 0 through a capped alpha and across the cut-offs.
        """
        n, height, width = self.count, self.camera.height, self.camera.width
        channels = check_array("values", values, (n, "C"))["C"]
        check_array("image_grad", image_grad, (height, width, channels))
        if alpha_grad is None:
            alpha_grad = np.zeros((height, width), np.float32)
        check_array("alpha_grad", alpha_grad, (height, width))
        grads = (plain(image_grad), plain(alpha_grad)[..., None])
        met, columns = len(self.tiles.ranks), backward.MOMENTS + padded(channels)
        partial, reached = self._empty((met, columns), np.float32), np.empty(met, bool)
        self._over_tiles(backward.backward, plain(values[self.order]), grads, partial, reached)
        shapes = (3,), (3,), (4,), (), (channels,), (2,)
        out = GaussianGradients(*(self._empty((n, *shape), np.float32) for shape in shapes))
        rank_of = np.full(n, -1, np.int32)
        rank_of[self.order] = np.arange(len(self.order), dtype=np.int32)
        sums = backward.Sums(rank_of, partial, reached)
        self.workers.run(backward.to_parameters, n, self.tiles, sums, self._rows, self._kernel_camera, out)
        return out

    def _over_tiles(self, kernel: Callable[..., None], *arguments: Any) -> None:
        self.workers.run(kernel, len(self.tiles.starts) - 1, self.tiles, *arguments)

    def median_depth(self) -> Array:
        return self._at_half(self._depths)

    def median_rows(self) -> Array:
        """(H, W) int64 the Gaussian at which the transmittance falls to 0.5 or below, -1 where it never does.

        Of more than 2^24 that are drawn it may be the next in depth.
        """
        place = self._at_half(np.arange(1, len(self.order) + 1, dtype=np.float32)).astype(np.int64)
        return np.append(self.order, -1)[place - 1]

    def _at_half(self, values: Array) -> Array:
        """(H, W) the one of (M,) numbers above 0, in depth order, that belongs to that Gaussian, else 0."""
        found = np.empty((self.camera.height, self.camera.width, 1), np.float32)
        self._over_tiles(blend.median_depth, values, found)
        return found[..., 0]

    def depth(self) -> Array:
        # Ones are blended along: alpha itself is 1 - T, which has no digits left where it is small.
        both = plain(np.stack([self._depths, np.ones_like(self._depths)], -1))
        image = np.empty((self.camera.height, self.camera.width, 2), np.float32)
        self._over_tiles(blend.splat, both, image, np.empty_like(image[..., :1]))
        return mean_depth(image[..., 0], image[..., 1])


class CpuRasterizer:
    """Rasterizer `cpu`. Kernels are compiled at first use (some seconds), see `langsplat_core.compiled`."""

    name = "cpu"

    def __init__(self, threads: int | None = None) -> None:
        """`threads` defaults to all cores this process may use; results do not depend on it."""
        self.workers = shared_workers(threads)
        self._memory = Memory()

    def view(self, gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> CpuView:
        """Project on the CPU; InputError for an image that no memory can hold."""
        check_size(camera)
        return CpuView(gaussians, camera, settings, self.workers, self._memory)
