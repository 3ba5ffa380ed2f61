"""Relevancy, the sphere table, levels, places and pixels."""

import numpy as np
import pytest

from langsplat_core.arrays import unit
from langsplat_core.errors import EncoderError, InputError, UnknownWordError
from langsplat_core.query.answers import locate, peak_pixel
from langsplat_core.query.compose import check_phrase, run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.lookup import (
    build_table,
    decoded_relevancy,
    octahedral_to_sphere,
    sphere_to_octahedral,
    splatted_relevancy,
)
from langsplat_core.query.surface import build_surface
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import LanguageField, LinearCodec, Scene
from langsplat_core.semantics.relevancy import FLOOR, Scale, latent_relevancy, relevancy
from tests.support.fakes import WORDS, FakeEncoder, blob_scene
from tests.support.two_blobs import D, random_codec, two_blob_scene


def test_relevancy_is_the_minimum_of_pairwise_softmaxes():
    rng = np.random.default_rng(1)
    vectors, phrases, canonical = (unit(rng.normal(size=(n, D))) for n in (50, 3, 4))
    got = relevancy(vectors, phrases, canonical)
    for i, vector in enumerate(vectors):
        for j, phrase in enumerate(phrases):
            pairs = [np.exp(10 * np.array([vector @ phrase, vector @ c])) for c in canonical]
            assert got[i, j] == pytest.approx(min(p[0] / p.sum() for p in pairs), abs=1e-12)


def test_latents_of_length_zero_mean_nothing():
    rng = np.random.default_rng(2)
    codec = random_codec(rng)
    phrase, canonical = unit(rng.normal(size=(1, D))), unit(rng.normal(size=(4, D)))
    values = latent_relevancy(codec, np.zeros((4, 3), np.float32), phrase, canonical)
    assert (values == 0).all()


def test_blended_latents_keep_the_meaning_of_their_direction():
    rng = np.random.default_rng(3)
    codec = random_codec(rng)
    latents = unit(rng.normal(size=(20, 3))).astype(np.float32)
    phrase, canonical = unit(rng.normal(size=(1, D))), unit(rng.normal(size=(4, D)))
    full = latent_relevancy(codec, latents, phrase, canonical)
    faint = latent_relevancy(codec, 0.02 * latents, phrase, canonical)
    np.testing.assert_allclose(faint, full, atol=1e-5)


def test_linear_codec_needs_no_decoding():
    rng = np.random.default_rng(4)
    basis = np.linalg.qr(rng.normal(size=(D, 6)))[0].T.astype(np.float32)
    codec = LinearCodec(np.ascontiguousarray(basis))
    latents = rng.normal(size=(30, 6)).astype(np.float32)
    phrase, canonical = unit(rng.normal(size=(2, D))), unit(rng.normal(size=(4, D)))
    want = relevancy(codec.decode(latents), phrase, canonical)
    np.testing.assert_allclose(latent_relevancy(codec, latents, phrase, canonical), want, atol=1e-5)


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
    assert len(table.used) == len(table.vectors) <= 4 * 4
    phrases = unit(rng.normal(size=(2, D)))
    got = np.stack(list(table.relevancies(phrases)), 1)
    np.testing.assert_allclose(got, latent_relevancy(codec, latents, phrases, canonical), atol=0.02)
    assert (got[:40] == 0).all()
    nothing = build_table(codec, np.zeros((7, 3), np.float32), Scale(canonical, None, 10.0))
    assert (next(nothing.relevancies(phrases)) == 0).all()


def test_a_table_needs_a_sphere():
    rng = np.random.default_rng(7)
    canonical = unit(rng.normal(size=(4, D))).astype(np.float32)
    flat = LinearCodec(np.eye(D, dtype=np.float32)[:3])  # 3 numbers, but of any length
    for codec in (random_codec(rng, d=4), flat):
        assert not codec.spherical
        with pytest.raises(ValueError, match="sphere"):
            build_table(codec, np.ones((2, codec.latent_dim), np.float32), canonical)


def test_the_floor_is_where_phrase_and_canonical_phrases_are_as_close():
    vectors = np.eye(D)[:1]
    assert relevancy(vectors, vectors, np.repeat(vectors, 4, 0)).tolist() == [[FLOOR]]


def test_engine_finds_the_blob_and_its_place():
    scene, left, _ = two_blob_scene()
    result = QueryEngine(scene).run("left")
    assert result.found
    assert result.level in (1, 2)  # nothing was observed at the subpart level
    assert result.scores[0] == 0
    assert result.place is not None
    assert np.linalg.norm(result.place - left.mean(0)) < 0.25
    assert result.box is not None
    assert (result.box[1] < 0.5).any()  # the box does not reach the other blob
    assert result.box[1][0] < 0
    assert (result.relevancy[2][:60] > 0.99).all()
    assert (result.relevancy[2][60:] <= 0.5 + 1e-6).all()


def test_engine_says_when_nothing_is_there():
    scene, *_ = two_blob_scene()
    result = QueryEngine(scene).run("Nowhere")
    assert not result.found
    assert result.peak <= 0.5 + 1e-6


