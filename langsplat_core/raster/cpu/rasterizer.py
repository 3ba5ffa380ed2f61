"""The CPU backend: compiled, parallel over tiles, exact adjoint, true gradients.

Results do not depend on the number of threads: tiles are independent, and sums over tiles are made
per Gaussian in a fixed order.
"""

from collections.abc import Callable
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from scipy import sparse

from langsplat_core.arrays import Array, check_array
from langsplat_core.compiled import Workers, plain, shared_workers
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.progress import lap
from langsplat_core.raster.cpu import backward, blend, projection
from langsplat_core.raster.cpu.backward import GaussianGradients
from langsplat_core.raster.cpu.blend import TileOperator, gather_labels
from langsplat_core.raster.cpu.frozen import FrozenView
from langsplat_core.raster.cpu.memory import Memory
from langsplat_core.raster.cpu.tiles import bin_tiles, depth_order, make_cutoffs, padded
from langsplat_core.raster.protocol import check_picture, mean_depth
from langsplat_core.scene import Camera, Gaussians


class CpuView(TileOperator):
    """M drawn of N Gaussians, in depth order, with their tiles."""

    def __init__(
        self,
        gaussians: Gaussians,
        camera: Camera,
        settings: RasterSettings,
        workers: Workers,
        memory: Memory,
    ) -> None:
        n = len(gaussians)
        self._kernel_camera = projection.kernel_camera(camera, settings)
        self._cutoffs = make_cutoffs(settings)
        self._rows = projection.Rows(
            plain(gaussians.means),
            plain(gaussians.log_scales),
            plain(gaussians.quats_wxyz),
            plain(gaussians.opacity_logits),
            plain(gaussians.sh).reshape(n, gaussians.sh.shape[1] * 3).view(np.uint32),
            _sizes_of(gaussians),
        )
        self._memory = memory
        found = projection.Projection(
            memory.empty((n, projection.COLUMNS), np.float64),
            memory.empty((n,), np.float64),
            memory.empty((n,), np.uint8),
        )
        with lap("projection"):
            workers.run(projection.project, n, self._rows, self._kernel_camera, found)
        with lap("sort"):
            order, self._depths = depth_order(found.status, found.depths, memory)
        with lap("tiles"):
            size = camera.width, camera.height
            self._geometry, tiles = bin_tiles(found.geometry, order, size, workers, memory)
        super().__init__(camera, n, order, tiles, workers)
        self.dropped = int(np.count_nonzero(found.status == projection.INVALID))

    @property
    def radii(self) -> Array:
        """(N,) float32 px: the greater half extent of each footprint; 0 where nothing is drawn."""
        radii = np.zeros(self.count, np.float32)
        touches = np.diff(self.tiles.firsts) > 0
        radii[self.order] = np.where(touches, self._geometry[:, projection.HALF_WIDTH :].max(1), 0)
        return radii

    def _splat_part(self, values: Array, image: Array, alpha: Array) -> None:
        with lap("blend"):
            self._over_tiles(blend.splat, values, self._cutoffs, image, alpha)

    def _gather_part(self, image: Array, partial: Array) -> None:
        self._over_tiles(blend.gather, image, self._cutoffs, partial)

    def gather_labels(self, maps: Array, count: int, least: float = 0.0) -> sparse.csr_matrix:
        self.check_labels(maps, count)

        def run(kernel: Callable[..., None], *rest: Any) -> None:
            self._over_tiles(kernel, self._cutoffs, *rest)

        found = gather_labels(
            run, self.tiles, self.workers, np.require(maps, np.int32, ["C", "W"]), count, least
        )
        drawn = len(self.order)
        # Gaussians that are not drawn share an empty row behind the others.
        place = np.full(self.count, drawn)
        place[self.order] = np.arange(drawn)
        indptr = np.append(found.indptr, found.indptr[-1])
        return sparse.csr_matrix((found.data, found.indices, indptr), shape=(drawn + 1, count))[place]

    def frozen(self) -> FrozenView:
        """Return this view with W kept: `splat` and `gather` get cheaper the more often they are called."""
        return FrozenView(self, lambda kernel, *rest: self._over_tiles(kernel, self._cutoffs, *rest))

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
        ordered = plain(values[self.order])
        grads = (plain(image_grad), plain(alpha_grad)[..., None])
        met, columns = len(self.tiles.ranks), backward.MOMENTS + padded(channels)
        partial, reached = self._memory.empty((met, columns), np.float32), np.empty(met, bool)
        self._over_tiles(backward.backward, ordered, grads, self._cutoffs, partial, reached)
        out = GaussianGradients(
            *(
                self._memory.empty((n, *shape), np.float32)
                for shape in ((3,), (3,), (4,), (), (channels,), (2,))
            )
        )
        rank_of = np.full(n, -1, np.int32)
        rank_of[self.order] = np.arange(len(self.order), dtype=np.int32)
        sums = backward.Sums(rank_of, self._geometry, partial, reached)
        self.workers.run(backward.to_parameters, n, self.tiles, sums, self._rows, self._kernel_camera, out)
        return out

    def _over_tiles(self, kernel: Callable[..., None], *arguments: Any) -> None:
        self.workers.run(kernel, len(self.tiles.starts) - 1, self.tiles, self._geometry, *arguments)

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
        self._over_tiles(blend.median_depth, values, self._cutoffs, found)
        return found[..., 0]

    def depth(self) -> Array:
        # Ones are blended along: alpha itself is 1 - T, which has no digits left where it is small.
        both = np.zeros((self.count, 2), np.float32)
        both[self.order] = np.stack([self._depths, np.ones_like(self._depths)], -1)
        sums, weights = np.moveaxis(self.splat(both)[0], -1, 0)
        return mean_depth(sums, weights)


_SIZES: WeakKeyDictionary[Gaussians, Array] = WeakKeyDictionary()


def _sizes_of(gaussians: Gaussians) -> Array:
    """`projection.Rows.sizes`, which views fill; kept, as Gaussians are not changed."""
    sizes = _SIZES.get(gaussians)
    if sizes is None:
        sizes = _SIZES[gaussians] = np.full(len(gaussians), projection.UNKNOWN, np.float32)
    return sizes


class CpuRasterizer:
    """Rasterizer `cpu`. Kernels are compiled at first use (some seconds), see `langsplat_core.compiled`."""

    name = "cpu"

    def __init__(self, threads: int | None = None) -> None:
        """`threads` defaults to all cores this process may use; results do not depend on it."""
        self.workers = shared_workers(threads)
        self._memory = Memory()

    def view(self, gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> CpuView:
        """Project on the CPU; InputError for an image that this machine's memory cannot hold."""
        check_picture(camera)
        return CpuView(gaussians, camera, settings, self.workers, self._memory)
