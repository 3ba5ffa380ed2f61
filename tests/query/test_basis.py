"""What an answer is said to stand on."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import Array, unit
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import CANONICAL_PHRASES, Calibration, Odds, Reading, Scene
from langsplat_core.semantics.encoder import OPEN_MODEL
from langsplat_core.semantics.encoders import DEMO
from langsplat_core.semantics.vocabulary import FEWEST
from tests.support.blob_words import named_scene
from tests.support.fakes import DIM, WORDS, FakeEncoder, axis

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
