"""A tiny scene drawn by the reference rasterizer, and settings of a short training on it."""

from functools import cache

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import INRIA, RadianceConfig, RasterSettings
from langsplat_core.datasets.capture import Capture
from langsplat_core.raster.reference import ReferenceRasterizer, colours
from langsplat_core.scene import Camera, Gaussians, look_at
from langsplat_core.scene.transform import C0

SIZE = (48, 48)


SHORT = RadianceConfig(  # its own reference, so that nothing is rescaled: 40 steps with all that happens
    steps=40,
    reference_steps=40,
    backend="cpu",
    sh_degree=1,
    sh_degree_every=15,
    densify_from=4,
    densify_until=30,
    densify_every=10,
    opacity_reset_every=25,
    coarse_fraction=0.25,
    max_gaussians=1_300,
)


def picture(gaussians: Gaussians, camera: Camera, settings: RasterSettings = INRIA) -> Array:
    """(H, W, 3) float64 colours on black, by the reference."""
    values = colours(gaussians.sh, gaussians.means, camera.position)
    return ReferenceRasterizer().view(gaussians, camera, settings).splat(values)[0]


@cache
def truth() -> Gaussians:
    rng = np.random.default_rng(3)
    count = 40
    sh = np.zeros((count, 1, 3))
    sh[:, 0] = (rng.random((count, 3)) - 0.5) / C0
    return Gaussians(
        rng.uniform(-1, 1, (count, 3)),
        np.log(rng.uniform(0.08, 0.3, (count, 3))),
        rng.normal(size=(count, 4)),
        np.full(count, 2.0),
        sh,
    )


@cache
def capture() -> Capture:
    """Six views around the scene, the last for testing; points near the true means, colours unknown."""
    angles = np.linspace(0, 1.6, 6)[[0, 1, 2, 4, 5, 3]]
    eyes = [np.array([4 * np.sin(a), -0.5 - 0.3 * np.cos(5 * a), -4 * np.cos(a)]) for a in angles]
    cameras = [look_at(eye, np.zeros(3), np.array([0.0, -1.0, 0.0]), SIZE, 40.0) for eye in eyes]
    images = [np.round(255 * picture(truth(), c).clip(0, 1)).astype(np.uint8) for c in cameras]
    rng = np.random.default_rng(4)
    points = np.repeat(truth().means.astype(np.float64), 8, axis=0)
    points += 0.08 * rng.normal(size=points.shape)
    return Capture(tuple(cameras), tuple(images), points, np.full(points.shape, 128, np.uint8))
