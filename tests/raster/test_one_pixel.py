"""The Gaussians of one pixel are those that the whole view blends there."""

import numpy as np
import pytest

from langsplat_core.config import INRIA
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.raster.render import pixel_weights
from langsplat_core.scene import Gaussians, look_at
from tests.support.scenes import random_gaussians, without_perspective

SIZE = (64, 48)
PIXELS = [(0, 0), (63, 47), (32, 24), (20, 40), (50, 5)]


def view_from(distance: float):
    return look_at(np.array([0.2, -0.3, -distance]), np.zeros(3), np.array([0.0, -1, 0]), SIZE)


@pytest.mark.parametrize("orthographic", [False, True])
@pytest.mark.parametrize("distance", [3.0, 0.8])  # outside, and amid them: some behind, some at the edge
@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_the_row_of_w(backend, distance, orthographic):
    gaussians = random_gaussians(400, 3, scale_range=(0.005, 0.5))
    camera, rasterizer = view_from(distance), load_lifting_rasterizer(backend)
    camera = without_perspective(camera) if orthographic else camera
    truth = load_lifting_rasterizer("reference").view(gaussians, camera)
    for column, row in PIXELS:
        image = np.zeros((SIZE[1], SIZE[0], 1))
        image[row, column] = 1
        want = truth.gather(image)[:, 0]
        rows, weights = pixel_weights(rasterizer, gaussians, camera, (column, row))
        got = np.zeros(len(gaussians))
        got[rows] = weights
        assert (weights > 0).all()
        np.testing.assert_allclose(got, want, atol=2e-5)


def test_few_are_projected_and_invalid_ones_are_not():
    gaussians = random_gaussians(2000, 4, scale_range=(0.005, 0.02))
    means = gaussians.means.copy()
    means[5] = np.nan
    broken = Gaussians(
        means, gaussians.log_scales, gaussians.quats_wxyz, gaussians.opacity_logits, gaussians.sh
    )
    seen = []

    class Recorder:
        name = "recorder"

        def view(self, some, camera, settings=INRIA):
            seen.append(len(some))
            return load_lifting_rasterizer("cpu").view(some, camera, settings)

    rows, _ = pixel_weights(Recorder(), broken, view_from(3.0), (32, 24))
    assert 5 not in rows
    assert seen[0] < 200


def test_an_empty_scene():
    none = random_gaussians(3, 0).take(np.zeros(3, bool))
    rows, weights = pixel_weights(load_lifting_rasterizer("cpu"), none, view_from(3.0), (1, 1))
    assert len(rows) == len(weights) == 0
