"""The CPU backend: compiled, parallel over tiles, exact adjoint, true gradients.

Results do not depend on the number of threads: tiles are independent, and sums over tiles are made
per Gaussian in a fixed order.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from langsplat_core.arrays import Array, check_array
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.raster import cpu_backward, cpu_blend, cpu_project, cpu_tiles, cpu_unproject
from langsplat_core.raster.cpu_colour import colours, colours_backward
from langsplat_core.raster.protocol import DepthKind
from langsplat_core.raster.workers import Workers, plain, shared_workers
from langsplat_core.scene import Camera, Gaussians

__all__ = ["CpuRasterizer", "CpuView", "GaussianGradients", "colours", "colours_backward"]

_CHANNELS_AT_ONCE = 32  # a tile's state stays in the first level cache


@dataclass(frozen=True, eq=False)
class GaussianGradients:
    """Gradient of a scalar by every parameter of N Gaussians, float32; 0 for those that are not drawn."""

    means: Array  # (N, 3) per world unit
    log_scales: Array  # (N, 3)
    quats_wxyz: Array  # (N, 4) by the unnormalised quaternion
    opacity_logits: Array  # (N,)
    values: Array  # (N, C)
    means_px: Array  # (N, 2) per pixel, by the 2D mean alone (densification watches its length)


class CpuView:
    """M drawn of N Gaussians, in depth order, with their tiles."""

    def __init__(
        self, gaussians: Gaussians, camera: Camera, settings: RasterSettings, workers: Workers
    ) -> None:
        n = len(gaussians)
        self.camera = camera
        self._count, self._workers = n, workers
        self._lens = cpu_project.make_lens(camera, settings)
        self._cutoffs = cpu_blend.make_cutoffs(settings)
        self._rows = cpu_project.Rows(
            plain(gaussians.means),
            plain(gaussians.log_scales),
            plain(gaussians.quats_wxyz),
            plain(gaussians.opacity_logits),
            plain(gaussians.sh).reshape(n, gaussians.sh.shape[1] * 3).view(np.uint32),
        )
        found = cpu_project.Footprints(np.empty((n, cpu_project.COLUMNS)), np.empty(n), np.empty(n, np.uint8))
        workers.run(cpu_project.project, n, self._rows, self._lens, found)
        self._order = cpu_tiles.depth_order(found.status, found.depths.view(np.uint64))
        self._geometry = _aligned((len(self._order), cpu_project.COLUMNS))
        np.take(found.geometry, self._order, axis=0, out=self._geometry, mode="clip")
        self._depths = found.depths[self._order]
        self._tiles = cpu_tiles.bin_tiles(self._geometry, camera.width, camera.height, workers)
        self.dropped = int(np.count_nonzero(found.status == cpu_project.INVALID))

    @property
    def radii(self) -> Array:
        """(N,) float32 px: the greater half extent of each footprint; 0 where nothing is drawn."""
        radii = np.zeros(self._count, np.float32)
        touches = np.diff(self._tiles.firsts) > 0
        radii[self._order] = np.where(touches, self._geometry[:, cpu_project.HALF_WIDTH :].max(1), 0)
        return radii

    def splat(self, values: Array) -> tuple[Array, Array]:
        """See `View.splat`; float32. Values must be finite."""
        check_array("values", values, (self._count, "C"))
        ordered = values[self._order]
        height, width, channels = self.camera.height, self.camera.width, ordered.shape[1]
        alpha = np.empty((height, width, 1), np.float32)
        parts = []
        for start in range(0, max(channels, 1), _CHANNELS_AT_ONCE):
            part = ordered[:, start : start + _CHANNELS_AT_ONCE]
            image = np.empty((height, width, part.shape[1]), np.float32)
            self._over_tiles(cpu_blend.splat, _in_fours(part), self._cutoffs, image, alpha)
            parts.append(image)
        return parts[0] if len(parts) == 1 else np.concatenate(parts, -1), alpha[..., 0]

    def gather(self, image: Array) -> Array:
        """See `LiftingView.gather`; float32, summed in float64 over tiles."""
        check_array("image", image, (self.camera.height, self.camera.width, "C"))
        channels = image.shape[2]
        values = np.zeros((self._count, channels), np.float32)
        for start in range(0, channels, _CHANNELS_AT_ONCE):
            part = plain(image[..., start : start + _CHANNELS_AT_ONCE])
            partial = np.empty((len(self._tiles.ranks), cpu_blend.padded(part.shape[2])), np.float32)
            out = np.zeros((self._count, part.shape[2]), np.float32)
            self._over_tiles(cpu_blend.gather, part, self._cutoffs, partial)
            self._workers.run(
                cpu_blend.sum_partials, len(self._order), self._tiles, self._order, partial, out
            )
            values[:, start : start + _CHANNELS_AT_ONCE] = out
        return values

    def backward(
        self, values: Array, image_grad: Array, alpha_grad: Array | None = None
    ) -> GaussianGradients:
        """Gradients of a loss, given those by `splat(values)`: (H, W, C) by the image, (H, W) by alpha.

        They are those of image formation as it is: 0 through a capped alpha and across the cut-offs.
        """
        n, height, width = self._count, self.camera.height, self.camera.width
        channels = check_array("values", values, (n, "C"))["C"]
        check_array("image_grad", image_grad, (height, width, channels))
        if alpha_grad is None:
            alpha_grad = np.zeros((height, width), np.float32)
        check_array("alpha_grad", alpha_grad, (height, width))
        ordered = _in_fours(values[self._order])
        grads = (plain(image_grad), plain(alpha_grad)[..., None])
        moments = cpu_backward.MOMENTS
        partial = np.empty((len(self._tiles.ranks), moments + ordered.shape[1]), np.float32)
        self._over_tiles(cpu_backward.backward, ordered, grads, self._cutoffs, partial)
        out = cpu_unproject.ParameterGradients(
            *(np.zeros((n, *shape), np.float32) for shape in ((3,), (3,), (4,), (), (channels,), (2,)))
        )
        self._workers.run(
            cpu_unproject.to_parameters,
            len(self._order),
            self._tiles,
            self._order,
            self._geometry,
            partial,
            self._rows,
            self._lens,
            out,
        )
        return GaussianGradients(*out)

    def _over_tiles(self, kernel: Callable[..., None], *arguments: Any) -> None:
        self._workers.run(kernel, len(self._tiles.starts) - 1, self._tiles, self._geometry, *arguments)

    def depth(self, kind: DepthKind = "expected") -> Array:
        """See `View.depth`; float32."""
        if kind == "median":
            median = np.empty((self.camera.height, self.camera.width, 1), np.float32)
            self._over_tiles(cpu_blend.median_depth, self._depths, self._cutoffs, median)
            return median[..., 0]
        # Ones are blended along: alpha itself is 1 - T, which has no digits left where it is small.
        both = np.zeros((self._count, 2), np.float32)
        both[self._order] = np.stack([self._depths, np.ones_like(self._depths)], -1)
        sums, weights = np.moveaxis(self.splat(both)[0], -1, 0)
        return np.where(weights > 0, sums / np.where(weights > 0, weights, 1), 0)


def _in_fours(values: Array) -> Array:
    """(M, C) values as float32 (M, padded(C)), the last column zero where it was added."""
    count, channels = values.shape
    if cpu_blend.padded(channels) == channels:
        return plain(values)
    wide = np.zeros((count, cpu_blend.padded(channels)), np.float32)
    wide[:, :channels] = values
    return wide


def _aligned(shape: tuple[int, int]) -> Array:
    """An empty float64 array whose rows of eight begin at cache lines of 64 bytes."""
    memory = np.empty(shape[0] * shape[1] + 7)
    start = (-memory.ctypes.data // 8) % 8
    return memory[start : start + shape[0] * shape[1]].reshape(shape)


class CpuRasterizer:
    """Kernels are compiled at first use (some seconds) and cached beside the package, or in the user's cache
    folder where that cannot be written."""

    name = "cpu"

    def __init__(self, threads: int | None = None) -> None:
        """`threads` defaults to all cores this process may use; results do not depend on it."""
        self._workers = shared_workers(threads)

    def view(self, gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> CpuView:
        """See `Rasterizer.view`."""
        return CpuView(gaussians, camera, settings, self._workers)
