"""The paper's lifting in one pass: latents averaged directly, ``x = W^T H / W^T 1``."""

from collections.abc import Sequence

import numpy as np

from langsplat_core.arrays import Array, unit
from langsplat_core.config import INRIA, RasterSettings
from langsplat_core.progress import Progress, silent
from langsplat_core.raster.protocol import LiftingRasterizer
from langsplat_core.scene import LEVELS, Camera, Codec, Gaussians
from langsplat_core.semantics.store import ImageFeatures


def lift_latents(
    rasterizer: LiftingRasterizer,
    gaussians: Gaussians,
    views: Sequence[tuple[Camera, ImageFeatures]],
    codec: Codec,
    settings: RasterSettings = INRIA,
    progress: Progress = silent,
) -> tuple[Array, Array]:
    """The paper's quantity in one pass: (3, N, d) latents ``W^T H / W^T 1`` and (3, N) confidence.

    H holds the encoded vector of each pixel's mask; pixels without a mask count in neither sum.
    All three levels go through one gather per view.
    """
    count, d = len(gaussians), codec.latent_dim
    total = np.zeros((count, len(LEVELS), d + 1))
    for done, (camera, features) in enumerate(views):
        latents = np.zeros((len(features.vectors) + 1, d + 1), np.float32)
        latents[:-1, :d] = codec.encode(features.vectors)
        latents[:-1, d] = 1
        images = latents[features.labels]  # label -1 indexes the last row: zeros
        height, width = features.labels.shape[1:]
        stacked = np.moveaxis(images, 0, 2).reshape(height, width, -1)
        view = rasterizer.view(gaussians, camera, settings)
        total += view.gather(np.ascontiguousarray(stacked)).reshape(count, len(LEVELS), d + 1)
        progress("lifting latents onto the Gaussians", (done + 1) / len(views))
    confidence = total[..., d]
    means = unit(total[..., :d] / np.maximum(confidence, 1e-9)[..., None])
    return (
        np.moveaxis(means, 1, 0).astype(np.float32).copy(),
        confidence.T.astype(np.float32).copy(),
    )
