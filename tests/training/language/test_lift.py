"""Lifting CLIP vectors from masks to Gaussians, against dense weights and a plain median."""

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from langsplat_core.arrays import unit
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import LinearCodec
from langsplat_core.semantics.store import ImageFeatures
from langsplat_core.training.language import mask_weights as blocks
from langsplat_core.training.language.lift import lift_block, lift_latents, lift_sample, lift_weights
from langsplat_core.training.language.mask_weights import find_mask_weights, group_masks
from tests.support.scenes import LIFTED_DIM, dense_weights, make_views, random_camera, random_gaussians


@pytest.fixture(scope="module")
def gaussians():
    return random_gaussians(25, 3)


@pytest.fixture(scope="module")
def lifting(gaussians):
    """MaskWeights and ungrouped masks of three views."""
    views = make_views()
    groups = group_masks([features.vectors for _, features in views])
    return find_mask_weights(ReferenceRasterizer(), gaussians, views), groups


def test_mean_and_confidence(gaussians, lifting):
    lifted = lift_block(*lifting, 0, robust=False)
    assert lifted.vectors.shape == (3, 25, LIFTED_DIM)
    assert (lifted.vectors[0] == 0).all()
    assert (lifted.confidence[0] == 0).all()
    total, weight = np.zeros((25, LIFTED_DIM)), np.zeros(25)
    for camera, features in make_views():
        dense = dense_weights(gaussians, camera)
        for row in range(4, 7):
            inside = dense[features.labels[2] == row].sum(0)
            total += inside[:, None] * features.vectors[row]
            weight += inside
    np.testing.assert_allclose(lifted.confidence[2], weight, rtol=1e-4, atol=0.02)
    seen = weight > 1
    np.testing.assert_allclose(lifted.vectors[2][seen], unit(total[seen]), atol=2e-3)


def test_a_sample_is_some_of_the_rows(lifting, monkeypatch):
    mask_weights, groups = lifting
    whole = lift_block(mask_weights, groups, 0, robust=True)
    monkeypatch.setattr(blocks, "BLOCK", 8)
    rows = np.array([0, 3, 7, 8, 22])
    again = type(mask_weights)(mask_weights.pairs, mask_weights.count)
    some = lift_sample(again, groups, rows, robust=True)
    np.testing.assert_allclose(some.vectors, whole.vectors[:, rows], atol=1e-6)
    np.testing.assert_allclose(some.confidence, whole.confidence[:, rows], rtol=1e-6)
    assert lift_sample(again, groups, rows[:0], robust=True).vectors.shape == (3, 0, LIFTED_DIM)


def reference_median(weights: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Plain float64 Weiszfeld on the sphere, run to convergence."""
    centre = unit(weights @ vectors)
    for _ in range(300):
        distance = np.sqrt(np.maximum(2 - 2 * vectors @ centre, 1e-4))
        centre = unit((weights / distance) @ vectors)
    return centre


def test_median_outvotes_a_wrong_mask_that_the_mean_follows():
    rng = np.random.default_rng(0)
    good, bad = unit(rng.normal(size=(2, LIFTED_DIM)))
    noise = 0.05 * rng.normal(size=(10, LIFTED_DIM))
    vectors = unit(np.concatenate([np.tile(good, (7, 1)), np.tile(bad, (3, 1))]) + noise).astype(np.float32)
    weights = csr_matrix(
        np.repeat([[0, 0, 1]], 10, 1).astype(np.float32)
    )  # of one Gaussian, at level "whole"
    mean = lift_weights(weights, vectors, robust=False).vectors[2, 0]
    median = lift_weights(weights, vectors, robust=True).vectors[2, 0]
    assert median @ good > 0.98
    assert median @ good > mean @ good + 0.02
    # eight steps come within one degree of the converged median
    assert median @ reference_median(np.ones(10), vectors) > np.cos(np.radians(1))


def test_no_masks_anywhere(gaussians):
    empty = ImageFeatures(np.full((3, 6, 8), -1, np.int32), np.zeros((0, LIFTED_DIM), np.float32))
    mask_weights = find_mask_weights(ReferenceRasterizer(), gaussians, [(random_camera(0, 8, 6), empty)])
    lifted = lift_block(mask_weights, group_masks([empty.vectors]), 0, robust=True)
    assert lifted.vectors.shape == (3, 25, LIFTED_DIM)
    assert not lifted.vectors.any()
    assert not lifted.confidence.any()


# The paper's one-pass lifting against dense weights.


def test_one_pass_is_the_weighted_mean_of_latents():
    gaussians = random_gaussians(25, 3)
    views = make_views()
    codec = LinearCodec(np.eye(LIFTED_DIM, dtype=np.float32)[:4])
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
