"""The paper's one-pass lifting against dense weights."""

import numpy as np

from langsplat_core.arrays import unit
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import LinearCodec
from langsplat_core.training.language.lift import lift_latents
from tests.support.lifting import D, dense_weights, make_views
from tests.support.scenes import random_gaussians


def test_one_pass_is_the_weighted_mean_of_latents():
    gaussians = random_gaussians(25, 3)
    views = make_views()
    codec = LinearCodec(np.eye(D, dtype=np.float32)[:4])
    latents, confidence = lift_latents(ReferenceRasterizer(), gaussians, views, codec)
    total, weight = np.zeros((25, 4)), np.zeros(25)
    for camera, features in views:
        weights = dense_weights(gaussians, camera)
        masked = features.labels[1] >= 0
        encoded = codec.encode(features.vectors)[features.labels[1][masked]]
        total += weights[masked].T @ encoded
        weight += weights[masked].sum(0)
    np.testing.assert_allclose(confidence[1], weight, rtol=1e-5)
    np.testing.assert_allclose(latents[1], unit(total / np.maximum(weight, 1e-9)[:, None]), atol=1e-5)
    assert (latents[0] == 0).all()
    assert (confidence[0] == 0).all()
    seen = weight > 0
    np.testing.assert_allclose(np.linalg.norm(latents[1][seen], axis=1), 1, atol=1e-5)
