"""Codebooks: the size follows from the error budget, codewords and colours can be stored as they are."""

import logging

import numpy as np
import pytest

from langsplat_core.arrays import unit
from langsplat_core.config import CodecConfig
from langsplat_core.training.language import codec_fit
from langsplat_core.training.language.codec_fit import (
    codebook_error,
    codec_report,
    fit_codebook,
    relevancy_error,
    rounded,
)
from tests.support.vocabulary import random_vocabulary

pytestmark = pytest.mark.long

D = 48
WORDS = random_vocabulary(D)


@pytest.fixture(autouse=True)
def quick_colours(monkeypatch, request):
    """What is not about colours does not wait for them."""
    if "colours" not in request.node.name:
        monkeypatch.setattr(codec_fit, "COLOUR_STEPS", 20)


def meanings(count: int = 100, each: int = 20, noise: float = 0.05, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    vectors = np.repeat(unit(rng.normal(size=(count, D))), each, 0)
    vectors = unit(vectors + noise * rng.normal(size=vectors.shape))
    return vectors[rng.permutation(len(vectors))].astype(np.float32)


def test_the_size_is_the_smallest_that_keeps_the_budget():
    vectors = meanings(noise=0.01)
    sizes, errors = [], []
    for budget in (0.15, 0.06, 0.02):
        codec = fit_codebook(vectors, CodecConfig(max_relevancy_error=budget), WORDS)
        sizes.append(codec.index_size)
        errors.append(codec_report(codec, vectors, WORDS).error_mean)
        assert errors[-1] < 1.05 * budget  # judged on all vectors, chosen by a fifth of them
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[-1]
    half = fit_codebook(vectors, CodecConfig(size=sizes[1] // 2), WORDS)
    assert codec_report(half, vectors, WORDS).error_mean > 0.06


def test_a_scene_with_few_meanings_gets_few_codewords():
    vectors = meanings(count=9, each=100, noise=0.0)
    codec = fit_codebook(vectors, CodecConfig(), WORDS)
    assert codec.index_size == 9
    assert codec_report(codec, vectors, WORDS).error_mean < 1e-3


def test_a_fixed_size_is_that_size_and_the_numbers_are_float16():
    codec = fit_codebook(meanings(), CodecConfig(size=33), WORDS)
    assert codec.vectors.shape == (33, D)
    np.testing.assert_array_equal(rounded(codec.vectors), codec.vectors)
    np.testing.assert_array_equal(rounded(codec.colours), codec.colours)
    assert codec.colours.min() >= 0
    assert codec.colours.max() <= 1
    assert np.ptp(codec.colours, axis=0).min() > 0.5


def test_near_codewords_have_near_colours():
    vectors = meanings(count=12, each=300, noise=0.03)
    codec = fit_codebook(vectors, CodecConfig(size=60), WORDS)
    cosines = codec.vectors @ codec.vectors.T
    distance = np.linalg.norm(codec.colours[:, None] - codec.colours, axis=2)
    off = ~np.eye(60, dtype=bool)
    same, different = off & (cosines > 0.9), cosines < 0.5
    assert same.any()
    assert distance[same].mean() < 0.5 * distance[different].mean()


def test_a_budget_that_cannot_be_kept_is_said(caplog):
    vectors = unit(np.random.default_rng(0).normal(size=(900, D))).astype(np.float32)
    with caplog.at_level(logging.WARNING, "langsplat"):
        codec = fit_codebook(vectors, CodecConfig(max_relevancy_error=1e-4), WORDS)
    assert codec.index_size <= 900 // 4
    assert "still have a mean relevancy error" in caplog.text


@pytest.mark.parametrize("count", [1, 2, 7])
def test_almost_no_vectors(count):
    vectors = meanings(count=count, each=1)
    codec = fit_codebook(vectors, CodecConfig(), WORDS)
    assert 1 <= codec.index_size <= count


def test_errors_are_differences_of_relevancy():
    vectors = meanings(count=5, each=4)
    exact = relevancy_error(vectors, vectors, WORDS)
    assert (exact.mean, exact.p99) == (0, 0)
    swapped = vectors[::-1]
    difference = np.abs(WORDS.relevancy(swapped) - WORDS.relevancy(vectors))
    error = relevancy_error(swapped, vectors, WORDS)
    assert error.mean == pytest.approx(difference.mean(), rel=1e-5)
    assert error.p99 == pytest.approx(np.quantile(difference, 0.99), rel=1e-4)
    assert codebook_error(vectors, vectors, WORDS).mean < 1e-6
