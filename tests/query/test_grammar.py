"""What the grammar of phrases reads, and that no text makes it fail otherwise than in one line."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from langsplat_core.errors import InputError
from langsplat_core.query.grammar import (
    MAX_ATOMS,
    MAX_CHARACTERS,
    Atom,
    Both,
    Inside,
    Relation,
    Superlative,
    Union,
    Without,
    atoms,
    named,
    parse,
    unparse,
)
from langsplat_core.scene.language import split_phrases

MUG, BOOK, TABLE = Atom("mug"), Atom("book"), Atom("table")
HANDLE = Atom("handle")
READ = {
    "mug": MUG,
    "  the 'red mug'! ": Atom("red mug"),
    "handle of the red mug": Inside(HANDLE, Atom("red mug")),
    "mug's handle": Inside(HANDLE, MUG),
    "the mug\u2019s handle": Inside(HANDLE, MUG),
    "mug 's handle": Inside(HANDLE, MUG),
    "the dogs' tails": Inside(Atom("tails"), Atom("dogs")),
    "red mug handle": Inside(HANDLE, Atom("red mug")),
    "coffee table legs": Inside(Atom("legs"), Atom("coffee table")),
    "wing of the airplane's tail": Inside(Atom("wing"), Inside(Atom("tail"), Atom("airplane"))),
    "back of the chair": Inside(Atom("back"), Atom("chair")),
    "mug on the table": Relation("on", MUG, TABLE),
    "mug on top of the table": Relation("on", MUG, TABLE),
    "a mug to the left of my book": Relation("left of", MUG, BOOK),
    "handle of the mug on the table": Inside(HANDLE, Relation("on", MUG, TABLE)),
    "mug and the book": Both((MUG, BOOK)),
    "mug as well as book & table": Both((MUG, BOOK, TABLE)),
    "mug or book and table": Union((MUG, Both((BOOK, TABLE)))),
    "mug, book or table": Union((MUG, BOOK, TABLE)),  # where nobody has separated them
    "mug, book, or table": Union((MUG, BOOK, TABLE)),
    "mug and glass": Both((MUG, Atom("glass"))),
    "mug, not red mug": Without(MUG, Atom("red mug")),
    "mug but not the book": Without(MUG, BOOK),
    "mug, not red mug, not blue mug": Without(MUG, Union((Atom("red mug"), Atom("blue mug")))),
    "mug without its handle": Without(MUG, Inside(HANDLE, MUG)),
    "the biggest mug on the table": Superlative("biggest", Relation("on", MUG, TABLE)),
    "nearest mug to the book": Superlative("nearest", MUG, BOOK),
    "mug closest to the book": Superlative("nearest", MUG, BOOK),
    "the mug on the left": Superlative("leftmost", MUG),
    "handle of the smallest mug": Inside(HANDLE, Superlative("smallest", MUG)),
}
WHOLE = (
    *(
        "red handle",
        "wooden leg",
        "glass lid",
        "cup of tea",
        "pair of scissors",
        "children's book",
        "t-shirt",
    ),
    *("red and blue ball", "on the table", "mug on", "mug and", "mug without", "biggest", "handle", "orange"),
    *("杯子", "красная кружка", "κούπα", "كوب أحمر", "☕"),
)


@pytest.mark.parametrize("text", READ)
def test_what_is_read(text):
    assert parse(text) == READ[text]


@pytest.mark.parametrize("text", WHOLE)
def test_what_is_asked_whole(text):
    assert parse(text) == Atom(text)


@pytest.mark.parametrize("text", ["", " \n\t", "'?!'", "the", "of the", "and", "\u200b", "\x00"])
def test_what_names_nothing_is_refused_in_one_line(text):
    with pytest.raises(InputError) as refused:
        parse(text)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("text", ["not cup", "not", "without the mug", ", not red", "except the mug"])
def test_a_negative_phrase_needs_a_positive(text):
    with pytest.raises(InputError, match="what not to look for"):
        parse(text)


def test_a_text_without_end_is_refused():
    with pytest.raises(InputError, match=f"10000 characters; use at most {MAX_CHARACTERS}"):
        parse("mug " * 2500)
    with pytest.raises(InputError, match=f"at most {MAX_ATOMS}"):
        parse(" and ".join(["mug"] * (MAX_ATOMS + 1)))


def test_readings_show_the_structure():
    assert unparse(parse("red mug handle")) == "handle  inside  red mug"
    assert unparse(parse("biggest mug on the table")) == "biggest  (mug  on  table)"
    assert unparse(parse("mug nearest to the book")) == "nearest  mug  from  book"
    assert unparse(parse("mug or cup, not red cup")) == "(mug  or  cup)  without  red cup"


WORDS = st.sampled_from(
    ["mug", "red", "handle", "of", "the", "and", "or", "not", "without", "but", ",", "'", "'s", "on", "in",
     "left", "to", "biggest", "nearest", "from", "a", "orange,", "&", "on;", "mug's", "dogs'", "near", "as",
     "well", "top"]
)  # fmt: skip


@settings(max_examples=400)
@given(st.one_of(st.text(max_size=60), st.lists(WORDS, max_size=14).map(" ".join)))
def test_every_text_is_read_or_refused(text):
    """Nothing but InputError is raised, every phrase of a tree says something, and a reading shows it."""
    for query in [text, *split_phrases(text)]:
        try:
            tree = parse(query)
        except InputError:
            continue
        assert all(atom.text.strip() and atom.text in unparse(tree) for atom in atoms(tree))


NAMED = {
    "thing": ("", "mug", "red mug", "handle of", "handle mug"),
    "part": ("handle", "Handles", "the red handle"),
    "part of a thing": ("mug handle", "the red mug handles", "lamp shade"),
}


@pytest.mark.parametrize("what", NAMED)
def test_a_part_word_at_the_end_names_a_part_and_a_thing_before_it_whose(what):
    assert {named(phrase) for phrase in NAMED[what]} == {what}
