"""Relevancy, the sphere table, levels, places and pixels."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import Array, unit
from langsplat_core.errors import EncoderError, InputError, UnknownWordError
from langsplat_core.query.answers import locate, peak_pixel
from langsplat_core.query.compose import check_phrase, run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.surface import build_surface
from langsplat_core.scene import (
    CANONICAL_PHRASES,
    Calibration,
    LanguageField,
    Odds,
    Reading,
    Scene,
)
from langsplat_core.semantics.encoder import OPEN_MODEL
from langsplat_core.semantics.encoders import DEMO
from langsplat_core.semantics.relevancy import FLOOR
from langsplat_core.semantics.vocabulary import FEWEST
from tests.support.fakes import DIM, WORDS, FakeEncoder, axis, blob_scene, named_scene
from tests.support.file_samples import random_field
from tests.support.query_scenes import D, two_blob_scene
from tests.support.scenes import random_gaussians


def test_what_is_there_is_found_at_its_place_and_nothing_else_is():
    scene, left, _ = two_blob_scene()
    engine = QueryEngine(scene)
    result, absent = engine.run("left"), engine.run("Nowhere")
    assert (result.found, absent.found) == (True, False)
    assert result.level in (1, 2)  # nothing was observed at the subpart level
    assert result.scores[0] == 0
    assert np.linalg.norm(result.place - left.mean(0)) < 0.25
    assert result.box[1][0] < 0  # the box does not reach the other blob
    assert (result.relevancy[2][:60] > 0.99).all()
    assert (result.relevancy[2][60:] <= FLOOR + 1e-6).all()
    assert absent.peak <= FLOOR + 1e-6
    assert result.heat_range == (FLOOR, result.peak)
    assert absent.heat_range == (FLOOR, pytest.approx(FLOOR + 0.1))  # never over less than a tenth
    empty = QueryEngine(scene.take(np.zeros(0, int))).run("left")
    assert (empty.found, empty.place) == (False, None)


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
    assert loaded == [asked_for]
    assert told[1:] == ["loading the text encoder", "searching 'Plant'", "searching 'mug'"]


def test_a_stray_gaussian_decides_nothing():
    scene, *_ = two_blob_scene()
    neighbourhood = build_surface(scene.gaussians)
    values = np.zeros(120, np.float32)
    values[:60] = 0.8
    values[90] = 1.0  # one wrong Gaussian in the other blob
    smoothed = neighbourhood.smooth(values)
    place, _ = locate(neighbourhood, smoothed, 0.5)
    assert place[0] < 0


@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (30, 40)])
def test_peak_pixel_of_any_size(shape):
    image = np.zeros(shape)
    image[-1, -1] = 1
    column, row, _ = peak_pixel(image, 20)
    assert 0 <= column < shape[1]
    assert 0 <= row < shape[0]


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
        def encode_texts(self, texts):
            batches.append(texts)
            return super().encode_texts(texts)

    batches: list[list[str]] = []
    engine = QueryEngine(blob_scene(), lambda _: Counting())
    assert engine.run_many([]) == []
    with pytest.raises(EncoderError, match="'flurb'"):
        engine.run_many(["mug", "flurb"])
    with pytest.raises(InputError, match="empty"):
        engine.run_many(["mug", " "])
    assert batches == []
    check_phrase(engine, "mug or book")
    assert len(engine.run_many(["mug", "book", "Mug"])) == 3
    run_phrase(engine, "book or mug")
    # Each phrase once, and the canonical ones that prove the encoder.
    assert batches == [["mug", "book"], list(CANONICAL_PHRASES)]


# What an answer is said to stand on.

CALIBRATED = Reading(calibration=Calibration(*[Odds(0, 1, 1)] * 3))
FAR = np.where(
    np.arange(DIM) < len(WORDS), 0.5, 1
)  # from what is in the scene, so that that is found clearly
EVERYDAY = unit((FAR * np.random.default_rng(4).normal(size=(FEWEST, DIM))).astype(np.float32))


def scene_of(encoder: str, reading: Reading, *, everyday: bool = True) -> Scene:
    scene = named_scene()
    assert scene.language is not None
    vectors = EVERYDAY if everyday else None
    return replace(
        scene, language=replace(scene.language, encoder_id=encoder, reading=reading, everyday=vectors)
    )


def test_too_few_everyday_phrases_count_as_none():
    few = scene_of("lab/clip", Reading())
    assert few.language is not None
    few = replace(few, language=replace(few.language, everyday=EVERYDAY[:-1]))
    assert QueryEngine(few).basis == QueryEngine(scene_of("lab/clip", Reading(), everyday=False)).basis


@pytest.mark.parametrize("encoder", [DEMO, "lab/clip"])
@pytest.mark.parametrize("reading", [CALIBRATED, Reading()])
@pytest.mark.parametrize("everyday", [True, False])
def test_a_calibration_is_named_exactly_where_probabilities_are_said(encoder, reading, everyday):
    engine = QueryEngine(scene_of(encoder, reading, everyday=everyday))
    before = engine.basis  # known before anything is asked, without loading an encoder
    answer = engine.run("mug")
    assert engine.basis == before
    assert (before.calibration is not None) == (answer.probability is not None)
    assert before.encoder == encoder
    assert before.guesses == (encoder == DEMO and reading == Reading())
    assert (OPEN_MODEL in before.long) == before.guesses
    engine.compare_with(["plant"])
    assert engine.run("mug").probability is None
    assert engine.basis.calibration is None


def test_ways_to_an_answer_are_told_apart():
    demo, clip = scene_of(DEMO, CALIBRATED), scene_of("lab/clip", Reading())
    guessed, published = scene_of(DEMO, Reading()), scene_of("lab/clip", Reading(), everyday=False)
    said = [QueryEngine(scene).basis for scene in (demo, clip, guessed, published)]
    assert len({basis.short for basis in said}) == len({basis.long for basis in said}) == 4
    assert "lab/clip" in said[1].short


class Speaker(FakeEncoder):
    """Knows every word; what is in no scene has a vector of its own."""

    def encode_texts(self, texts: list[str]) -> Array:
        drawn = [np.random.default_rng(list(text.encode())).normal(size=DIM) for text in texts]
        own = [axis(3) if text in CANONICAL_PHRASES else row for text, row in zip(texts, drawn, strict=True)]
        return unit(np.array(own, np.float32))

    def unknown_words(self, text: str) -> tuple[str, ...]:
        return ()


def test_everyday_phrases_of_the_encoder_count_once_they_are_there():
    engine = QueryEngine(scene_of("lab/clip", Reading(), everyday=False), lambda _: Speaker())
    published = engine.basis
    assert engine.run("mug").excess is not None
    assert engine.basis.short != published.short


def test_without_a_calibration_combined_answers_have_no_probability_and_the_weakest_excess():
    scene = scene_of("lab/clip", Reading())
    assert scene.language is not None
    book = scene.language.phrasebook | {"handle": axis(3)}
    engine = QueryEngine(replace(scene, language=replace(scene.language, phrasebook=book)))
    parts = [engine.run(text) for text in ("mug", "wall")]
    both = run_phrase(engine, "mug and wall").answer
    assert both.excess == min(part.excess for part in parts) < parts[0].excess
    either = run_phrase(engine, "mug or wall").answer
    assert either.excess == parts[0].excess
    assert run_phrase(engine, "mug near the wall").answer.excess == parts[1].excess
    assert [part.found for part in (*parts, both, either)] == [True, False, False, True]
    inside = run_phrase(engine, "handle of the wall").answer
    assert inside.excess == parts[1].excess < run_phrase(engine, "handle of the mug").answer.excess
    none = run_phrase(engine, "mug, not mug").answer
    assert not none.members.any()
    for answer in (both, either, inside, none):
        assert answer.probability is None
    assert (inside.verdict, none.verdict) == ("not here", "not here")
