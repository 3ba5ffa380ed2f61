"""Rasterizers: a linear operator per view, and nothing more.

With geometry frozen, a rendered image is ``F = W x``: `x` holds one vector per Gaussian and `W` the blending
weights alpha_i T_i of the view. A backend projects a view once and then offers `splat` (``W x``) and, where
it can lift, `gather` (``W^T y``, the exact adjoint).
"""

import math
from abc import ABC, abstractmethod
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
import scipy

from langsplat_core.arrays import Array, check_array
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.scene import Camera, Gaussians

# Largest growth of the dilation, in images 16 times as wide as the photographs: without a limit, cameras that
# do not belong to a scene would spread every Gaussian over the whole image.
MOST_GROWTH = 256.0
CHANNELS_AT_ONCE = 32  # channels blended in one pass: a tile of them stays in the first level cache


class View(ABC):
    """N Gaussians as one camera of H x W pixels sees them."""

    camera: Camera
    count: int  # N
    depths: Array  # (N,) camera z, defined where drawn; not of views that override `depth`

    @abstractmethod
    def splat(self, values: Array) -> tuple[Array, Array]:
        """Blend (N, C) values into (H, W, C) ``W x`` without background, and (H, W) alpha, row sums of W."""

    @property
    def rows(self) -> Array:
        """The (M,) int32 rows of which `splat_rows` takes values: those drawn, if the backend knows."""
        return np.arange(self.count, dtype=np.int32)

    def splat_rows(self, values: Array) -> tuple[Array, Array]:
        """`splat` of values at `rows` alone, (M, C)."""
        return self.splat(values)

    def depth(self) -> Array:
        """Return (H, W) alpha-weighted mean depth along camera z, world units; 0 where nothing is drawn."""
        # Ones are blended too, since alpha may be 1 - T, which has no digits left where it is small.
        both = np.column_stack([self.depths, np.ones_like(self.depths)])
        return mean_depth(*np.moveaxis(self.splat(both)[0], -1, 0))

    def median_depth(self) -> Array:
        """Return (H, W) camera z of the Gaussian at which the transmittance falls to 0.5 or below.

        0 where it never does. A backend that cannot tell gives the mean depth there.
        """
        _, alpha = self.splat(np.empty((self.count, 0), np.float32))
        return np.where(alpha >= 0.5, self.depth(), 0)

    def depth_at(self, column: int, row: int) -> tuple[float, float]:
        """Return depth of the surface (camera z, world units; 0: nothing) and alpha of one pixel.

        The depth is the median or, where the transmittance stays above 0.5, the alpha-weighted mean.
        """
        _, alpha = self.splat(np.empty((self.count, 0), np.float32))
        median = self.median_depth()[row, column]
        return float(median or self.depth()[row, column]), float(alpha[row, column])


class LiftingView(View):
    """View that offers the adjoint `gather` too."""

    @abstractmethod
    def gather(self, image: Array) -> Array:
        """Return the (N, C) values ``W^T y`` of a finite (H, W, C) image."""

    def contributions(self) -> Array:
        """Return (N,) blending weight of each Gaussian summed over the image, in pixels: ``W^T 1``."""
        return self.gather(np.ones((self.camera.height, self.camera.width, 1), np.float32))[:, 0]

    def gather_labels(self, maps: Array, count: int, least: float = 0.0) -> "scipy.sparse.csr_matrix":
        """Sum (L, H, W) int32 labels below `count`, -1 for none, into (N, count) ``W^T onehot``, pixels.

        A pixel counts once for every label that it has in any map. Entries of at most `least` are left out.
        """
        self.check_labels(maps, count)
        columns = [scipy.sparse.csr_matrix((self.count, 0), dtype=np.float32)]
        for start in range(0, count, CHANNELS_AT_ONCE):
            size = min(CHANNELS_AT_ONCE, count - start)
            image = np.zeros((self.camera.height * self.camera.width, size), np.float32)
            for labels in maps.reshape(len(maps), -1):
                inside = np.flatnonzero((labels >= start) & (labels < start + size))
                image[inside, labels[inside] - start] = 1
            weights = self.gather(image.reshape(self.camera.height, self.camera.width, size))
            columns.append(scipy.sparse.csr_matrix(np.where(weights > least, weights, 0).astype(np.float32)))
        return scipy.sparse.hstack(columns, format="csr")

    def check_labels(self, maps: Array, count: int) -> None:
        """Raise ValueError for maps that `gather_labels` cannot take."""
        check_array("maps", maps, ("L", self.camera.height, self.camera.width))
        if maps.dtype.kind not in "iu" or maps.max(initial=-1) >= count or maps.min(initial=-1) < -1:
            said = f"{maps.dtype} labels {maps.min()} to {maps.max()}"
            raise ValueError(f"maps: {said}, expected whole numbers from -1 to {count - 1}")

    @property
    def nbytes(self) -> int:
        """Approximate memory of the view in bytes, its Gaussians not counted."""
        return 100 * self.count


V = TypeVar("V", bound=View, covariant=True)


class Backend(Protocol[V]):
    """A rasterizer with views of type V; stateless apart from device resources."""

    name: str

    def view(self, gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> V:
        """Project `gaussians` into `camera` once, for any number of calls."""


Rasterizer = Backend[View]
LiftingRasterizer = Backend[LiftingView]


def far_plane(settings: RasterSettings) -> float:
    """Return the largest camera z at which Gaussians are drawn, world units."""
    return math.inf if settings.far is None else settings.far


def mean_depth(sums: Array, weights: Array) -> Array:
    """Return (H, W) mean depths: sums of weighted depths over weights, 0 where nothing is drawn."""
    return np.where(weights > 0, sums / np.where(weights > 0, weights, 1), 0)


def tangent_limits(camera: Camera, settings: RasterSettings) -> tuple[float, float, float, float]:
    """Return the limits of |x/z| and |y/z| in the Jacobian: left, top, right and bottom of the axis."""
    margin_x = (settings.fov_clamp - 1) * 0.5 * camera.width / camera.fx
    margin_y = (settings.fov_clamp - 1) * 0.5 * camera.height / camera.fy
    return (
        camera.cx / camera.fx + margin_x,
        camera.cy / camera.fy + margin_y,
        (camera.width - camera.cx) / camera.fx + margin_x,
        (camera.height - camera.cy) / camera.fy + margin_y,
    )


class Dilation(NamedTuple):
    """Variances that widen a footprint by the extent of pixels, px^2."""

    added: float  # to both variances
    # The part of it that opacities were fitted with: they fade by sqrt(det with this / det with all of it)
    fitted: float


def dilation(camera: Camera, settings: RasterSettings) -> Dilation:
    """Return what is added to both variances of a footprint, px^2.

    Gaussians are fitted with the dilation. In images of higher resolution than the photographs it covers more
    pixels, up to `MOST_GROWTH`: otherwise closed surfaces open, and edges fray into needles (Yu et al. 2024,
    Mip-Splatting, figure 1). In images of a lower one it covers less; the variance of a pixel's box, less
    that of theirs, is added, and opacities fade in return. Antialiased Gaussians were fitted without it.
    """
    growth = 1.0
    if settings.focal is not None and not camera.orthographic:
        growth = min(camera.fx * camera.fy / settings.focal / settings.focal, MOST_GROWTH)
    if abs(growth - 1) < 1e-6:  # at the photographs' own size it is rounding that differs
        growth = 1.0
    if settings.antialiased:
        return Dilation(settings.dilation * max(growth, 1.0), 0.0)
    fitted = settings.dilation * growth
    return Dilation(fitted + max(1 - growth, 0.0) / 12, fitted)
