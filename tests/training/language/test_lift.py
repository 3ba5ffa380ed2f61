"""Lifting CLIP vectors from masks to Gaussians, against dense weights and a plain median; by gradient
descent, against automatic differentiation, torch's Adam and the one-pass mean."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from langsplat_core.arrays import Array, unit
from langsplat_core.config import LiftConfig
from langsplat_core.progress import WorkCancelledError
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import Camera, LinearCodec
from langsplat_core.semantics.store import ImageFeatures
from langsplat_core.training.language import lift
from langsplat_core.training.language.lift import lift_block, lift_by_gradient, lift_latents
from langsplat_core.training.language.mask_weights import find_mask_weights, group_masks
from tests.support.processes import stop_at
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


def test_mean_lift_weights_vectors_by_blending_weights(gaussians, lifting):
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


def test_lifting_a_sample_equals_its_rows_of_the_whole(lifting):
    mask_weights, groups = lifting
    whole = lift_block(mask_weights, groups, 0, robust=True)
    rows = np.array([0, 3, 7, 8, 22])
    again = replace(mask_weights, block_size=8)
    some = lift.lift_sample(again, groups, rows, robust=True)
    np.testing.assert_allclose(some.vectors, whole.vectors[:, rows], atol=1e-6)
    np.testing.assert_allclose(some.confidence, whole.confidence[:, rows], rtol=1e-6)
    assert lift.lift_sample(again, groups, rows[:0], robust=True).vectors.shape == (3, 0, LIFTED_DIM)


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
    # Of one Gaussian, at level "whole".
    weights = csr_matrix(np.repeat([[0, 0, 1]], 10, 1).astype(np.float32))
    mean = lift.lift_weights(weights, vectors, robust=False).vectors[2, 0]
    median = lift.lift_weights(weights, vectors, robust=True).vectors[2, 0]
    assert median @ good > 0.98
    assert median @ good > mean @ good + 0.02
    # eight steps come within one degree of the converged median
    assert median @ reference_median(np.ones(10), vectors) > np.cos(np.radians(1))


def test_views_without_masks_lift_nothing(gaussians):
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
    assert not latents[0].any()
    assert not confidence[0].any()
    seen = weight > 0
    np.testing.assert_allclose(np.linalg.norm(latents[1][seen], axis=1), 1, atol=1e-5)


# Lifting by gradient descent.

D = 4
CODEC = LinearCodec(np.eye(3, D, dtype=np.float32))
GAUSSIANS = random_gaussians(40, 2, scale_range=(0.1, 0.4))
SHORT = LiftConfig(mode="gradient", steps=60, lr=0.01)


def views() -> list[tuple[Camera, ImageFeatures]]:
    """Pictures split in two halves of the world, left and right."""
    found = []
    for seed in range(4):
        camera = random_camera(seed, 40, 30)
        column = camera.project(np.zeros((1, 3)))[0][0, 0]
        labels = np.full((3, 30, 40), -1, np.int32)
        labels[2] = (np.arange(40) > column)[None]
        labels[1] = 2 + labels[2]
        found.append((camera, ImageFeatures(labels, np.eye(D, dtype=np.float32)[[0, 1, 1, 2]])))
    return found


def l1(latents: Array, pairs: list[tuple[Camera, ImageFeatures]]) -> float:
    """Mean masked difference over all views and levels, by the float64 reference."""
    total, raster = [], load_lifting_rasterizer("reference")
    for camera, features in pairs:
        for level in (1, 2):
            drawn = raster.view(GAUSSIANS, camera).splat(latents[level])[0]
            total.append(np.abs(drawn - CODEC.encode(features.vectors)[features.labels[level]]).mean())
    return float(np.mean(total))


@pytest.mark.long
def test_descent_from_the_mean_lowers_the_loss():
    pairs = views()
    cpu = load_lifting_rasterizer("cpu")
    start, confidence = lift_latents(cpu, GAUSSIANS, pairs, CODEC)
    latents, same = lift_by_gradient(cpu, GAUSSIANS, pairs, CODEC, replace(SHORT, steps=300))
    np.testing.assert_array_equal(confidence, same)
    assert l1(latents, pairs) < l1(start, pairs)
    assert not latents[0].any()  # no masks at this level
    lengths = np.linalg.norm(latents[2], axis=1)
    np.testing.assert_allclose(lengths[confidence[2] > 0], 1, atol=1e-5)


@pytest.mark.long
def test_frozen_weights_lead_to_the_same_latents():
    pairs = views()
    fast = lift_by_gradient(load_lifting_rasterizer("cpu"), GAUSSIANS, pairs, CODEC, SHORT)[0]
    slow = lift_by_gradient(load_lifting_rasterizer("reference"), GAUSSIANS, pairs, CODEC, SHORT)[0]
    cosines = (unit(fast[2]) * unit(slow[2])).sum(1)
    assert np.median(cosines) > 0.9999  # the sign of a difference near zero may turn: single ones move
    assert l1(fast, pairs) == pytest.approx(l1(slow, pairs), abs=2e-3)


@pytest.mark.long
def test_published_start_learns_more_slowly():
    pairs, cpu = views(), load_lifting_rasterizer("cpu")
    from_mean = l1(lift_by_gradient(cpu, GAUSSIANS, pairs, CODEC, SHORT)[0], pairs)
    published = replace(SHORT, start="zeros-as-published")
    assert l1(lift_by_gradient(cpu, GAUSSIANS, pairs, CODEC, published)[0], pairs) > 1.2 * from_mean


@pytest.mark.long
def test_published_normalisation_has_its_exact_gradient():
    import torch

    rng = np.random.default_rng(0)
    x, by_y = rng.normal(size=(3, 5, 4)), rng.normal(size=(3, 5, 4))
    x[0, 0] = 0
    leaf = torch.tensor(x, requires_grad=True)
    y = leaf / (torch.linalg.vector_norm(leaf, dim=-1, keepdim=True) + 1e-9)
    np.testing.assert_allclose(lift.blended(x), y.detach().numpy(), atol=1e-12)
    (want,) = torch.autograd.grad(y, leaf, torch.tensor(by_y))
    np.testing.assert_allclose(lift.by_features(x, by_y), want.numpy(), rtol=1e-9, atol=1e-9)


@pytest.mark.long
def test_gradient_lift_is_deterministic_and_interruptible():
    pairs, cpu = views(), load_lifting_rasterizer("cpu")
    one, two = (lift_by_gradient(cpu, GAUSSIANS, pairs, CODEC, SHORT)[0] for _ in range(2))
    np.testing.assert_array_equal(one, two)
    other = lift_by_gradient(cpu, GAUSSIANS, pairs, CODEC, replace(SHORT, seed=1))[0]
    assert not np.array_equal(one, other)
    with pytest.raises(WorkCancelledError):
        lift_by_gradient(cpu, GAUSSIANS, pairs, CODEC, SHORT, progress=stop_at("training language features"))
