"""Sums over regions and what is spread from them, against the plain way; many phrases against one by one."""

import numpy as np
import pytest

from langsplat_core.arrays import unit
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.surface import Regions, Surface, build_regions, build_surface
from langsplat_core.scene import LanguageField, Scene
from tests.support.fakes import FakeEncoder, blob_scene
from tests.support.file_samples import random_field
from tests.support.scenes import random_gaussians

COUNT = 3000


def plain_means(surface: Surface, regions: Regions, values: np.ndarray) -> list[np.ndarray]:
    """Region by region, in float64."""
    weights = surface.weights.astype(np.float64)
    of_surface = values.astype(np.float64)[:, surface.rows]
    return [
        np.array([np.average(row[of == r], weights=weights[of == r]) for r in range(of.max(initial=-1) + 1)])
        for of, row in zip(regions.of, of_surface, strict=True)
    ]


@pytest.fixture(scope="module")
def scattered() -> tuple[Scene, Surface, Regions]:
    """Random Gaussians, a third of them faint and some far from all others."""
    rng = np.random.default_rng(4)
    gaussians = random_gaussians(COUNT)
    gaussians.means[:] = rng.normal(size=(COUNT, 3))
    gaussians.means[:20] *= 100
    gaussians.opacity_logits[:] = rng.choice([-4.0, 1.0], COUNT, p=[1 / 3, 2 / 3])
    field = random_field(COUNT, "codebook")
    surface = build_surface(gaussians)
    return Scene(gaussians, field), surface, build_regions(surface, field)


def test_means_of_regions_are_those_of_the_plain_way(scattered):
    _, surface, regions = scattered
    values = np.random.default_rng(5).uniform(size=(3, COUNT)).astype(np.float32)
    for got, want in zip(regions.means(values), plain_means(surface, regions, values), strict=True):
        assert len(want) > 1
        np.testing.assert_allclose(got, want, rtol=1e-12)


def test_what_is_spread_reaches_faint_ones_beside_a_region_and_no_others(scattered):
    _, surface, regions = scattered
    others = np.random.default_rng(6).uniform(size=COUNT).astype(np.float32)
    for level, of in enumerate(regions.of):
        values = np.arange(len(regions.sizes[level]), dtype=np.float32)
        want = np.array(
            [values[of[a]] if a >= 0 else o for a, o in zip(surface.anchors, others, strict=True)]
        )
        np.testing.assert_array_equal(regions.spread(level, values, others), want)
    assert 0 < (surface.anchors < 0).sum() < COUNT / 3 < (regions.weights == 0).sum()


def test_the_evened_map_is_the_mean_of_each_region(scattered):
    scene, surface, regions = scattered
    relevancy = np.random.default_rng(7).uniform(size=(3, COUNT)).astype(np.float32)
    even = QueryEngine(scene).evened(relevancy)
    for row, of, means in zip(even, regions.of, plain_means(surface, regions, relevancy), strict=True):
        np.testing.assert_allclose(row[surface.rows], means[of], rtol=1e-6)
    np.testing.assert_array_equal(even[:, surface.anchors < 0], relevancy[:, surface.anchors < 0])


def test_a_scene_without_a_valid_gaussian_has_no_regions():
    gaussians = random_gaussians(5)
    gaussians.means[:] = np.nan
    field = random_field(5, "codebook")
    regions = build_regions(build_surface(gaussians), field)
    assert [len(row) for row in regions.means(np.ones((3, 5)))] == [0, 0, 0]
    np.testing.assert_array_equal(regions.spread(0, np.zeros(0, np.float32), np.ones(5, np.float32)), 1)


@pytest.mark.parametrize("kind", ["codebook", "autoencoder", "linear"])
@pytest.mark.parametrize("rule", ["regions", "peak"])
@pytest.mark.parametrize("exact", [False, True])
def test_many_phrases_together_are_answered_as_one_by_one(kind, rule, exact):
    field = random_field(400, kind)
    vectors = unit(np.random.default_rng(8).normal(size=(20, field.codec.vector_dim))).astype(np.float32)
    book = {f"phrase {number}": vector for number, vector in enumerate(vectors)}
    asked = LanguageField(field.latents, field.confidence, field.codec, field.canonical, "none", book)
    engine = QueryEngine(Scene(random_gaussians(400), asked), exact=exact, rule=rule)
    many = engine.run_many([*book, "Phrase 3"])
    assert [result.phrase for result in many] == [*book, "Phrase 3"]
    for phrase, together in zip([*book, "phrase 3"], many, strict=True):
        alone = engine.run(phrase)
        assert (together.level, together.found) == (alone.level, alone.found)
        np.testing.assert_allclose(together.relevancy, alone.relevancy, atol=1e-6)
        np.testing.assert_allclose(together.even, alone.even, atol=1e-6)
        np.testing.assert_allclose(together.scores, alone.scores, atol=1e-6)
        differ = together.members != alone.members  # at most where rounding decides
        np.testing.assert_allclose(alone.even[differ], min(alone.cut, together.cut), atol=1e-5)


def test_many_phrases_are_encoded_in_one_batch_or_not_at_all():
    class Counting(FakeEncoder):
        batches: list[int] = []  # noqa: RUF012  one test's

        def encode_texts(self, texts):
            self.batches.append(len(texts))
            return super().encode_texts(texts)

    encoder = Counting()
    engine = QueryEngine(blob_scene(), lambda _: encoder)
    assert engine.run_many([]) == []
    with pytest.raises(EncoderError, match="'flurb'"):
        engine.run_many(["mug", "flurb"])
    with pytest.raises(InputError, match="empty"):
        engine.run_many(["mug", " "])
    assert encoder.batches == []
    assert len(engine.run_many(["mug", "book", "Mug"])) == 3
    assert sorted(encoder.batches) == [2, 4]  # the phrases, and the canonical ones that prove the encoder
