"""Phrases with structure on a laid table, where every Gaussian's meaning is known."""

import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.query.compose import grown, peaks_among, run_phrase
from langsplat_core.query.engine import QueryEngine
from tests.support.laid_table import PlainEncoder, front_camera, laid_table, meaning


@pytest.fixture(scope="module")
def table() -> tuple[QueryEngine, dict[str, Array]]:
    scene, blocks = laid_table()
    return QueryEngine(scene, lambda _: PlainEncoder()), blocks


ANSWERS = {  # phrase -> blocks that answer it
    "handle of the red mug": ["red handle"],
    "blue mug's handle": ["blue handle"],
    "red mug handle": ["red handle"],
    "mug on the table": ["red mug", "red handle", "blue mug", "blue handle"],
    "mug below the table": ["far mug"],
    "mug near the book": ["red mug", "red handle"],
    "book and table": ["book", "table"],
    "mug, not red mug": ["blue mug", "blue handle", "far mug"],
    "mug without its handle": ["red mug", "blue mug", "far mug"],
    "the biggest mug": ["far mug"],
    "the lowest mug": ["far mug"],
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
def test_what_a_viewer_says_needs_one(table, text):
    with pytest.raises(InputError, match="give a camera"):
        run_phrase(table[0], text)


@pytest.mark.parametrize(
    "text", ["handle of the book", "book on the red mug", "mug in the book", "biggest handle on the book"]
)
def test_what_is_not_so_is_not_found(table, text):
    assert not run_phrase(table[0], text).answer.found


def test_a_phrase_without_structure_is_asked_whole(table):
    engine, _ = table
    got, want = run_phrase(engine, "the red mug!", "part"), engine.run("red mug", "part")
    assert got.reading == "red mug"
    np.testing.assert_array_equal(got.answer.relevancy, want.relevancy)
    np.testing.assert_array_equal(got.answer.members, want.members)
    assert (got.answer.peak, got.answer.level, got.answer.found) == (want.peak, want.level, want.found)


def test_the_reading_and_its_phrases_are_shown(table):
    result = run_phrase(table[0], "handle of the red mug")
    assert result.reading == "handle  inside  red mug"
    assert result.answer.phrase == "handle of the red mug"
    assert {part.phrase for part in result.parts} == {"handle", "red mug", "red mug handle"}


def test_alternatives_are_whichever_is_there(table):
    engine, blocks = table
    with pytest.raises(EncoderError, match="spoon"):
        run_phrase(engine, "book or spoon")
    answer = run_phrase(engine, "book or table").answer
    assert overlap(answer.members, blocks, ["book", "table"]) > 0.9


def test_a_phrasebook_that_has_only_the_whole_phrase_is_asked_for_it():
    scene, blocks = laid_table({"handle of the mug": meaning("handle"), "mug": meaning("mug")})
    engine = QueryEngine(scene)
    result = run_phrase(engine, "handle of the mug")
    assert result.reading == "handle of the mug"
    assert overlap(result.answer.members, blocks, ["red handle", "blue handle"]) > 0.9
    with pytest.raises(EncoderError):
        run_phrase(engine, "lid of the mug")


def test_a_part_is_cut_inside_at_the_level_that_is_asked_for(table):
    engine, _ = table
    assert run_phrase(engine, "handle of the red mug").answer.level == 1
    assert run_phrase(engine, "handle of the red mug", "whole").answer.level == 2


def test_growing_adds_what_is_linked(table):
    engine, blocks = table
    surface, book = engine.surface, blocks["book"]
    inside = book[surface.rows]
    want = book.copy()
    want[surface.rows[inside | (surface.links.astype(float) @ inside > 0)]] = True
    np.testing.assert_array_equal(grown(surface, book), want)
    assert want.sum() > book.sum()


def test_peaks_are_of_every_level():
    values = np.array([[0.1, 0.3], [0.2, 0.1], [0.0, 0.0]], np.float32)
    assert peaks_among(values) == pytest.approx((0.3, 0.2, 0.0))
    assert peaks_among(values[:, :0]) == (0, 0, 0)
