"""How phrases are written: what counts of a text, and where one phrase ends and the next begins."""

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from langsplat_core.scene.language import phrase_key, split_phrases, tidy, tokens

SAME = (
    "red mug",
    '"red mug"',
    "'Red  Mug'",
    "“red mug”",
    "«red mug»",
    "(red) mug.",
    "red mug!?",
    " - red mug … ",
    "red mug\u200b",
    "red, mug,",
    "*red* _mug_",
)


@pytest.mark.parametrize("text", SAME)
def test_quotes_and_punctuation_are_no_part_of_a_phrase(text):
    assert phrase_key(text) == "red mug"


def test_what_belongs_to_a_word_stays():
    assert phrase_key("The dogs' T-shirt & the child’s cup") == "the dogs' t-shirt & the child's cup"
    assert phrase_key("杯子。") == "杯子"
    assert phrase_key("☕") == "☕"


def test_what_is_shown_keeps_its_capitals_and_commas():
    assert tidy('  "PLANT  pot" ') == "PLANT pot"
    assert tidy("mug , not 'red mug'!") == "mug, not red mug"
    assert tidy(" , mug ,") == "mug"


@pytest.mark.parametrize("text", ["", " \n\t", "'?!'", "...", "\x00", ",;,", "\u200b"])
def test_marks_alone_are_no_phrase(text):
    assert (tidy(text), phrase_key(text), tokens(text), split_phrases(text)) == ("", "", [], [])


def test_phrases_in_a_line_are_separated():
    line = '"mug", red book; plate, not red plate,, the cup, but not my cup'
    assert split_phrases(line) == ["mug", "red book", "plate, not red plate", "the cup, but not my cup"]
    assert split_phrases("duck, penguin") == ["duck", "penguin"]


@settings(max_examples=300)
@given(st.text(max_size=40))
@example(")\u0301")  # a mark over nothing
def test_a_tidy_phrase_stays_as_it_is(text):
    assert tidy(tidy(text)) == tidy(text)
    assert phrase_key(tidy(text)) == phrase_key(text)
