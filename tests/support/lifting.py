"""Small views with masks, and the dense weights that lifting from them is compared with."""

import numpy as np

from langsplat_core.arrays import unit
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.semantics.store import ImageFeatures
from tests.support.scenes import random_camera

D = 12


def make_views(count: int = 3):
    """Cameras with random labels at three levels; the subpart level has no masks at all."""
    views = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        camera = random_camera(seed, 24, 18)
        labels = np.full((3, 18, 24), -1, np.int32)
        labels[1] = rng.integers(-1, 4, (18, 24))
        labels[2] = rng.integers(4, 7, (18, 24))
        vectors = unit(rng.normal(size=(7, D))).astype(np.float32)
        views.append((camera, ImageFeatures(labels, vectors)))
    return views


def dense_weights(gaussians, camera) -> np.ndarray:
    """(H, W, N): column i is the splat of the i-th unit vector."""
    return ReferenceRasterizer().view(gaussians, camera).splat(np.eye(len(gaussians)))[0]
