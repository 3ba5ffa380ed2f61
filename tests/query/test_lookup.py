"""Relevancy of every Gaussian, by whatever the codec allows, against the definition."""

import math
from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import Array, sigmoid, unit
from langsplat_core.query.answers import peak_pixel
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.lookup import (
    build_lookup,
    build_table,
    decoded_relevancy,
    octahedral_to_sphere,
    sphere_to_octahedral,
    splatted_relevancy,
)
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import LanguageField, LinearCodec, Reading
from langsplat_core.scene.codec import CodebookCodec
from langsplat_core.semantics.relevancy import (
    CANONICAL,
    FLOOR,
    NARROWEST,
    TOP,
    Scale,
    latent_relevancy,
    relevancy,
    relevancy_of,
)
from tests.support.file_samples import random_field
from tests.support.query_scenes import D, random_codec, two_blob_scene

TOLERANCE = {"codebook": 1e-6, "linear": 1e-5, "autoencoder": 0.05}  # the last interpolates in a table


def scale_of(field: LanguageField, chance: bool) -> Scale:
    return Scale(field.canonical, field.everyday if chance else None, field.reading.temperature)


def plain_relevancy(vector: Array, phrase: Array, scale: Scale) -> float:
    """The definition, one meaning after the other, in float64."""
    vector, nearest = vector.astype(np.float64), float((scale.canonical @ vector).max())
    if scale.everyday is None:
        return 1 / (1 + math.exp(-scale.temperature * (float(phrase @ vector) - nearest)))
    cosines = sorted((float(other @ vector) for other in scale.everyday.astype(np.float64)), reverse=True)
    top = np.mean(cosines[: round(TOP * len(cosines))])
    zero = CANONICAL * nearest + (1 - CANONICAL) * top
    return 1 / (1 + math.exp(-(float(phrase @ vector) - zero) / np.std(cosines)))


@pytest.mark.parametrize("kind", ["codebook", "autoencoder", "linear"])
@pytest.mark.parametrize("temperature", [10.0, 25.0])
@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("chance", [False, True])
def test_every_lookup_finds_the_relevancy_of_what_latents_stand_for(kind, temperature, exact, chance):
    field = replace(random_field(300, kind), reading=Reading(temperature))
    field.confidence[1, 5:20] = 0
    scale = scale_of(field, chance)
    phrase = unit(np.random.default_rng(3).normal(size=field.codec.vector_dim)).astype(np.float32)
    got = next(build_lookup(field, scale, exact).relevancies(phrase[None]))
    vectors = field.codec.decode(field.latents.reshape(-1, field.latents.shape[2]))
    known = field.known.reshape(-1)
    want = [plain_relevancy(v, phrase, scale) if k else 0 for v, k in zip(vectors, known, strict=True)]
    assert np.abs(got - want).max() < (1e-5 if exact else TOLERANCE[kind])
    assert (got.reshape(3, 300)[1, 5:20] == 0).all()


def test_codeword_zero_is_a_meaning_like_any_other():
    field = random_field(10, "codebook")
    field.latents[:] = 0
    field.confidence[:] = 1
    field.confidence[2, 4] = 0
    lookup = build_lookup(field, scale_of(field, chance=False))
    values = next(lookup.relevancies(field.codec.vectors[:1])).reshape(3, 10)
    assert values[2, 4] == 0
    assert (np.delete(values[2], 4) > 0.5).all()


def test_margins_of_another_size_change_nothing():
    """All texts and meanings mixed with directions of their own lie closer together, as CLIP's do; what a
    phrase fits against everyday phrases stays, and as published it does not."""
    field = random_field(200, "codebook")
    dim, share = field.codec.vector_dim, 0.2

    def beside(vectors: Array, axis: int) -> Array:
        common = np.zeros((len(vectors), 2))
        common[:, axis] = math.sqrt(1 - share)
        return np.concatenate([math.sqrt(share) * vectors, common], 1).astype(np.float32)

    codec = CodebookCodec(beside(field.codec.vectors, 0), field.codec.palette)
    canonical, everyday = beside(field.canonical, 1), beside(field.everyday, 1)
    narrow = replace(field, codec=codec, canonical=canonical, everyday=everyday, phrasebook={})
    phrase = unit(np.random.default_rng(3).normal(size=dim))[None].astype(np.float32)
    for chance, tolerance in ((True, 1e-5), (False, None)):
        wide = next(build_lookup(field, scale_of(field, chance)).relevancies(phrase))
        close = next(build_lookup(narrow, scale_of(narrow, chance)).relevancies(beside(phrase, 1)))
        apart = np.abs(wide - close).max()
        assert apart < tolerance if tolerance else apart > 0.2


@pytest.mark.parametrize("everyday", [np.ones((1, 4)), np.eye(4)[[0] * 60], np.zeros((60, 4))])
def test_phrases_that_are_all_alike_are_no_scale_but_no_nan(everyday):
    scale = Scale(np.eye(4, dtype=np.float32)[:1], unit(everyday).astype(np.float32), 10.0)
    zero, rate = scale.of(np.eye(4, dtype=np.float32) @ scale.texts.T)
    values = relevancy_of(np.linspace(-1, 1, 4, dtype=np.float32), zero, rate)
    assert np.isfinite(values).all()
    assert ((values >= 0) & (values <= 1)).all()
    assert np.isfinite(scale.fit(values)).all()


