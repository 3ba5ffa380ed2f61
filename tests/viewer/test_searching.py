"""Queries, their colours and levels, without a window."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from langsplat_core.scene import Reading
from langsplat_viewer.actions import opening, queries, settings
from langsplat_viewer.drawing.channels import NO_HEAT
from langsplat_viewer.output.still import describe
from langsplat_viewer.panels.search import hint
from tests.support.fakes import CENTRES, blob_scene, calibrated_for, language
from tests.support.windowless import SCENES, errors, settle


def test_a_query_is_answered_and_shown(opened):
    queries.ask(opened, "  mug ")
    query = opened.state.queries[0]
    assert query.pending
    settle(opened)
    assert (query.phrase, query.slot, query.pending, query.problem) == ("mug", 0, False, "")
    assert query.result.found
    assert query.result.level == 2
    assert_allclose(query.result.place, CENTRES[0], atol=0.25)
    assert opened.state.picture.display == "relevancy"
    columns = opened.state.relevancies()
    assert columns.shape == (360, 1)
    assert columns[:120].mean() > 0.9 > 0.6 > columns[120:].mean()
    assert opened.state.heat_ranges() == (query.result.heat_range,)


def test_an_absent_thing_is_not_here(opened):
    queries.ask(opened, "mug")
    queries.set_level(opened, "part")
    settle(opened)
    assert not opened.state.queries[0].result.found


def test_an_unknown_word_is_one_line(opened):
    queries.ask(opened, "sofa")
    settle(opened)
    query = opened.state.queries[0]
    assert query.result is None
    assert "sofa" in query.problem
    assert "\n" not in query.problem
    assert opened.state.shown() == []


def test_an_unknown_word_takes_no_colour_and_says_what_may_be_meant(opened):
    for text in ("mug", "book", "plant", "plamt pot", "plamt"):
        queries.ask(opened, text)
    settle(opened)
    assert [query.slot for query in opened.state.queries] == [0, 1, 2, None, None]
    typo = opened.state.queries[4]
    assert (typo.phrase, typo.meant) == ("plamt", "plant")
    assert "did you mean 'plant'?" in typo.problem
    assert opened.state.queries[3].meant == ""  # "pot" is like no word


def test_a_correction_is_offered_and_takes_the_place_of_the_typo(opened):
    queries.ask(opened, "red plamt")
    settle(opened)
    assert queries.offers(opened) == ("did you mean", ())  # "red" is like no word either
    queries.ask(opened, "plamt")
    settle(opened)
    assert queries.offers(opened) == ("did you mean", ("plant",))
    queries.ask_offered(opened, "plant")
    settle(opened)
    assert [query.phrase for query in opened.state.queries] == ["red plamt", "plant"]
    assert opened.state.queries[1].result.found
    assert opened.state.queries[1].slot == 0


def test_commas_separate_searches_and_quotes_are_no_part_of_them(opened):
    queries.ask(opened, '"mug", plant; book, not mug')
    settle(opened)
    assert [query.phrase for query in opened.state.queries] == ["mug", "plant", "book, not mug"]
    queries.ask(opened, "?!")
    assert "no word to look for" in errors(opened)[-1]
    queries.ask(opened, "the")
    settle(opened)
    assert "names nothing" in opened.state.queries[-1].problem or "names nothing" in errors(opened)[-1]


def test_earlier_phrases_come_back_by_the_arrows(opened):
    assert queries.recall(opened, -1) == ""
    for text in ("mug", "book", "Mug"):
        queries.ask(opened, text)
    assert [queries.recall(opened, step) for step in (-1, -1, -1, 1, 1)] == ["Mug", "book", "book", "Mug", ""]


def test_examples_are_offered_until_the_first_search_and_each_is_found(viewer):
    opening.open_scene(viewer, Path("book.ply"))
    settle(viewer)
    assert queries.offers(viewer) == ("try", ())
    queries.prepare_suggestions(viewer)
    assert viewer.worker.current == ("finding examples", 0.0) or viewer.state.suggestions.examples
    settle(viewer)
    assert queries.offers(viewer) == ("try", ("book",))
    assert hint(viewer) == "book, ..."
    queries.prepare_suggestions(viewer)
    assert viewer.worker.current is None  # once per scene
    queries.type_phrase(viewer, "bo")
    assert queries.offers(viewer) == ("", ("book",))
    queries.type_phrase(viewer, "")
    queries.ask_offered(viewer, "book")
    settle(viewer)
    assert viewer.state.queries[0].result.found
    opening.open_scene(viewer, Path("plain.ply"))
    settle(viewer)
    queries.prepare_suggestions(viewer)
    assert queries.offers(viewer) == ("try", ())


def test_empty_and_repeated_phrases(opened):
    queries.ask(opened, "   ")
    assert opened.state.queries == []
    queries.ask(opened, "mug")
    queries.ask(opened, " Mug ")
    settle(opened)
    assert [query.phrase for query in opened.state.queries] == ["mug"]


def test_a_fourth_query_takes_the_oldest_ones_colour(opened):
    for word in ("mug", "book", "plant"):
        queries.ask(opened, word)
    settle(opened)
    assert [query.slot for query in opened.state.queries] == [0, 1, 2]
    queries.ask(opened, "mug or book")
    settle(opened)
    slots = {query.phrase: query.slot for query in opened.state.queries}
    assert slots == {"mug": None, "book": 1, "plant": 2, "mug or book": 0}


def test_hiding_keeps_the_colours_of_the_others(opened):
    for word in ("mug", "book"):
        queries.ask(opened, word)
    settle(opened)
    mug, book = opened.state.queries
    queries.hide(opened, mug)
    columns = opened.state.relevancies()
    assert columns.shape == (360, 2)
    assert not columns[:, 0].any()
    assert opened.state.heat_ranges() == (NO_HEAT, book.result.heat_range)
    assert columns[120:240, 1].mean() > 0.9
    queries.show(opened, mug)
    assert (mug.slot, book.slot) == (0, 1)
    queries.remove(opened, book)
    assert opened.state.relevancies().shape == (360, 1)
    queries.remove(opened, mug)
    assert opened.state.relevancies() is None


def test_level_applies_to_every_query(opened):
    queries.ask(opened, "plant")
    settle(opened)
    assert opened.state.queries[0].result.level == 2
    key = opened.state.layers_key()
    queries.set_level(opened, "part")
    settle(opened)
    assert opened.state.queries[0].result.level == 1
    assert opened.state.layers_key() != key


def test_asking_before_a_scene_is_open(viewer):
    queries.ask(viewer, "mug")
    assert "open a scene" in errors(viewer)[0]


def test_the_box_is_emptied_by_a_search_and_by_nothing_else(opened):
    queries.type_phrase(opened, "  ")
    queries.ask_typed(opened)
    assert (opened.state.typed, opened.state.queries) == ("  ", [])
    assert not queries.take_search_focus(opened)
    queries.type_phrase(opened, "mug ")
    queries.ask_typed(opened)
    assert (opened.state.typed, opened.state.queries[0].phrase) == ("", "mug")
    assert not queries.take_search_focus(opened)  # the next letters are keys again
    settings.show_panel(opened, False)
    queries.focus_search(opened)
    assert opened.state.show_panel
    assert queries.take_search_focus(opened)
    assert not queries.take_search_focus(opened)  # said once


def test_a_phrase_with_structure_says_how_it_was_read(opened):
    queries.ask(opened, "mug or book")
    queries.ask(opened, "mug")
    settle(opened)
    composed, plain = opened.state.queries
    assert (composed.reading, plain.reading) == ("mug  or  book", "")
    assert composed.result.found
    assert composed.result.members[:240].mean() > 0.9 > 0.1 > composed.result.members[240:].mean()


@pytest.mark.parametrize(("logit", "verdict"), [(9.0, "found"), (1.0, "weak match"), (-3.0, "not here")])
def test_a_calibrated_scene_gives_verdicts_with_probability(viewer, monkeypatch, logit, verdict):
    reading = Reading(calibration=calibrated_for("mug", logit))
    scene = replace(blob_scene(), language=replace(language(), reading=reading))
    monkeypatch.setitem(SCENES, "sure.ply", scene)
    opening.open_scene(viewer, Path("sure.ply"))
    settle(viewer)
    queries.ask(viewer, "mug")
    settle(viewer)
    result = viewer.state.queries[0].result
    assert (result.verdict, result.found) == (verdict, verdict == "found")
    assert (viewer.state.queries[0].slot is None) == (verdict == "not here")
    said = f"'mug': {verdict} ({100 * result.probability:.0f} %), score "
    assert describe(result).startswith(said)


def test_what_was_found_is_told_apart(opened):
    for phrase in ("mug", "mug or plant"):
        queries.ask(opened, phrase)
    settle(opened)
    one, both = opened.state.queries
    assert (len(one.things), len(both.things)) == (1, 2)
    assert np.linalg.norm(one.things[0].centre - CENTRES[0]) < 0.3
