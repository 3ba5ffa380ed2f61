"""Queries, their colours and levels, without a window."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from langsplat_core.display.displays import NO_HEAT, Subject, relevancies
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.scene import CANONICAL_PHRASES, Reading
from langsplat_core.semantics.store import ImageFeatures
from langsplat_viewer.actions import browsing, editing, queries, settings
from langsplat_viewer.files.projects import QuerySet, SavedQuery, read_queries, write_queries
from langsplat_viewer.marks import BINS
from langsplat_viewer.output import describe
from langsplat_viewer.panels.search import hint, histogram
from langsplat_viewer.viewer import Services
from tests.support.fakes import CENTRES, FakeEncoder, as_trained, axis, blob_scene, calibrated_for, language
from tests.support.windowless import SCENES, ask, errors, load, open_scene, settle


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
    (pane,) = opened.state.panes()
    columns = relevancies(Subject(360, answers=pane.answers))
    assert columns.shape == (360, 1)
    assert columns[:120].mean() > 0.9 > 0.6 > columns[120:].mean()
    assert pane.ranges == (query.result.heat_range,)


def test_an_unknown_word_takes_no_colour_and_says_what_may_be_meant(opened):
    ask(opened, "mug", "book", "plant", "plamt pot", "plamt")
    assert [query.slot for query in opened.state.queries] == [0, 1, 2, None, None]
    typo = opened.state.queries[4]
    assert (typo.phrase, typo.meant) == ("plamt", "plant")
    assert "did you mean 'plant'?" in typo.problem
    assert opened.state.queries[3].meant == ""  # "pot" is like no word


def test_a_correction_is_offered_and_takes_the_place_of_the_typo(opened):
    ask(opened, "red plamt")
    assert queries.offers(opened) == ("did you mean", ())  # "red" is like no word either
    ask(opened, "plamt")
    assert queries.offers(opened) == ("did you mean", ("plant",))
    queries.ask_offered(opened, "plant")
    settle(opened)
    assert [query.phrase for query in opened.state.queries] == ["red plamt", "plant"]
    assert opened.state.queries[1].result.found
    assert opened.state.queries[1].slot == 0


def test_commas_separate_searches_and_quotes_are_no_part_of_them(opened):
    ask(opened, '"mug", plant; book, not mug')
    assert [query.phrase for query in opened.state.queries] == ["mug", "plant", "book, not mug"]
    queries.ask(opened, "?!")
    assert "no word to look for" in errors(opened)[-1]
    ask(opened, "the")
    assert "names nothing" in opened.state.queries[-1].problem or "names nothing" in errors(opened)[-1]


def test_earlier_phrases_come_back_by_the_arrows(opened):
    assert queries.recall(opened, -1) == ""
    for text in ("mug", "book", "Mug"):
        queries.ask(opened, text)
    assert [queries.recall(opened, step) for step in (-1, -1, -1, 1, 1)] == ["Mug", "book", "book", "Mug", ""]


def test_examples_are_offered_until_the_first_search_and_each_is_found(viewer):
    open_scene(viewer, "book.ply")
    assert queries.offers(viewer) == ("try", ())
    queries.prepare_suggestions(viewer)
    assert viewer.worker.current == ("finding examples", 0.0) or viewer.state.suggestions.examples
    settle(viewer)
    assert queries.offers(viewer) == ("try", ("book",))
    assert hint(viewer) == "book, ..."
    queries.prepare_suggestions(viewer)
    assert viewer.worker.current is None  # once per scene
    viewer.state.typed = "bo"
    assert queries.offers(viewer) == ("", ("book",))
    viewer.state.typed = ""
    queries.ask_offered(viewer, "book")
    settle(viewer)
    assert viewer.state.queries[0].result.found
    open_scene(viewer, "plain.ply")
    queries.prepare_suggestions(viewer)
    assert queries.offers(viewer) == ("try", ())


def test_empty_and_repeated_phrases(opened):
    queries.ask(opened, "   ")
    assert opened.state.queries == []
    ask(opened, "mug", " Mug ")
    assert [query.phrase for query in opened.state.queries] == ["mug"]


def test_a_fourth_query_takes_the_oldest_ones_colour(opened):
    ask(opened, "mug", "book", "plant")
    assert [query.slot for query in opened.state.queries] == [0, 1, 2]
    ask(opened, "mug or book")
    slots = {query.phrase: query.slot for query in opened.state.queries}
    assert slots == {"mug": None, "book": 1, "plant": 2, "mug or book": 0}


def test_hiding_keeps_the_colours_of_the_others(opened):
    ask(opened, "mug", "book")
    mug, book = opened.state.queries
    queries.hide(opened, mug)
    (pane,) = opened.state.panes()
    columns = relevancies(Subject(360, answers=pane.answers))
    assert columns.shape == (360, 2)
    assert not columns[:, 0].any()
    assert pane.ranges == (NO_HEAT, book.result.heat_range)
    assert columns[120:240, 1].mean() > 0.9
    queries.show(opened, mug)
    assert (mug.slot, book.slot) == (0, 1)
    queries.remove(opened, book)
    assert len(opened.state.shown_results()) == 1
    queries.remove(opened, mug)
    assert opened.state.shown_results() == ()


def test_queries_are_combined_as_the_grammar_reads_them(opened):
    ask(opened, "mug", "book")
    mug, book = opened.state.queries
    for join in queries.JOINS:
        queries.ask_combined(opened, mug, join, book)
    settle(opened)
    both, either, only = opened.state.queries[2:]
    assert [query.result.found for query in (both, either, only)] == [True] * 3
    assert either.result.members.sum() == 240 > only.result.members.sum() == 120
    assert (only.result.members == mug.result.members).all()


def test_the_box_is_emptied_by_a_search_and_by_nothing_else(opened):
    opened.state.typed = "  "
    queries.ask_typed(opened)
    assert (opened.state.typed, opened.state.queries) == ("  ", [])
    opened.state.typed = "mug "
    queries.ask_typed(opened)
    assert (opened.state.typed, opened.state.queries[0].phrase) == ("", "mug")
    assert queries.take_search_focus(opened)  # for the next phrase
    opened.state.show_panel = False
    queries.focus_search(opened)
    assert opened.state.show_panel
    assert queries.take_search_focus(opened)
    assert not queries.take_search_focus(opened)  # said once


def test_all_queries_go_at_once_and_come_back(opened):
    for phrase in ("mug", "plant"):
        ask(opened, phrase)
    queries.remove_all(opened)
    assert (opened.state.queries, opened.state.selected) == ([], None)
    editing.undo(opened)
    assert [query.phrase for query in opened.state.queries] == ["mug", "plant"]


@pytest.mark.parametrize(("logit", "verdict"), [(9.0, "found"), (1.0, "weak match"), (-3.0, "not here")])
def test_a_calibrated_scene_gives_verdicts_with_probability(viewer, monkeypatch, logit, verdict):
    reading = Reading(calibration=calibrated_for("mug", logit))
    scene = replace(blob_scene(), language=replace(language(), reading=reading))
    monkeypatch.setitem(SCENES, "sure.ply", scene)
    open_scene(viewer, "sure.ply")
    ask(viewer, "mug")
    result = viewer.state.queries[0].result
    assert (result.verdict, result.found) == (verdict, verdict == "found")
    assert (viewer.state.queries[0].slot is None) == (verdict == "not here")
    said = f"'mug': {verdict} ({100 * result.probability:.0f} %), score "
    assert describe(result).startswith(said)


# Evidence.


def test_an_answer_is_explained_by_what_training_kept(opened, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ask(opened, "book")
    (query,) = opened.state.queries
    queries.explain(opened, query)
    settle(opened)
    assert "--work" in errors(opened)[-1]
    scene = opened.state.scene
    seen = ImageFeatures(np.zeros((3, 120, 160), np.int32), axis(1)[None])
    as_trained(tmp_path / "blobs.ply", scene, [seen] * len(scene.cameras))
    queries.explain(opened, query)
    settle(opened)
    assert opened.state.evidence.phrase == "book"
    assert opened.state.evidence.image.ndim == 3
    opened.state.evidence = None
    assert opened.state.evidence is None


# Own cuts, canonical phrases and sets of queries, without a window.


@pytest.fixture
def asked(opened):
    """Three blobs, and "mug" asked."""
    ask(opened, "mug")
    return opened


def test_an_answer_ends_where_one_says_and_can_end_by_itself_again(asked):
    (query,) = asked.state.queries
    automatic = query.result
    assert automatic.own_cut is None
    assert 0 < automatic.members.sum() < 360
    key = asked.state.panes()
    for cut in (0.0, float(np.median(automatic.even)), 1.1):
        queries.set_cut(asked, query, cut)
        assert query.result.cut == cut
        np.testing.assert_array_equal(query.result.members, automatic.even >= np.float32(cut))
        assert query.result.heat_range[0] <= min(cut, automatic.peak)
    assert asked.state.panes() != key
    queries.set_cut(asked, query, None)
    assert query.result is automatic


def test_a_cut_is_undone_in_one_step_and_outlives_another_level(asked):
    (query,) = asked.state.queries
    automatic = query.result
    queries.set_cut(asked, query, 0.6)
    for value in (0.61, 0.62):  # the slider moves on
        queries.set_cut(asked, query, value, is_new=False)
    queries.set_level(asked, "part")
    settle(asked)
    assert (query.result.level, query.result.own_cut) == (1, 0.62)
    editing.undo(asked)
    settle(asked)
    assert query.result.own_cut == 0.62
    editing.undo(asked)
    settle(asked)
    assert query.result.own_cut is None
    np.testing.assert_array_equal(query.result.members, automatic.members)
    editing.redo(asked)
    assert query.result.own_cut == 0.62


def test_everything_can_be_compared_with_other_phrases(asked):
    (query,) = asked.state.queries
    before = query.result
    queries.set_canonical(asked, "book, plant")
    settle(asked)
    assert asked.state.canonical == ("book", "plant")
    assert asked.engine.canonical_phrases == ("book", "plant")
    assert np.abs(query.result.relevancy - before.relevancy).max() > 0.01
    assert query.result.probability is None
    queries.set_canonical(asked, "sofa")  # never taught: all stays as it was
    settle(asked)
    assert "sofa" in errors(asked)[-1]
    assert asked.state.canonical == ("book", "plant")
    queries.set_canonical(asked, "")
    settle(asked)
    assert asked.state.canonical == ()
    assert asked.engine.canonical_phrases == CANONICAL_PHRASES
    np.testing.assert_array_equal(query.result.relevancy, before.relevancy)


def test_a_set_of_queries_is_asked_again(asked, tmp_path):
    queries.set_cut(asked, asked.state.queries[0], 0.7)
    ask(asked, "plant")
    queries.hide(asked, asked.state.queries[1])
    queries.set_level(asked, "whole")
    queries.set_canonical(asked, "book")
    settle(asked)
    path = queries.save_queries(asked, tmp_path)
    assert path.name == "blobs-001.queries.json"
    open_scene(asked, "blobs.ply")
    assert (asked.state.queries, asked.state.canonical) == ([], ())
    browsing.open_dropped(asked, [path])
    settle(asked)
    found = [(query.phrase, query.cut, query.slot is None) for query in asked.state.queries]
    assert found == [("mug", 0.7, False), ("plant", None, True)]
    assert asked.state.canonical == ("book",)
    assert asked.state.level == "whole"
    assert asked.state.queries[0].result.own_cut == 0.7


def test_queries_dropped_with_a_scene_are_asked_of_it(viewer, tmp_path):
    path = tmp_path / "a.queries.json"
    write_queries(path, QuerySet((SavedQuery("mug"),)))
    browsing.open_dropped(viewer, [path, Path("blobs.ply")])
    settle(viewer)
    assert [query.phrase for query in viewer.state.queries] == ["mug"]


def test_nothing_to_save_and_nothing_to_ask_of(viewer, opened, tmp_path):
    assert queries.save_queries(opened, tmp_path) is None
    queries.load_queries(opened, tmp_path / "gone.queries.json")
    assert "gone.queries.json" in errors(opened)[-1]
    open_scene(opened, "plain.ply")
    write_queries(tmp_path / "a.queries.json", QuerySet((SavedQuery("mug"),)))
    queries.load_queries(opened, tmp_path / "a.queries.json")
    assert "searched" in errors(opened)[-1]
    queries.set_canonical(opened, "book")
    assert "language field" in errors(opened)[-1]
    assert opened.state.queries == []


GOOD = {"format": "langsplat-queries", "queries": [{"phrase": "mug"}]}


@pytest.mark.parametrize(
    "change",
    [
        {"format": "other"},
        {"queries": "mug"},
        {"queries": ["mug"]},
        {"queries": [{"phrase": ""}]},
        {"queries": [{"phrase": 3}]},
        {"queries": [{"phrase": "x" * 2000}]},
        {"queries": [{"phrase": "mug", "cut": 2}]},
        {"queries": [{"phrase": "mug", "cut": True}]},
        {"queries": [{"phrase": "mug", "cut": float("nan")}]},
        {"queries": [{"phrase": "mug", "shown": 1}]},
        {"queries": [{"phrase": "mug"}] * 201},
        {"level": "floor"},
        {"level": []},
        {"canonical": "book"},
        {"canonical": [""]},
    ],
)
def test_a_broken_set_is_one_line(tmp_path, change):
    path = tmp_path / "a.queries.json"
    path.write_text(json.dumps(GOOD))
    assert read_queries(path) == QuerySet((SavedQuery("mug"),))
    path.write_text(json.dumps(GOOD | change))
    with pytest.raises(InputError, match="no set of queries") as caught:
        read_queries(path)
    assert str(caught.value).isprintable()


# When the viewer loads the text encoder, and what it says if that fails.


def test_the_histogram_counts_every_gaussian(asked):
    low, high, counts = histogram(asked.state.queries[0].result)
    even = asked.state.queries[0].result.even
    assert (low, high) == (even.min(), max(even.max(), low + 1e-3))
    assert len(counts) == BINS
    assert np.expm1(counts.astype(np.float64)).sum() == pytest.approx(360, rel=1e-5)


def test_an_unexpected_error_of_the_encoder_is_one_line_too(viewer):
    def broken(encoder_id: str):
        raise ZeroDivisionError("deep\ninside")

    viewer.services = replace(viewer.services, load_encoder=broken)
    open_scene(viewer, "blobs.ply")
    ask(viewer, "mug")
    assert viewer.state.queries[0].problem == "internal error: ZeroDivisionError: deep inside"
    settings.set_display(viewer, "depth")  # and life goes on
    assert viewer.state.picture.display == "depth"


@pytest.mark.parametrize("encoder_id", ["demo", "~", "somebody/some-model"])
def test_a_local_encoder_is_loaded_while_the_user_looks_round(viewer, encoder_id):
    """A hub id may mean a download: it waits for a phrase."""
    asked = []
    viewer.services = Services(load, lambda name: asked.append(name) or FakeEncoder(), encoder_id)
    open_scene(viewer, "blobs.ply")
    assert asked == ([] if "/" in encoder_id else [encoder_id])
    queries.ask(viewer, "mug")
    assert viewer.worker.current == ("searching 'mug'", 0.0) or asked
    settle(viewer)
    assert asked == [encoder_id]
    assert viewer.state.queries[0].result.found


def test_phrasebook_needs_no_encoder(viewer):
    def absent(encoder_id: str):
        raise EncoderError("no weights; download them")

    viewer.services = replace(viewer.services, load_encoder=absent)
    open_scene(viewer, "book.ply")
    ask(viewer, "Book", "mug")
    book, mug = viewer.state.queries
    assert book.result.found
    assert mug.problem == "no weights; download them"