def test_a_fit_is_relevancy_undone():
    fits = np.linspace(-6, 6, 50)
    for scale, rate in ((Scale(np.eye(2), np.eye(2), 7.0), 1), (Scale(np.eye(2), None, 7.0), 7)):
        np.testing.assert_allclose(scale.fit(sigmoid(fits)), fits / rate, atol=1e-9)
        ends = scale.fit(np.array([0.0, 1.0]))
        assert ends == pytest.approx(np.array([-1, 1]) * math.log((1 - NARROWEST) / NARROWEST) / rate)


@pytest.mark.parametrize("linear", [False, True])
def test_published_relevancy_is_the_minimum_of_pairwise_softmaxes(linear):
    """Of latents of any length: a blend keeps the meaning of its direction, and zero means nothing."""
    rng = np.random.default_rng(1)
    basis = np.linalg.qr(rng.normal(size=(D, 6)))[0].T.astype(np.float32)
    codec = LinearCodec(np.ascontiguousarray(basis)) if linear else random_codec(rng)
    latents = unit(rng.normal(size=(50, codec.latent_dim))).astype(np.float32)
    phrases, canonical = unit(rng.normal(size=(3, D))), unit(rng.normal(size=(4, D)))
    vectors = codec.decode(latents).astype(np.float64)
    pairs = np.exp(10 * (vectors @ phrases.T))[..., None], np.exp(10 * (vectors @ canonical.T))[:, None]
    want = (pairs[0] / (pairs[0] + pairs[1])).min(-1)
    np.testing.assert_allclose(relevancy(vectors, phrases, canonical), want, atol=1e-12)
    for length in (1.0, 0.02):
        got = latent_relevancy(codec, np.float32(length) * latents, phrases, canonical)
        np.testing.assert_allclose(got, want, atol=1e-5)
    assert (latent_relevancy(codec, 0 * latents, phrases, canonical) == 0).all()
    assert relevancy(vectors[:1], vectors[:1], vectors[:1]).tolist() == [[FLOOR]]


def test_octahedral_map_is_a_bijection_of_the_sphere():
    rng = np.random.default_rng(5)
    vectors = unit(rng.normal(size=(1000, 3)))
    vectors = np.concatenate([vectors, np.eye(3), -np.eye(3)])
    np.testing.assert_allclose(octahedral_to_sphere(sphere_to_octahedral(vectors)), vectors, atol=1e-12)
    uv = sphere_to_octahedral(vectors)
    assert uv.min() >= 0
    assert uv.max() <= 1


def test_table_agrees_with_exact_decoding_and_improves_with_resolution():
    rng = np.random.default_rng(6)
    codec = random_codec(rng)
    latents = unit(rng.normal(size=(4000, 3))).astype(np.float32)
    latents[:6] = np.concatenate([np.eye(3), -np.eye(3)])  # the fold's corners and edges
    phrases, canonical = unit(rng.normal(size=(5, D))), unit(rng.normal(size=(4, D)))
    exact = latent_relevancy(codec, latents, phrases, canonical)
    errors = {}
    for resolution in (48, 192):
        table = build_table(codec, latents, Scale(canonical, None, 10.0), resolution=resolution)
        got = np.stack(list(table.relevancies(phrases)), 1)
        errors[resolution] = np.abs(got - exact)
    assert errors[192].mean() < 3e-4
    assert errors[192].max() < 0.02  # at creases of the ReLU decoder
    assert errors[192].mean() < errors[48].mean() / 6  # bilinear: second order where smooth


def test_a_table_decodes_only_what_latents_lie_between():
    rng = np.random.default_rng(8)
    codec, canonical = random_codec(rng), unit(rng.normal(size=(4, D)))
    latents = np.repeat(unit(rng.normal(size=(5, 3))), 40, axis=0).astype(np.float32)
    latents[:40] = 0  # no meaning
    table = build_table(codec, latents, Scale(canonical, None, 10.0), resolution=64)
    assert len(table.used) == len(table.nodes.vectors) <= 4 * 4
    phrases = unit(rng.normal(size=(2, D)))
    got = np.stack(list(table.relevancies(phrases)), 1)
    np.testing.assert_allclose(got, latent_relevancy(codec, latents, phrases, canonical), atol=0.02)
    assert (got[:40] == 0).all()
    nothing = build_table(codec, np.zeros((7, 3), np.float32), Scale(canonical, None, 10.0))
    assert (next(nothing.relevancies(phrases)) == 0).all()


def test_both_orders_agree_inside_one_object_and_are_gated_outside():
    scene, *_ = two_blob_scene()
    assert scene.language is not None
    view = ReferenceRasterizer().view(scene.gaussians, scene.cameras[0])
    engine = QueryEngine(scene, rule="peak")
    phrase = engine.text_vector("left")
    ours = splatted_relevancy(view, engine.relevancy(phrase)[2][:, None], 0.3)[..., 0]
    paper = decoded_relevancy(view, scene.language, 2, phrase[None], 0.3)[..., 0]
    _, alpha = view.splat(np.ones((120, 1)))
    assert (ours[alpha <= 0.3] == 0).all()
    assert (paper[alpha <= 0.3] == 0).all()
    covered = alpha > 0.5
    np.testing.assert_allclose(ours[covered], paper[covered], atol=1e-3)  # the blobs do not overlap
    column, row, score = peak_pixel(ours, 5)
    assert column < 32
    assert score > 0.9
    assert alpha[row, column] > 0.3
