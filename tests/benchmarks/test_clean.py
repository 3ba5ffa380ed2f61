"""The report of `langsplat clean`: what is put into a room, and where."""

import numpy as np
from scipy.spatial import cKDTree

from langsplat_core.arrays import sigmoid
from tests.benchmarks.clean import RANGES, with_floaters
from tests.support.scenes import random_camera, random_gaussians


def test_floaters_follow_the_rooms_own():
    room, cameras = random_gaussians(500, sh_degree=1), [random_camera(seed) for seed in range(5)]
    made, kinds = with_floaters(room, cameras, seed=3)
    np.testing.assert_array_equal(np.bincount(kinds), [500, 300, 300, 40])
    np.testing.assert_array_equal(made.means[:500], room.means)
    assert made.valid().all()
    for kind, (low, high) in enumerate(RANGES, 1):
        opacities = sigmoid(made.opacity_logits[kinds == kind].astype(np.float64))
        assert (opacities >= low - 1e-6).all()
        assert (opacities <= high + 1e-6).all()
    size = (np.quantile(room.means, 0.98, axis=0) - np.quantile(room.means, 0.02, axis=0)).max()
    near = cKDTree(room.means[sigmoid(room.opacity_logits) > 0.1])
    assert near.query(made.means[kinds == 1])[0].min() > 0.039 * size
