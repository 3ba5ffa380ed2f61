"""One row of W: which Gaussians a single pixel is made of, without drawing the others."""

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.raster.protocol import LiftingRasterizer, farthest
from langsplat_core.scene import Camera, Gaussians


def pixel_weights(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    camera: Camera,
    pixel: tuple[int, int],
    settings: RasterSettings = INRIA,
) -> tuple[Array, Array]:
    """(M,) int64 numbers of the Gaussians that paint `pixel` (column, row), and their (M,) float32 weights,
    alpha_i T_i > 0, which add up to the pixel's alpha.

    Only those that could reach the pixel are projected; they keep their order, so the weights are those
    of the whole view. The pixel must lie in the picture.
    """
    column, row = pixel
    near = np.flatnonzero(_may_reach(gaussians, camera, pixel, settings))
    view = rasterizer.view(gaussians.take(near), camera, settings)
    chosen = np.zeros((camera.height, camera.width, 1), np.float32)
    chosen[row, column] = 1
    weights = np.asarray(view.gather(chosen))[:, 0]
    painting = weights > 0
    return near[painting], weights[painting]


def _may_reach(
    gaussians: Gaussians, camera: Camera, pixel: tuple[int, int], settings: RasterSettings
) -> Array:
    """(N,) bool, True for every Gaussian whose footprint may cover the pixel, and for few others.

    The footprint's covariance is J R S S R^T J^T + dilation, J the Jacobian (EWA splatting), so its largest
    eigenvalue is at most |J|^2 s_max^2 + dilation with |J|^2 <= (f/z)^2 (1 + (x/z)^2 + (y/z)^2); beyond
    sqrt(2 ln(1 / alpha_min)) deviations alpha is below the cut-off, whatever the opacity. J is taken at
    a clamped x/z and y/z, which only makes it smaller.
    """
    x, y, z = np.ascontiguousarray(_in_camera(gaussians, camera).T)
    scale_x, scale_y, scale_z = gaussians.log_scales.T
    with np.errstate(all="ignore"):  # invalid rows are dropped by the view
        x, y = x / z, y / z
        focal = np.float32(max(camera.fx, camera.fy)) / z
        largest = np.exp(np.maximum(np.maximum(scale_x, scale_y), scale_z))
        variance = (focal * largest) ** 2 * (1 + x * x + y * y) + np.float32(settings.dilation)
        reach = np.sqrt(np.float32(2 * np.log(1 / settings.alpha_min)) * variance) + 1
        away = np.maximum(
            np.abs(camera.fx * x + np.float32(camera.cx - pixel[0] - 0.5)),
            np.abs(camera.fy * y + np.float32(camera.cy - pixel[1] - 0.5)),
        )
        inside: Array = (
            (z > 0.999 * settings.near) & (z < 1.001 * farthest(settings)) & ~(away > 1.01 * reach)
        )
    return inside


def _in_camera(gaussians: Gaussians, camera: Camera) -> Array:
    """(N, 3) float32: this is a sieve with room for rounding, not a projection."""
    with np.errstate(all="ignore"):
        points: Array = gaussians.means @ camera.rotation.T.astype(np.float32)
        return points + camera.world_to_camera[:3, 3].astype(np.float32)
