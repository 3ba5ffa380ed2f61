"""Lifting from masks to Gaussians against dense weights."""

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from langsplat_core.arrays import unit
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import LinearCodec
from langsplat_core.semantics.store import ImageFeatures
from langsplat_core.training.language.lift import Memberships, find_memberships, lift_latents, lift_vectors
from tests.support.scenes import random_camera, random_gaussians

D = 12


def make_views(gaussians, count: int = 3):
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


@pytest.fixture(scope="module")
def gaussians():
    return random_gaussians(25, 3)


@pytest.mark.parametrize(("backend", "chunk"), [("reference", 3), ("reference", 32), ("cpu", 32)])
def test_membership_is_the_weight_inside_the_mask(gaussians, backend, chunk):
    views = make_views(gaussians)
    memberships = find_memberships(load_lifting_rasterizer(backend), gaussians, views, chunk)
    assert memberships.weights.shape == (25, 21)
    got = memberships.weights.toarray()
    for index, (camera, features) in enumerate(views):
        weights = dense_weights(gaussians, camera)
        for row in range(7):
            level = 1 if row < 4 else 2
            want = weights[features.labels[level] == row].sum(0)
            want[want <= 1e-3] = 0
            np.testing.assert_allclose(got[:, 7 * index + row], want, rtol=1e-5, atol=1e-6)
    assert memberships.levels.tolist() == [1, 1, 1, 1, 2, 2, 2] * 3


def test_mean_and_confidence(gaussians):
    views = make_views(gaussians)
    memberships = find_memberships(ReferenceRasterizer(), gaussians, views)
    levels = list(lift_vectors(memberships, robust=False))
    subpart, confidence = levels[0]
    assert (subpart == 0).all()
    assert (confidence == 0).all()
    whole, confidence = levels[2]
    columns = memberships.levels == 2
    weights = memberships.weights.toarray()[:, columns]
    np.testing.assert_allclose(confidence, weights.sum(1), rtol=1e-5)
    np.testing.assert_allclose(whole, unit(weights @ memberships.vectors[columns]), atol=1e-5)


def reference_median(weights: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Plain float64 Weiszfeld on the sphere, run to convergence."""
    centre = unit(weights @ vectors)
    for _ in range(300):
        distance = np.sqrt(np.maximum(2 - 2 * vectors @ centre, 1e-4))
        centre = unit((weights / distance) @ vectors)
    return centre


def test_median_outvotes_a_wrong_mask_that_the_mean_follows():
    rng = np.random.default_rng(0)
    good, bad = unit(rng.normal(size=(2, D)))
    noise = 0.05 * rng.normal(size=(10, D))
    vectors = unit(np.concatenate([np.tile(good, (7, 1)), np.tile(bad, (3, 1))]) + noise).astype(np.float32)
    memberships = Memberships(csr_matrix(np.ones((1, 10), np.float32)), np.full(10, 2), vectors)
    mean = next(v for i, (v, _) in enumerate(lift_vectors(memberships, robust=False)) if i == 2)[0]
    median = next(v for i, (v, _) in enumerate(lift_vectors(memberships, robust=True)) if i == 2)[0]
    assert median @ good > 0.98
    assert median @ good > mean @ good + 0.02
    # eight steps come within one degree of the converged median
    assert median @ reference_median(np.ones(10), vectors) > np.cos(np.radians(1))


def test_one_pass_is_the_weighted_mean_of_latents(gaussians):
    views = make_views(gaussians)
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


def test_no_masks_anywhere(gaussians):
    camera = random_camera(0, 8, 6)
    empty = ImageFeatures(np.full((3, 6, 8), -1, np.int32), np.zeros((0, D), np.float32))
    memberships = find_memberships(ReferenceRasterizer(), gaussians, [(camera, empty)])
    for vectors, confidence in lift_vectors(memberships, robust=True):
        assert (vectors == 0).all()
        assert (confidence == 0).all()
