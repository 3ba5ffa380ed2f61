"""Lifting by gradient descent against automatic differentiation, torch's Adam and the one-pass mean."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from langsplat_core.arrays import Array, unit
from langsplat_core.config import LiftConfig
from langsplat_core.progress import Cancelled
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.scene import Camera, LinearCodec
from langsplat_core.semantics.store import ImageFeatures
from langsplat_core.training.language.lift import blended, by_features, lift_by_gradient, lift_latents
from tests.support.processes import stop_at
from tests.support.scenes import random_camera, random_gaussians

pytestmark = pytest.mark.long

D = 4
CODEC = LinearCodec(np.eye(3, D, dtype=np.float32))
GAUSSIANS = random_gaussians(40, 2, scale_range=(0.1, 0.4))
SHORT = LiftConfig(mode="gradient", steps=60, lr=0.01)


def views(count: int = 4, wrong: float = 0.0) -> list[tuple[Camera, ImageFeatures]]:
    """Pictures split in two halves of the world, left and right, with a share of wrong labels per view."""
    found = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        camera = random_camera(seed, 40, 30)
        column = camera.project(np.zeros((1, 3)))[0][0, 0]
        labels = np.full((3, 30, 40), -1, np.int32)
        labels[2] = (np.arange(40) > column)[None]
        labels[1] = 2 + labels[2]
        if rng.random() < wrong:
            labels[2] = 1 - labels[2]
        vectors = np.eye(D, dtype=np.float32)[[0, 1, 1, 2]]
        found.append((camera, ImageFeatures(labels, vectors)))
    return found


def l1(latents: Array, pairs: list[tuple[Camera, ImageFeatures]]) -> float:
    """Mean masked difference over all views and levels, by the float64 reference."""
    total, raster = [], load_lifting_rasterizer("reference")
    for camera, features in pairs:
        for level in (1, 2):
            drawn = raster.view(GAUSSIANS, camera).splat(latents[level])[0]
            total.append(np.abs(drawn - CODEC.encode(features.vectors)[features.labels[level]]).mean())
    return float(np.mean(total))


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


def test_frozen_weights_change_nothing_that_matters():
    pairs = views()
    fast = lift_by_gradient(load_lifting_rasterizer("cpu"), GAUSSIANS, pairs, CODEC, SHORT)[0]
    slow = lift_by_gradient(load_lifting_rasterizer("reference"), GAUSSIANS, pairs, CODEC, SHORT)[0]
    cosines = (unit(fast[2]) * unit(slow[2])).sum(1)
    assert np.median(cosines) > 0.9999  # the sign of a difference near zero may turn: single ones move
    assert l1(fast, pairs) == pytest.approx(l1(slow, pairs), abs=2e-3)


def test_zeros_as_published_waste_their_first_steps():
    pairs, cpu = views(), load_lifting_rasterizer("cpu")
    from_mean = l1(lift_by_gradient(cpu, GAUSSIANS, pairs, CODEC, SHORT)[0], pairs)
    published = replace(SHORT, start="zeros-as-published")
    assert l1(lift_by_gradient(cpu, GAUSSIANS, pairs, CODEC, published)[0], pairs) > 1.2 * from_mean


def test_the_gradient_through_the_published_normalisation():
    rng = np.random.default_rng(0)
    x, by_y = rng.normal(size=(3, 5, 4)), rng.normal(size=(3, 5, 4))
    x[0, 0] = 0
    leaf = torch.tensor(x, requires_grad=True)
    y = leaf / (torch.linalg.vector_norm(leaf, dim=-1, keepdim=True) + 1e-9)
    np.testing.assert_allclose(blended(x, True), y.detach().numpy(), atol=1e-12)
    (want,) = torch.autograd.grad(y, leaf, torch.tensor(by_y))
    np.testing.assert_allclose(by_features(x, by_y), want.numpy(), rtol=1e-9, atol=1e-9)


def test_it_is_deterministic_and_can_be_interrupted():
    pairs, cpu = views(), load_lifting_rasterizer("cpu")
    one, two = (lift_by_gradient(cpu, GAUSSIANS, pairs, CODEC, SHORT)[0] for _ in range(2))
    np.testing.assert_array_equal(one, two)
    other = lift_by_gradient(cpu, GAUSSIANS, pairs, CODEC, replace(SHORT, seed=1))[0]
    assert not np.array_equal(one, other)

    with pytest.raises(Cancelled):
        lift_by_gradient(cpu, GAUSSIANS, pairs, CODEC, SHORT, progress=stop_at("training language features"))
