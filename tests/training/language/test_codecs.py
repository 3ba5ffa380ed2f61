"""Codecs of every kind: what they answer, fitting, storage; k-means, which finds codewords; their colours."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from langsplat_core.arrays import Array, unit
from langsplat_core.config import CodecConfig
from langsplat_core.progress import Progress
from langsplat_core.scene import NO_NODE, Codec, Gaussians, LanguageField, LinearCodec, codec_from_tensors
from langsplat_core.scene.codec import KINDS, CodebookCodec, principal_colours
from langsplat_core.scene.surface import build_surface
from langsplat_core.semantics.relevancy import Scale
from langsplat_core.training.language.codec_fit import (
    Vocabulary,
    codec_report,
    contrasting_colours,
    fit_codebook,
    fit_codec,
    folded_layers,
    nearest_centres,
    relevancy_error,
    rounded,
    spherical_kmeans,
)
from tests.support.file_samples import random_field
from tests.support.scenes import tree_of_wholes, unturned_gaussians

pytestmark = pytest.mark.long


D = 48
TEXTS = unit(np.random.default_rng(9).normal(size=(24, D))).astype(np.float32)
WORDS = Vocabulary(TEXTS[4:], Scale(TEXTS[:4], TEXTS[4:], 10.0))
QUICK = {
    "codebook": CodecConfig(size=9),
    "autoencoder": CodecConfig("autoencoder", latent_dim=4, steps=20),
    "linear": CodecConfig("linear", latent_dim=4),
}


def clusters(count: int, each: int, noise: float = 0.02, seed: int = 0) -> tuple[Array, Array]:
    """Shuffled (M, D) unit vectors around `count` centres, and the centre of each."""
    rng = np.random.default_rng(seed)
    labels = rng.permutation(np.repeat(np.arange(count), each))
    vectors = unit(rng.normal(size=(count, D)))[labels]
    return unit(vectors + noise * rng.normal(size=vectors.shape)).astype(np.float32), labels


@pytest.fixture(params=sorted(KINDS))
def codec(request: pytest.FixtureRequest) -> Codec:
    return fit_codec(clusters(12, 10)[0], QUICK[request.param], WORDS)


# What every codec answers.


def test_codecs_survive_storage(codec: Codec) -> None:
    vectors, _ = clusters(12, 10)
    latents = codec.encode(vectors)
    assert (latents.dtype, latents.shape) == (codec.dtype, (120, codec.latent_dim))
    again = codec_from_tensors(codec.kind, codec.tensors())
    assert type(again) is type(codec)
    np.testing.assert_array_equal(again.encode(vectors), latents)
    np.testing.assert_array_equal(again.decode(latents), codec.decode(latents))
    assert codec.known(latents).all()
    codec.check(latents)


def test_cosines_are_those_of_what_is_decoded(codec: Codec) -> None:
    latents = codec.encode(clusters(12, 10)[0])
    if codec.blends:
        latents = 0.3 * latents / np.linalg.norm(latents, axis=1, keepdims=True)  # blended latents are short
        latents[5] = 0
        assert codec.known(latents).tolist() == [row != 5 for row in range(120)]
    texts = unit(np.random.default_rng(2).normal(size=(7, D))).astype(np.float32)
    want = codec.decode(latents if not codec.blends else latents / 0.3).astype(np.float64) @ texts.T
    if codec.blends:
        want[5] = 0
    for rows in (slice(None), slice(3, 6)):  # many and few
        got = codec.cosines(latents[rows], texts)
        assert got.dtype == np.float32
        np.testing.assert_allclose(got, want[rows], atol=2e-6)


def test_latents_have_distances_and_colours(codec: Codec) -> None:
    latents = codec.encode(clusters(12, 10)[0])
    distinct, of = codec.unique(latents)
    np.testing.assert_array_equal(distinct[of], latents)
    if not codec.blends:
        assert len(distinct) == len(np.unique(latents)) == 9
    rng = np.random.default_rng(3)
    directions = codec.directions(latents).astype(np.float64)
    every = 1 - directions @ directions.T
    for count in (50, 20_000):  # fewer and more pairs than distinct ones
        first, second = rng.integers(120, size=(2, count))
        np.testing.assert_allclose(codec.distances(latents, first, second), every[first, second], atol=1e-6)
    assert codec.spread(latents) == pytest.approx(every.mean(), abs=1e-6)
    colours = codec.colours(latents, np.ones(120))
    assert (colours.dtype, colours.shape) == (np.float32, (120, 3))
    assert 0 <= colours.min() <= colours.max() <= 1


# Fitting.


@pytest.mark.parametrize("d", [2, 3])
def test_autoencoder_keeps_a_scenes_vectors_apart(d: int) -> None:
    vectors, labels = clusters(12, 34)
    made = fit_codec(vectors, CodecConfig("autoencoder", latent_dim=d, steps=700, batch=128, lr=2e-3), WORDS)
    latents = made.encode(vectors)
    np.testing.assert_allclose(np.linalg.norm(latents, axis=1), 1, atol=1e-5)
    assert codec_report(made, vectors, WORDS).cosine > 0.9
    # what a query needs: the decoded vector is closest to its own cluster
    centres = unit(np.stack([vectors[labels == c].mean(0) for c in range(12)]))
    assert ((made.decode(latents) @ centres.T).argmax(1) == labels).mean() > 0.97


def test_linear_codec_is_the_best_subspace() -> None:
    vectors, _ = clusters(12, 34)
    made = fit_codec(vectors, CodecConfig("linear", latent_dim=6), WORDS)
    assert isinstance(made, LinearCodec)
    np.testing.assert_allclose(made.basis @ made.basis.T, np.eye(6), atol=1e-5)
    singular = np.linalg.svd(vectors.astype(np.float64), compute_uv=False)
    assert ((vectors @ made.basis.T) ** 2).sum() == pytest.approx((singular[:6] ** 2).sum(), rel=1e-5)


def test_folding_batch_normalisation_changes_nothing() -> None:
    torch.manual_seed(0)
    nn = torch.nn
    network = nn.Sequential(nn.Linear(32, 16), nn.BatchNorm1d(16), nn.ReLU(), nn.Linear(16, 3))
    data = torch.randn(200, 32)
    for _ in range(5):
        network(data)
    with torch.no_grad():
        want = network.eval()(data).numpy()
    (w1, b1), (w2, b2) = folded_layers(network)
    np.testing.assert_allclose(np.maximum(data.numpy() @ w1.T + b1, 0) @ w2.T + b2, want, atol=2e-5)


def test_codebook_is_the_smallest_within_its_error_budget() -> None:
    vectors, _ = clusters(100, 20, noise=0.01)
    sizes = []
    for budget in (0.15, 0.06, 0.02):
        shares = [0.0]
        told = Progress(lambda at, shares=shares: shares.append(at.fraction))
        made = fit_codebook(vectors, CodecConfig(max_relevancy_error=budget), WORDS, told)
        assert shares == sorted(shares)
        sizes.append(made.size)
        # judged on all vectors, chosen by a fifth of them
        assert codec_report(made, vectors, WORDS).error_mean < 1.05 * budget
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[-1]
    half = fit_codebook(vectors, CodecConfig(size=sizes[1] // 2), WORDS)
    assert codec_report(half, vectors, WORDS).error_mean > 0.06


@pytest.mark.parametrize(("count", "each"), [(9, 100), (1, 1), (2, 1), (7, 1)])
def test_few_distinct_vectors_get_few_codewords(count: int, each: int) -> None:
    vectors, _ = clusters(count, each, noise=0.0)
    made = fit_codebook(vectors, CodecConfig(), WORDS)
    assert 1 <= made.size <= count
    if each > 1:
        assert made.size == count
        assert codec_report(made, vectors, WORDS).error_mean < 1e-3


def test_similar_codewords_have_similar_float16_colours() -> None:
    vectors, _ = clusters(12, 300, noise=0.03)
    made = fit_codebook(vectors, CodecConfig(size=60), WORDS)
    for numbers in (made.vectors, made.palette):
        np.testing.assert_array_equal(rounded(numbers), numbers)
    assert np.ptp(made.palette, axis=0).min() > 0.5
    cosines = made.vectors @ made.vectors.T
    distance = np.linalg.norm(made.palette[:, None] - made.palette, axis=2)
    same = ~np.eye(60, dtype=bool) & (cosines > 0.9)
    assert same.any()
    assert distance[same].mean() < 0.5 * distance[cosines < 0.5].mean()


def test_errors_are_differences_of_relevancy() -> None:
    vectors, _ = clusters(5, 4)
    assert relevancy_error(vectors, vectors, WORDS) == (0, 0)
    swapped = vectors[::-1]
    difference = np.abs(WORDS.relevancy(swapped) - WORDS.relevancy(vectors))
    mean, p99 = relevancy_error(swapped, vectors, WORDS)
    assert mean == pytest.approx(difference.mean(), rel=1e-5)
    assert p99 == pytest.approx(np.quantile(difference, 0.99), rel=1e-4)


# Spherical k-means.


def apart(vectors: Array, centres: Array) -> float:
    return float(1 - nearest_centres(vectors, centres)[1].mean())


def test_separate_clusters_are_found_the_same_for_the_same_seed() -> None:
    vectors, labels = clusters(40, 25)
    centres, again = (spherical_kmeans(vectors, 40, generator=np.random.default_rng(3)) for _ in range(2))
    np.testing.assert_array_equal(centres, again)
    np.testing.assert_allclose(np.linalg.norm(centres, axis=1), 1, atol=1e-5)
    nearest = nearest_centres(vectors, centres)[0]
    assert len({(a, b) for a, b in zip(nearest, labels, strict=True)}) <= 44  # all but a few in their own
    assert apart(vectors, centres) < 0.02


def test_more_centres_fit_better_and_a_start_is_kept() -> None:
    vectors, _ = clusters(60, 20, noise=0.1)
    spreads, start = [], None
    for count in (5, 10, 20, 40):
        start = spherical_kmeans(vectors, count, rounds=4, start=start)
        assert len(start) == count
        spreads.append(apart(vectors, start))
    assert spreads == sorted(spreads, reverse=True)
    assert spreads[-1] < 0.6 * spreads[0]


# Colours of codewords: neighbours are told apart, whatever else is large.

SIDE, THINGS = 40, 8


def sheet() -> Gaussians:
    """SIDE x SIDE small discs in a plane."""
    x, y = np.divmod(np.arange(SIDE * SIDE), SIDE)
    return unturned_gaussians(np.stack([x, y, 0 * x], 1) * 0.1, np.log(0.07), 4.0)


def field_of(things: Array, vectors: Array) -> LanguageField:
    """Of things (N,), each with its own codeword; NO_NODE means nothing."""
    usage = np.bincount(things[things != NO_NODE], minlength=len(vectors)).astype(float)
    codec = CodebookCodec(vectors, principal_colours(vectors, usage))
    codes = np.where(things == NO_NODE, 0, things).astype(np.uint16)
    return replace(
        random_field(len(things), "codebook"),
        codec=codec,
        canonical=vectors[:4],
        everyday=None,
        phrasebook={},
        latents=np.tile(codes[None, :, None], (3, 1, 1)),
        confidence=np.tile((things != NO_NODE).astype(np.float32), (3, 1)),
        tree=tree_of_wholes(things),
    )


def rooms(seed: int) -> tuple[Gaussians, LanguageField]:
    """Small things in a row on a large wall; things are nearly alike, the wall and the floor are not."""
    rng = np.random.default_rng(seed)
    x, y = np.divmod(np.arange(SIDE * SIDE), SIDE)
    things = np.where(y < 12, 8, 9)
    on = (y > 8) & (y < 16)
    things[on] = x[on] * THINGS // SIDE
    alike = unit(rng.normal(size=32))
    small = unit(alike + 0.06 * rng.normal(size=(THINGS, 32)))
    large = unit(rng.normal(size=(2, 32)))
    return sheet(), field_of(things, np.concatenate([small, large]).astype(np.float32))


def test_neighbours_differ_more_than_by_the_axes_of_everything():
    for seed in range(5):
        gaussians, field = rooms(seed)
        found = contrasting_colours(field, field.tree, build_surface(gaussians))
        assert found.shape == (THINGS + 2, 3)
        assert 0 <= found.min() < found.max() <= 1
        steps = (np.diff(colours[:THINGS], axis=0) for colours in (found, field.codec.palette))
        found_least, usual_least = (np.linalg.norm(own, axis=1).min() for own in steps)
        assert found_least > 1.5 * usual_least


def test_scenes_without_neighbours_have_no_colours():
    vectors = unit(np.random.default_rng(0).normal(size=(3, 32))).astype(np.float32)
    for thing in (NO_NODE, 0):
        field = field_of(np.full(SIDE * SIDE, thing), vectors)
        assert contrasting_colours(field, field.tree, build_surface(sheet())) is None
