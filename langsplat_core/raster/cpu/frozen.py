"""A view of the CPU rasterizer that keeps W itself (see `frozen_kernels`)."""

from collections.abc import Callable

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.raster.cpu import frozen_kernels
from langsplat_core.raster.cpu.operator import TileOperator
from langsplat_core.raster.cpu.tiles import TILE


class FrozenView(TileOperator):
    """A view whose blending weights are kept, each to 1 / 131070 (see `frozen_kernels`)."""

    def __init__(self, view: TileOperator, run: Callable[..., None]) -> None:
        """`run(kernel, *arguments)` runs a kernel over the view's tiles."""
        super().__init__(view.camera, view.count, view.order, view.tiles, view.workers)
        self.dropped, self._view = view.dropped, view
        size = (view.camera.width, view.camera.height)
        spans = np.zeros(len(view.tiles.ranks), np.uint16)
        self._alpha = np.empty((size[1], size[0], 1), np.float32)
        run(frozen_kernels.find_spans, spans, self._alpha)
        rows = (spans >> 8).astype(np.int64) - (spans & 255)
        self._firsts = np.concatenate([[0], np.cumsum(rows)])
        self._weights = np.empty((int(self._firsts[-1]), TILE), np.uint16)
        run(frozen_kernels.keep_weights, size, spans, self._firsts, self._weights)
        self.tiles = view.tiles._replace(rows=spans)

    @property
    def nbytes(self) -> int:
        """Memory of what is kept beyond the view itself."""
        return self._weights.nbytes + self._firsts.nbytes + self.tiles.rows.nbytes + self._alpha.nbytes

    def depth(self) -> Array:
        """See `View.depth`; float32."""
        return self._view.depth()

    def median_depth(self) -> Array:
        """See `MedianDepth.median_depth`; float32."""
        return self._view.median_depth()

    def _splat_part(self, values: Array, image: Array, alpha: Array) -> None:
        alpha[:] = self._alpha
        self._run(frozen_kernels.splat, values, image)

    def _gather_part(self, image: Array, partial: Array) -> None:
        self._run(frozen_kernels.gather, image, partial)

    def _run(self, kernel: Callable[..., None], *arguments: Array) -> None:
        tiles = len(self.tiles.starts) - 1
        self.workers.run(kernel, tiles, self.tiles, self._firsts, self._weights, *arguments)
