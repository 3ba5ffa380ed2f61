"""Spherical k-means: known clusters are found, and the hard cases give fewer centres, never broken ones."""

import numpy as np
import pytest

from langsplat_core.arrays import unit
from langsplat_core.training.language.mask_weights import nearest_centres, spherical_kmeans


def clusters(count: int, each: int, dim: int = 32, noise: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(count)
    centres = unit(rng.normal(size=(count, dim)))
    vectors = unit(np.repeat(centres, each, 0) + noise * rng.normal(size=(count * each, dim)))
    return vectors.astype(np.float32), np.repeat(np.arange(count), each)


def spread(vectors: np.ndarray, centres: np.ndarray) -> float:
    return float(1 - nearest_centres(vectors, centres)[1].mean())


def test_nearest_is_the_largest_cosine():
    vectors, _ = clusters(5, 40)
    centres = unit(np.random.default_rng(1).normal(size=(7, 32))).astype(np.float32)
    nearest, cosines = nearest_centres(vectors, centres)
    products = vectors.astype(np.float64) @ centres.T
    np.testing.assert_array_equal(nearest, products.argmax(1))
    np.testing.assert_allclose(cosines, products.max(1), atol=1e-6)


def test_separate_clusters_are_found():
    vectors, labels = clusters(40, 25)
    centres = spherical_kmeans(vectors, 40)
    np.testing.assert_allclose(np.linalg.norm(centres, axis=1), 1, atol=1e-5)
    nearest, _ = nearest_centres(vectors, centres)
    assert len({(a, b) for a, b in zip(nearest, labels, strict=True)}) <= 44  # all but a few in their own
    assert spread(vectors, centres) < 0.02


def test_more_centres_fit_better_and_a_start_is_kept():
    vectors, _ = clusters(60, 20, noise=0.1)
    spreads, start = [], None
    for count in (5, 10, 20, 40):
        start = spherical_kmeans(vectors, count, rounds=4, start=start)
        assert len(start) == count
        spreads.append(spread(vectors, start))
    assert spreads == sorted(spreads, reverse=True)
    assert spreads[-1] < 0.6 * spreads[0]


@pytest.mark.parametrize("different", [1, 3])
def test_fewer_different_vectors_than_centres(different):
    vectors = np.repeat(np.eye(8, dtype=np.float32)[:different], 50, 0)
    centres = spherical_kmeans(vectors, 10)
    assert sorted(centres.argmax(1)) == list(range(different))
    assert spread(vectors, centres) < 1e-6


def test_the_same_seed_gives_the_same_centres():
    vectors, _ = clusters(30, 20, noise=0.3)
    made = [spherical_kmeans(vectors, 12, generator=np.random.default_rng(3)) for _ in range(2)]
    np.testing.assert_array_equal(*made)
