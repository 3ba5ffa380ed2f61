"""What lies under one pixel: where it is, what it is called, and how relevant it is to what was asked."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import PictureConfig, RasterSettings
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.describe import Describer, Levels
from langsplat_core.raster.one_pixel import pixel_weights
from langsplat_core.raster.protocol import LiftingRasterizer
from langsplat_core.scene import Camera


@dataclass(frozen=True, eq=False)
class Pointed:
    """The surface in one pixel."""

    position: Array  # (3,) world units
    depth: float  # camera z, world units
    words: Levels  # at each level the most probable
    relevancy: tuple[float, ...]  # in [0, 1], of each answer at its level


def look_at_pixel(
    rasterizer: LiftingRasterizer,
    describer: Describer,
    camera: Camera,
    pixel: tuple[int, int],
    results: Sequence[QueryResult] = (),
    top: int = 3,
    settings: RasterSettings | None = None,
) -> Pointed | None:
    """What `camera` sees at `pixel` (column, row) of its picture; None where that is mostly empty.

    Every Gaussian counts by its blending weight there; the surface is at the median of their depths, as the
    rasterizers have it. `settings` of image formation: by default the scene's own.
    """
    scene = describer.engine.scene
    formed = settings or scene.raster_settings()
    rows, weights = pixel_weights(rasterizer, scene.gaussians, camera, pixel, formed)
    total = float(weights.sum())
    if total <= PictureConfig().alpha_gate:
        return None
    means = scene.gaussians.means[rows].astype(np.float64)
    depths = means @ camera.rotation[2] + camera.world_to_camera[2, 3]
    order = np.argsort(depths, kind="stable")
    median = order[np.searchsorted(np.cumsum(weights[order], dtype=np.float64), 0.5 * total)]
    depth = float(depths[median])
    centre = (pixel[0] + 0.5, pixel[1] + 0.5)
    relevancy = (float(weights @ result.relevancy[result.level][rows]) / total for result in results)
    return Pointed(
        position=camera.unproject(centre, depth),
        depth=depth,
        words=describer.at_gaussians(rows, weights, top),
        relevancy=tuple(relevancy),
    )
