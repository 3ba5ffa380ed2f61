"""Phrases with structure: what the grammar reads, and what is found on a table whose features are known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from langsplat_core.arrays import Array
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.query import grammar
from langsplat_core.query.compose import run_phrase
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.grammar import Atom, Both, Counted, Inside, Relation, Superlative, Union, Without
from langsplat_core.query.relations import Body, body, ranked, separate, stands, upright, viewpoint
from langsplat_core.scene import look_at
from langsplat_core.scene.language import split_phrases
from langsplat_core.scene.surface import build_surface
from tests.support.fakes import UP, PlainEncoder, front_camera, laid_table, meaning

MUG, BOOK, DESK = Atom("mug"), Atom("book"), Atom("table")
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
    "mug on the table": Relation("on", MUG, DESK),
    "Show me the mug on top of the table": Relation("on", MUG, DESK),
    "where is a mug to the left of my book?": Relation("left of", MUG, BOOK),
    "handle of the mug on the table": Inside(HANDLE, Relation("on", MUG, DESK)),
    "mug and the book": Both((MUG, BOOK)),
    "mug as well as book & table": Both((MUG, BOOK, DESK)),
    "mug or book and table": Union((MUG, Both((BOOK, DESK)))),
    "mug, book or table": Union((MUG, BOOK, DESK)),  # where nobody has separated them
    "mug and glass": Both((MUG, Atom("glass"))),
    "mug, not red mug": Without(MUG, Atom("red mug")),
    "mug but not the book": Without(MUG, BOOK),
    "mug, not red mug, not blue mug": Without(MUG, Union((Atom("red mug"), Atom("blue mug")))),
    "mug without its handle": Without(MUG, Inside(HANDLE, MUG)),
    "the biggest mug on the table": Superlative("biggest", Relation("on", MUG, DESK)),
    "find the nearest mug to the book": Superlative("nearest", MUG, BOOK),
    "biggest two mugs": Counted(2, Superlative("biggest", MUG)),
    "the mug on the left": Superlative("leftmost", MUG),
    "handle of the smallest mug": Inside(HANDLE, Superlative("smallest", MUG)),
    "three mugs": Counted(3, MUG),
    "the 2 red mugs on the table": Counted(2, Relation("on", Atom("red mug"), DESK)),
    "two boxes or a book": Union((Counted(2, Atom("box")), BOOK)),
    "handles of two mugs": Inside(Atom("handles"), Counted(2, MUG)),
    "bookcase shelves": Inside(Atom("shelves"), Atom("bookcase")),
}
ASKED_WHOLE = (
    *("red handle", "wooden leg", "glass lid", "cup of tea", "loaves of bread", "children's book"),
    *("t-shirt", "red and blue ball", "on the table", "mug on", "mug and", "mug without", "biggest"),
    *("handle", "orange", "three", "杯子", "красная кружка", "κούπα", "كوب أحمر", "☕", "what is that mug"),
)
READ |= {text: Atom(text) for text in ASKED_WHOLE}


@pytest.mark.parametrize("text", READ)
def test_grammar_reads_phrases_as_trees(text):
    assert grammar.parse(text) == READ[text]


EXCLUDED = ("not cup", "not", "without the mug", ", not red", "except the mug")


@pytest.mark.parametrize("text", ["", " \n\t", "'?!'", "the", "of the", "and", "\u200b", "\x00", *EXCLUDED])
def test_phrase_that_names_nothing_is_refused(text):
    with pytest.raises(InputError, match="what not to look for" if text in EXCLUDED else None):
        grammar.parse(text)


def test_long_text_is_refused():
    with pytest.raises(InputError, match=f"10000 characters; use at most {grammar.MAX_CHARACTERS}"):
        grammar.parse("mug " * 2500)
    with pytest.raises(InputError, match=f"at most {grammar.MAX_ATOMS}"):
        grammar.parse(" and ".join(["mug"] * (grammar.MAX_ATOMS + 1)))


SINGULARS = (
    "boxes box, glass glass, shelves shelf, cherries cherry, Chairs Chair, scissors scissors, cactus "
    "cactus, cookies cookie, potatoes potato, toes toe, buses bus, houses house, vases vase, ties tie, "
    "canoes canoe, brownies brownie, canvases canvas, atlases atlas, hoodies hoodie, puppies puppy, "
    "volcanoes volcano, fuses fuse, irises iris, octopuses octopus, moustaches moustache, watches watch, "
    "quizzes quiz, mazes maze, axes axe, bookshelves bookshelf, gloves glove, olives olive, thieves thief, "
    "knives knife, firemen fireman, lens lens, specimen specimen, grandchildren grandchild, women woman, "
    "feet foot, canvas canvas, tights tights, cups cup, horseshoes horseshoe, neckties necktie, butterflies "
    "butterfly, dresses dress, oranges orange, toys toy"
)


@pytest.mark.parametrize("pair", SINGULARS.split(", "))
def test_counted_things_are_asked_in_the_singular(pair):
    plural, one = pair.split()
    assert grammar.singular(plural) == one


def test_unparse_shows_the_structure():
    assert grammar.unparse(grammar.parse("red mug handle")) == "handle  inside  red mug"
    assert grammar.unparse(grammar.parse("biggest mug on the table")) == "biggest  (mug  on  table)"
    assert grammar.unparse(grammar.parse("mug nearest to the book")) == "nearest  mug  from  book"
    assert grammar.unparse(grammar.parse("mug or cup, not red cup")) == "(mug  or  cup)  without  red cup"


WORDS = st.sampled_from(
    ["mug", "red", "handle", "of", "the", "and", "or", "not", "without", "but", ",", "'", "'s", "on", "in",
     "left", "to", "biggest", "nearest", "from", "a", "orange,", "&", "on;", "mug's", "dogs'", "near", "as",
     "well", "top"]
)  # fmt: skip


@settings(max_examples=400)
@given(st.one_of(st.text(max_size=60), st.lists(WORDS, max_size=14).map(" ".join)))
def test_any_text_is_parsed_or_refused(text):
    """Nothing but InputError is raised, every phrase of a tree says something, and a reading shows it."""
    for query in [text, *split_phrases(text)]:
        try:
            tree = grammar.parse(query)
        except InputError:
            continue
        assert all(atom.text.strip() and atom.text in grammar.unparse(tree) for atom in grammar.atoms(tree))


def test_heads_exclude_what_they_are_related_to():
    assert grammar.heads(grammar.parse("biggest red mug on the table")) == ("red mug",)
    assert grammar.heads(grammar.parse("mug, not red mug")) == ("mug",)
    assert grammar.heads(grammar.parse("mug or handle of the cup")) == ("mug", "handle")


NAMED = {
    "thing": ("", "mug", "red mug", "handle of", "handle mug"),
    "part": ("handle", "Handles", "the red handle", "with handle"),
    "part of a thing": ("mug handle", "the red mug handles", "lamp shade"),
}


@pytest.mark.parametrize("what", NAMED)
def test_part_word_at_the_end_names_a_part_of_a_thing(what):
    assert {grammar.named(phrase) for phrase in NAMED[what]} == {what}


# Phrases with structure on a laid table, where every Gaussian's meaning is known.


@pytest.fixture(scope="module")
def table() -> tuple[QueryEngine, dict[str, Array]]:
    scene, blocks = laid_table()
    return QueryEngine(scene, lambda _: PlainEncoder()), blocks


ANSWERS = {  # phrase -> blocks that answer it
    "handle of the red mug": ["red handle"],
    "blue mug's handle": ["blue handle"],
    "mug on the table": ["red mug", "red handle", "blue mug", "blue handle"],
    "mug below the table": ["far mug"],
    "mug near the book": ["red mug", "red handle"],
    "book and table": ["book", "table"],
    "book or table": ["book", "table"],
    "mug, not red mug": ["blue mug", "blue handle", "far mug"],
    "mug without its handle": ["red mug", "blue mug", "far mug"],
    "the biggest mug": ["far mug"],
    "three mugs": ["red mug", "red handle", "blue mug", "blue handle", "far mug"],
    "two biggest mugs": ["red mug", "red handle", "far mug"],
    "the mug nearest to the book": ["red mug", "red handle"],
    "handle of the mug near the book": ["red handle"],
    "the smallest mug on the table": ["blue mug", "blue handle"],
}
SAID_BY_VIEWER = {
    "mug left of the book": ["red mug", "red handle"],
    "rightmost mug": ["blue mug", "blue handle"],
    "book behind the red mug": ["book"],
}


def overlap(members: Array, blocks: dict[str, Array], names: list[str]) -> float:
    """Intersection over union."""
    right = np.any([blocks[name] for name in names], axis=0)
    return float((members & right).sum() / (members | right).sum())


@pytest.mark.parametrize("text", [*ANSWERS, *SAID_BY_VIEWER])
def test_every_construction_finds_its_gaussians(table, text):
    engine, blocks = table
    result = run_phrase(engine, text, viewpoint=front_camera())
    answer, names = result.answer, {**ANSWERS, **SAID_BY_VIEWER}[text]
    assert overlap(answer.members, blocks, names) > 0.9
    assert answer.found
    assert answer.relevancy.shape == (3, len(answer.members))
    assert answer.members[answer.even.argmax()]
    low, high = answer.box
    assert ((answer.place >= low - 0.1) & (answer.place <= high + 0.1)).all()
    assert answer.members[np.argmin(((engine.scene.gaussians.means - answer.place) ** 2).sum(1))]


@pytest.mark.parametrize("text", SAID_BY_VIEWER)
def test_sides_need_a_viewpoint(table, text):
    with pytest.raises(InputError, match="give a camera"):
        run_phrase(table[0], text)


NOT_SO = ("handle of the book", "book on the red mug", "mug in the book", "biggest handle on the book")


@pytest.mark.parametrize("text", [*NOT_SO, "nine mugs"])
def test_relation_that_does_not_hold_is_not_found(table, text):
    assert not run_phrase(table[0], text).answer.found


def test_phrase_without_structure_is_asked_whole(table):
    engine, _ = table
    got, want = run_phrase(engine, "the red mug!", "part"), engine.run("red mug", "part")
    assert got.reading == "red mug"
    np.testing.assert_array_equal(got.answer.relevancy, want.relevancy)
    np.testing.assert_array_equal(got.answer.members, want.members)
    assert (got.answer.peak, got.answer.level, got.answer.found) == (want.peak, want.level, want.found)


def test_phrasebook_answers_a_whole_phrase():
    scene, blocks = laid_table({"handle of the mug": meaning("handle"), "mug": meaning("mug")})
    engine = QueryEngine(scene)
    result = run_phrase(engine, "handle of the mug")
    assert result.reading == "handle of the mug"
    assert overlap(result.answer.members, blocks, ["red handle", "blue handle"]) > 0.9
    with pytest.raises(EncoderError):
        run_phrase(engine, "lid of the mug")


def test_part_is_found_inside_at_the_wanted_level(table):
    result = run_phrase(table[0], "handle of the red mug")
    assert (result.answer.level, result.answer.phrase) == (1, "handle of the red mug")
    assert run_phrase(table[0], "handle of the red mug", "whole").answer.level == 2
    with pytest.raises(EncoderError, match="spoon"):
        run_phrase(table[0], "book or spoon")


# How boxes of points stand to each other, and which things there are.

FRAME = upright(UP)
EYE = viewpoint(look_at(np.array([0.0, -8, 1]), np.zeros(3), UP, (160, 120)), FRAME)


def box(centre: tuple[float, float, float], half: tuple[float, float, float], hollow: bool = False) -> Body:
    """2000 points in a box, or of an open vessel: its floor and sides."""
    points = np.random.default_rng(0).uniform(-1, 1, (2000, 3))
    if hollow:
        points = points[(np.abs(points[:, :2]).max(1) > 0.9) | (points[:, 2] < -0.9)]
    return body(points * half + np.array(centre), FRAME)


TABLE = box((0, 0, -0.05), (1, 1, 0.05))
BOWL = box((0.5, 0, 0.2), (0.3, 0.3, 0.2), hollow=True)
CUP = box((-0.5, 0, 0.1), (0.1, 0.1, 0.1))
FRUIT = box((0.5, 0, 0.2), (0.1, 0.1, 0.1))
DOME = body(CUP.points @ FRAME * (1, 1, 0.3), FRAME)  # flat, on the table
LAMP = box((-0.5, 0, 2.0), (0.35, 0.35, 0.2))
WALL = box((0, 2.05, 1), (3, 0.05, 2))
PICTURE = box((0, 1.98, 1.5), (0.4, 0.02, 0.3))
TRUE = {
    "on": [(CUP, TABLE), (BOWL, TABLE), (PICTURE, WALL)],
    "in": [(FRUIT, BOWL)],
    "near": [(FRUIT, BOWL), (CUP, TABLE)],
    "above": [(LAMP, TABLE), (LAMP, CUP)],
    "below": [(TABLE, LAMP), (CUP, LAMP)],
    "left of": [(CUP, BOWL)],
    "right of": [(BOWL, CUP)],
    "behind": [(PICTURE, TABLE)],
    "in front of": [(TABLE, PICTURE)],
}
FALSE = {
    "on": [(TABLE, CUP), (LAMP, TABLE), (CUP, BOWL), (CUP, WALL)],
    "in": [(CUP, BOWL), (BOWL, FRUIT), (CUP, TABLE), (DOME, TABLE)],
    "near": [(CUP, BOWL), (LAMP, CUP)],
    "above": [(TABLE, LAMP), (LAMP, BOWL)],
    "below": [(LAMP, TABLE)],
    "left of": [(BOWL, CUP), (FRUIT, BOWL)],
    "right of": [(CUP, BOWL)],
    "behind": [(TABLE, PICTURE), (CUP, BOWL)],
    "in front of": [(PICTURE, TABLE)],
}


@pytest.mark.parametrize("kind", TRUE)
def test_relations_hold_for_boxes(kind):
    assert all(stands(kind, what, anchor, EYE) for what, anchor in TRUE[kind])
    assert not any(stands(kind, what, anchor, EYE) for what, anchor in FALSE[kind])


@pytest.mark.parametrize("turn", [0, 90, 211])
def test_relations_do_not_depend_on_the_worlds_axes(turn):
    """The same things under another up direction stand the same."""
    angle = np.radians(turn)
    rotation = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])

    def turned(one: Body) -> Body:
        return body((one.points @ FRAME) @ rotation.T, upright(rotation @ UP))

    for kind in ("on", "in", "near", "above", "below"):
        assert all(stands(kind, turned(what), turned(anchor), None) for what, anchor in TRUE[kind])
        assert not any(stands(kind, turned(what), turned(anchor), None) for what, anchor in FALSE[kind])


def test_most_picks_the_extreme_thing():
    things = [CUP, BOWL, LAMP]
    want = {"biggest": 2, "smallest": 0, "highest": 2, "lowest": 0, "rightmost": 1, "farthest": 2}
    assert {kind: ranked(kind, things, [], EYE)[0] for kind in want} == want
    assert ranked("nearest", things, [FRUIT], None)[0] == 1


def test_separate_drops_specks():
    scene, blocks = laid_table()
    surface = build_surface(scene.gaussians)
    inside: Array = (blocks["far mug"] | blocks["book"])[surface.rows]
    inside[np.flatnonzero(blocks["table"][surface.rows])[:3]] = True
    parts = separate(surface, inside)
    assert [len(part) for part in parts] == [blocks["far mug"].sum()]  # the book has less than a tenth of it
    assert separate(surface, np.zeros(len(surface.rows), bool)) == []
