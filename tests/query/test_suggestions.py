"""Examples of what a scene answers, and completions of what is typed."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.query.describe import completions, corrected, suggest
from langsplat_core.query.engine import QueryEngine
from tests.support.fakes import FakeEncoder, axis, blob_scene, language

PHRASES = ("teddy bear", "tea pot", "red mug", "teapot", "mug")


def test_every_example_is_found_in_the_scene():
    engine = QueryEngine(blob_scene(), lambda _: FakeEncoder())
    found = suggest(engine)
    assert {"mug", "book", "plant"} >= set(found.examples)
    assert found.examples
    assert all(engine.run(phrase).found for phrase in found.examples)
    assert set(found.examples) <= set(found.phrases)
    assert len(suggest(engine, at_most=1).examples) == 1


def test_without_an_encoder_the_phrasebook_is_asked():
    nothing = (-axis(0) - axis(1) - axis(2)) / np.float32(np.sqrt(3))
    book = {"mug": axis(0), "unicorn": nothing, "of": axis(1)}
    scene = replace(blob_scene(), language=replace(language(), phrasebook=book))
    found = suggest(QueryEngine(scene))
    assert found.examples == ("mug",)
    assert found.phrases == ("mug", "unicorn", "of")


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("te", ["teddy bear", "tea pot", "teapot"]),
        ("TEA ", []),
        ("tea p", ["tea pot"]),
        ("red te", ["red teddy", "red tea", "red teapot"]),
        ("blue mu", ["blue mug"]),
        ("mug", []),
        ("", []),
        ("zebra", []),
    ],
)
def test_what_is_typed_is_completed(typed, offered):
    assert completions(typed, PHRASES) == offered
    assert completions(typed, PHRASES, at_most=1) == offered[:1]


def test_a_correction_replaces_the_unknown_words_alone():
    assert corrected("the Red mugg", {"mugg": ("mug", "muff")}) == "the red mug"
    assert corrected("red mugg", {"mugg": ()}) is None