def test_engine_errors_say_what_to_do():
    scene, *_ = two_blob_scene()
    with pytest.raises(EncoderError, match="only the phrases in the scene's phrasebook"):
        QueryEngine(scene).run("right")
    with pytest.raises(InputError, match="empty"):
        QueryEngine(scene).run("  ")
    with pytest.raises(InputError, match="langsplat train"):
        QueryEngine(Scene(scene.gaussians)).run("left")

    class Small:
        def encode_texts(self, texts):
            return np.ones((len(texts), 3), np.float32)

        def unknown_words(self, text):
            return tuple(word for word in text.split() if word == "flurb")

        def near_words(self, word):
            return ("blurb",)

    with pytest.raises(UnknownWordError, match=r"'flurb' \(did you mean 'blurb'\?\); use other words"):
        QueryEngine(scene, lambda _: Small()).run("red flurb")
    with pytest.raises(EncoderError, match="3 numbers"):
        QueryEngine(scene, lambda _: Small()).run("red")

    class Stranger(Small):
        def encode_texts(self, texts):
            return np.roll(np.eye(D, dtype=np.float32), 3, axis=1)[: len(texts)]

    with pytest.raises(EncoderError, match="other weights"):
        QueryEngine(scene, lambda _: Stranger()).run("red")


@pytest.mark.parametrize("phrase", ["the", "A", "of", "'the'!", "of the"])
def test_stop_words_alone_are_refused(phrase):
    """An encoder has a vector for them too, and something is always near it."""
    engine = QueryEngine(blob_scene(), lambda _: FakeEncoder())
    for ask in (
        engine.run,
        lambda text: engine.run_many(["mug", text]),
        lambda text: run_phrase(engine, text),
    ):
        with pytest.raises(InputError, match="names nothing to look for") as refused:
            ask(phrase)
        assert "\n" not in str(refused.value)
    assert engine.known_vectors([phrase, "mug"])[0] == ("mug",)


@pytest.mark.parametrize("phrase", ['"mug"', "mug.", "(Mug)", "mug;"])
def test_marks_around_a_phrase_change_nothing(phrase):
    engine = QueryEngine(blob_scene(), lambda _: FakeEncoder())
    assert engine.run(phrase).peak == engine.run("mug").peak
    assert engine.run(phrase).phrase.lower() == "mug"


def test_a_phrase_is_encoded_once():
    encoded = []

    class Counting(FakeEncoder):
        def encode_texts(self, texts):
            encoded.extend(texts)
            return super().encode_texts(texts)

    engine = QueryEngine(blob_scene(), lambda _: Counting())
    check_phrase(engine, "mug or book")
    run_phrase(engine, "book or mug")
    engine.run("Mug", "part")
    assert sorted(word for word in encoded if word in WORDS) == ["book", "mug"]


def test_a_check_raises_what_asking_would():
    engine = QueryEngine(blob_scene(phrasebook=True))
    check_phrase(engine, "Book")
    with pytest.raises(EncoderError, match="phrasebook"):
        check_phrase(engine, "book or mug")
    engine = QueryEngine(blob_scene(), lambda _: FakeEncoder())
    with pytest.raises(UnknownWordError, match="did you mean 'plant'") as unknown:
        check_phrase(engine, "mug near the plamt")
    assert unknown.value.near == {"plamt": ("plant",)}
    with pytest.raises(InputError, match="where one looks from"):
        check_phrase(engine, "mug behind the plant")
    with pytest.raises(InputError, match="empty"):
        check_phrase(engine, "?")


@pytest.mark.parametrize(("encoder_id", "asked_for"), [("", "fake"), ("mine", "mine")])
def test_the_encoder_is_loaded_once_by_the_first_phrase_that_needs_it(encoder_id, asked_for):
    loaded = []

    def load(name: str) -> FakeEncoder:
        loaded.append(name)
        return FakeEncoder()

    engine = QueryEngine(blob_scene(phrasebook=True), load, encoder_id=encoder_id)
    told = []
    with pytest.raises(InputError):
        engine.run("  ")
    assert engine.run("  Book ", progress=lambda label, _: told.append(label)).found
    assert engine.unknown_words("BOOK") == ()
    assert (loaded, told) == ([], ["searching 'Book'"])
    assert engine.run(" Plant ", progress=lambda label, _: told.append(label)).phrase == "Plant"
    engine.run("mug", progress=lambda label, _: told.append(label))
    assert engine.unknown_words("red mug") == ("red",)
    assert engine.load_encoder() is engine.encoder
    assert loaded == [asked_for]
    assert told[1:] == ["loading the text encoder", "searching 'Plant'", "searching 'mug'"]


def test_heat_goes_from_the_floor_to_the_peak_but_never_over_less_than_a_tenth():
    scene, *_ = two_blob_scene()
    found, absent = QueryEngine(scene).run("left"), QueryEngine(scene).run("nowhere")
    assert found.heat_range == (FLOOR, found.peak)
    assert absent.heat_range == (FLOOR, pytest.approx(FLOOR + 0.1))


def test_an_empty_scene_can_be_asked():
    scene, *_ = two_blob_scene()
    assert scene.language is not None
    empty = Scene(
        scene.gaussians.take(np.zeros(0, int)),
        LanguageField(
            scene.language.latents[:, :0],
            scene.language.confidence[:, :0],
            scene.language.codec,
            scene.language.canonical,
            "none",
            scene.language.phrasebook,
        ),
    )
    result = QueryEngine(empty).run("left")
    assert not result.found
    assert result.place is None


def test_a_stray_gaussian_decides_nothing():
    scene, *_ = two_blob_scene()
    neighbourhood = build_surface(scene.gaussians)
    values = np.zeros((3, 120))
    values[2, :60] = 0.8
    values[2, 90] = 1.0  # one wrong Gaussian in the other blob
    smoothed = neighbourhood.smooth(values)[2]
    place = locate(neighbourhood, smoothed, 0.5)
    assert place is not None
    assert place.position[0] < 0


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


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (30, 40)])
def test_peak_pixel_of_any_size(shape):
    image = np.zeros(shape)
    image[-1, -1] = 1
    column, row, _ = peak_pixel(image, 20)
    assert 0 <= column < shape[1]
    assert 0 <= row < shape[0]
