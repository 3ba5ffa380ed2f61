"""Queries, their colours and levels, and the outline, without a window."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from langsplat_core.display.displays import HEAT_BASE, NO_HEAT, Subject, heats
from langsplat_core.errors import EncoderError
from langsplat_core.query.describe import Word
from langsplat_core.query.inventory import Outline
from langsplat_viewer.actions import editing, opening, outline, queries, saving, settings
from langsplat_viewer.actions.editing import take
from langsplat_viewer.panels.search import BINS, hint, histogram
from langsplat_viewer.session import Query, Things
from langsplat_viewer.viewer import Services, Viewer
from tests.support.fakes import CENTRES, FakeEncoder, blob_scene
from tests.support.scenes import with_tree
from tests.support.windowless import (
    SCENES,
    act,
    answer,
    ask,
    blob,
    errors,
    load,
    marked,
    open_scene,
    phrases,
    result,
    settle,
)


def test_query_is_answered_and_shown(opened):
    queries.ask(opened, "  mug ")
    assert answer(opened).pending
    settle(opened)
    assert opened.state.session.queries == (Query("mug", slot=0, shown_since=1),)
    assert (answer(opened).pending, answer(opened).problem) == (False, "")
    assert result(opened).found
    assert result(opened).level == 2
    assert_allclose(result(opened).place, CENTRES[0], atol=0.25)
    assert opened.state.session.picture.display == "relevancy"
    (pane,) = opened.state.panes()
    columns = heats(Subject(360, answers=pane.answers))
    assert columns.shape == (360, 1)
    assert columns[:120].mean() > 0.9
    assert not columns[120:].any()
    assert pane.ranges == ((HEAT_BASE, 1.0),)


def test_correction_replaces_the_typo(opened):
    ask(opened, "red plamt")
    assert queries.offers(opened, "")[0] == ""  # "red" is like no word
    ask(opened, "plamt")
    assert [answer(opened, place).meant for place in (0, 1)] == ["", "plant"]
    assert opened.state.shown() == []
    assert "did you mean 'plant'?" in answer(opened).problem
    assert queries.offers(opened, "") == ("did you mean", ("plant",))
    act(queries.ask_offered, opened, "plant")
    assert phrases(opened) == ["red plamt", "plant"]
    assert result(opened, 1).found
    assert opened.state.session.queries[1].slot == 0


def test_commas_separate_queries_and_quotes_are_dropped(opened):
    ask(opened, "   ", '"mug", plant; book, not mug')
    assert phrases(opened) == ["mug", "plant", "book, not mug"]
    ask(opened, " Mug ")  # again
    assert phrases(opened) == ["plant", "book, not mug", "mug"]
    queries.ask(opened, "?!")
    assert "no word to look for" in errors(opened)[-1]
    ask(opened, "the")
    assert "names nothing" in answer(opened, -1).problem or "names nothing" in errors(opened)[-1]


def test_arrows_recall_earlier_phrases(opened):
    assert queries.recall(opened, -1) == ""
    for text in ("mug", "book", "Mug"):
        queries.ask(opened, text)
    assert [queries.recall(opened, step) for step in (-1, -1, -1, 1, 1)] == ["Mug", "book", "book", "Mug", ""]


def test_examples_are_offered_while_nothing_is_typed(viewer):
    open_scene(viewer, "book.ply")
    assert queries.offers(viewer, "") == ("", ())
    queries.prepare_suggestions(viewer)
    assert viewer.worker.current == ("finding examples", 0.0) or viewer.state.suggestions.examples
    settle(viewer)
    assert queries.offers(viewer, "") == ("", ("book",))
    assert hint(viewer) == "book, ..."
    queries.prepare_suggestions(viewer)
    assert viewer.worker.current is None  # once per scene
    assert queries.offers(viewer, "bo") == ("", ("book",))
    act(queries.ask_offered, viewer, "book")
    assert result(viewer, 0).found
    open_scene(viewer, "plain.ply")
    queries.prepare_suggestions(viewer)
    assert queries.offers(viewer, "") == ("", ())


def test_fourth_query_takes_the_colour_of_the_oldest(opened):
    ask(opened, "mug", "book")
    queries.show(opened, "mug", shown=False)
    (pane,) = opened.state.panes()
    columns = heats(Subject(360, answers=pane.answers))
    assert columns.shape == (360, 2)
    assert not columns[:, 0].any()
    assert pane.ranges == (NO_HEAT, (HEAT_BASE, 1.0))
    assert columns[120:240, 1].mean() > 0.9
    queries.show(opened, "mug")
    assert [query.slot for query in opened.state.session.queries] == [0, 1]
    ask(opened, "plant", "mug or book")
    assert [query.slot for query in opened.state.session.queries] == [0, None, 2, 1]
    queries.remove(opened, "mug")
    assert [result is not None for result in opened.state.shown_results()] == [False, True, True]
    queries.remove_all(opened)
    assert (opened.state.session.queries, opened.state.session.chosen, opened.state.answers) == ((), "", {})
    queries.remove_all(opened)
    assert opened.state.messages[-1].undoes is None
    editing.undo(opened)
    assert phrases(opened) == ["book", "plant", "mug or book"]


def test_new_answer_replaces_the_picture_of_the_one_before(opened):
    ask(opened, "mug")
    ask(opened, "book")
    assert [query.slot for query in opened.state.session.queries] == [None, 0]
    act(queries.ask, opened, "plant; mug")  # together
    assert {q.phrase: q.slot for q in opened.state.session.queries} == {"book": None, "plant": 0, "mug": 1}
    ask(opened, "zebra")
    assert opened.state.shown() == []  # nothing that was not asked
    editing.undo(opened)
    assert len(opened.state.shown()) == 2
    opened.change(adds=True)
    ask(opened, "book")
    assert sorted(q.slot for q in opened.state.session.queries) == [0, 1, 2]


def test_escape_takes_failed_queries_off_the_list(opened):
    ask(opened, "mug")
    ask(opened, "zebra")
    assert phrases(opened) == ["mug", "zebra"]
    for _ in range(2):
        settings.escape(opened)
        assert phrases(opened) == ["mug"]
        assert (opened.state.session.chosen, len(opened.state.shown())) == ("mug", 1)  # again


def test_name_finds_what_was_given_it_and_others_on_request(opened):
    half = blob("mug") & (np.arange(360) % 2 == 0)
    take(opened, half)
    act(editing.name_selection, opened, "bruno")
    np.testing.assert_array_equal(result(opened).members, half)
    assert result(opened).found
    assert_allclose(result(opened).place, CENTRES[0], atol=0.3)
    act(queries.answer, opened, "bruno", ["bruno"], alike=True)
    np.testing.assert_array_equal(result(opened).members, blob("mug"))
    assert answer(opened).like is None


def test_given_name_finds_the_same_after_opening_the_project(opened, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("blobs.ply").touch()
    half = blob("mug") & (np.arange(360) % 2 == 0)
    take(opened, half)
    act(editing.name_selection, opened, "Bruno")
    assert opened.state.is_changed
    path = saving.save_project(opened, tmp_path)
    open_scene(opened, "plain.ply")
    act(opening.open_project, opened, path)
    assert [word.name for word in opened.engine.taught.values()] == ["Bruno"]
    np.testing.assert_array_equal(result(opened).members, half)
    assert answer(opened).like is not None


def test_letters_for_a_box_that_is_not_there_are_no_keys(viewer):
    viewer.state.show_start = True
    queries.focus_search(viewer)
    assert (viewer.state.letters_muted, viewer.state.show_start) == (True, True)
    settings.escape(viewer)
    assert not viewer.state.letters_muted


# Thresholds of one's own.


def test_threshold_is_set_and_reset_and_the_histogram_counts_all(asked):
    automatic = result(asked)
    assert automatic.own_cut is None
    assert 0 < automatic.members.sum() < 360
    key = asked.state.panes()
    for cut in (0.0, float(np.median(automatic.even)), 1.0):
        queries.set_cut(asked, "mug", cut)
        found = result(asked)
        assert found.cut == cut
        assert result(asked) is found  # so that nothing is drawn anew
        np.testing.assert_array_equal(found.members, automatic.even >= np.float32(cut))
        assert found.heat_range[0] <= min(cut, automatic.peak)
    assert asked.state.panes() != key
    queries.set_cut(asked, "mug", None)
    assert result(asked) is automatic
    low, high, counts = histogram(result(asked, 0))
    even = result(asked, 0).even
    assert (low, high) == (even.min(), max(even.max(), low + 1e-3))
    assert len(counts) == BINS
    assert np.expm1(counts.astype(np.float64)).sum() == pytest.approx(360, rel=1e-5)


def test_threshold_is_one_step_and_outlives_the_level(asked):
    automatic = result(asked)
    queries.set_cut(asked, "mug", 0.6)
    for value in (0.61, 0.62):  # the slider moves on
        queries.set_cut(asked, "mug", value)
    act(queries.set_level, asked, "part")
    assert (result(asked).level, result(asked).own_cut) == (1, 0.62)
    act(editing.undo, asked)
    assert result(asked).own_cut == 0.62
    act(editing.undo, asked)
    assert result(asked).own_cut is None
    np.testing.assert_array_equal(result(asked).members, automatic.members)
    editing.redo(asked)
    assert result(asked).own_cut == 0.62


# When the viewer loads the text encoder, and what it says if that fails.


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (EncoderError("no weights; download them"), "no weights; download them"),
        (OSError(28, "No space left"), "No space left"),
        (ZeroDivisionError("deep\ninside"), "internal error: ZeroDivisionError: deep inside"),
    ],
)
def test_failing_encoder_is_one_line_and_phrasebook_needs_none(viewer, error, said):
    def broken(encoder_id: str):
        raise error

    viewer.services = replace(viewer.services, load_encoder=broken)
    open_scene(viewer, "book.ply")
    ask(viewer, "Book", "mug")
    assert (result(viewer, 0).found, answer(viewer, 1).problem) == (True, said)


@pytest.mark.parametrize("encoder_id", ["demo", "~", "somebody/some-model"])
def test_local_encoder_is_loaded_after_opening(viewer, encoder_id):
    """A hub id may mean a download: it waits for a phrase."""
    asked = []
    viewer.services = Services(load, lambda name: asked.append(name) or FakeEncoder(), encoder_id)
    open_scene(viewer, "blobs.ply")
    assert asked == ([] if "/" in encoder_id else [encoder_id])
    queries.ask(viewer, "mug")
    assert viewer.worker.current == ("searching 'mug'", 0.0) or asked
    settle(viewer)
    assert asked == [encoder_id]
    assert result(viewer, 0).found


# The outline: the tree in words, and what is done with its rows.


@pytest.fixture
def outlined(viewer, monkeypatch):
    """The blobs with a tree, its outline found."""
    monkeypatch.setitem(SCENES, "tree.ply", with_tree(blob_scene(phrasebook=True)))
    open_scene(viewer, "tree.ply")
    ask(viewer, "mug")  # so that the encoder is known to be there
    assert outline.wanted(viewer).problem == "looking for what is here ..."
    settle(viewer)
    assert outline.wanted(viewer).problem == ""
    return viewer


def row_of(viewer, word: str):
    """The row of most of a blob."""
    tree = viewer.state.outline.tree
    return max(viewer.state.outline.roots, key=lambda row: (tree.members(row.node) & blob(word)).sum())


@pytest.fixture
def nodes(outlined) -> list[int]:
    """Of mug, book and plant."""
    return [row_of(outlined, word).node for word in ("mug", "book", "plant")]


def test_outline_row_is_named_and_selects_its_thing(outlined, monkeypatch):
    before = outlined.state.open.view
    for word, centre in zip(("mug", "book", "plant"), CENTRES, strict=True):
        row = row_of(outlined, word)
        assert word in outline.name_of(outlined, row)
        assert (outlined.engine.tree.members(row.node) == blob(word)).all()
        act(outline.visit, outlined, row.node)
        assert marked(outlined)[0] == word
        assert outlined.state.glide.end.distance < before.distance
        np.testing.assert_allclose(outlined.state.glide.end.target, centre, atol=0.2)
    assert sum(row.count for row in outlined.state.outline.roots) == 360
    assert outline.sure_of(outlined, row) == (False, "?")  # however probable: nothing is calibrated
    monkeypatch.setattr(Viewer, "has_percentages", True)
    for probability, said in ((0.94, (True, " 94 %")), (0.5, (False, "? 50 %"))):
        likely = replace(row.word, probability=probability)
        assert outline.sure_of(outlined, replace(row, word=likely)) == said


def test_click_selects_an_instance_and_hidden_rows_keep_it(outlined, nodes):
    for choose, centre, word in (
        (outline.select, CENTRES[2], "plant"),
        (outline.find_alike, CENTRES[0], "mug"),
    ):
        act(choose, outlined, centre)
        assert marked(outlined)[0] == word
    mug, book, _ = nodes
    take(outlined, blob("plant"))
    act(outline.hide, outlined, mug)
    assert marked(outlined) == ("plant", "mug", "")
    hidden = outline.hidden_nodes(outlined)
    assert (hidden[mug], hidden[book]) == (True, False)
    assert outline.hidden_nodes(outlined) is hidden
    act(outline.show, outlined, mug)
    assert marked(outlined) == ("plant", "", "")
    editing.undo(outlined)
    assert outline.hidden_nodes(outlined)[mug]


def test_given_name_is_taught_and_filtered(outlined):
    mug = row_of(outlined, "mug")
    act(outline.give_name, outlined, mug.node, "  grandma's cup ")
    assert (outline.name_of(outlined, mug), outline.sure_of(outlined, mug)) == ("grandma's cup", (True, ""))
    assert outlined.state.session.queries[-1].phrase == "grandma's cup"
    assert result(outlined, -1).found
    rows = list(outline.filtered(outlined, outlined.state.outline.roots, "CUP grand"))
    assert [row.node for row in rows] == [mug.node]
    assert list(outline.filtered(outlined, outlined.state.outline.roots, "zebra")) == []
    book = row_of(outlined, "book").node
    act(outline.give_name, outlined, book, "the atlas")
    assert outlined.engine.taught.keys() == {"grandma's cup", "the atlas"}
    act(outline.give_name, outlined, book, "of")  # which names nothing
    assert outlined.state.session.things.names[book] == "the atlas"
    outlined.state.messages.clear()
    outline.give_name(outlined, mug.node, " ")
    assert errors(outlined) == []


@pytest.mark.parametrize("field", [True, False])
def test_project_keeps_names_of_known_nodes(outlined, nodes, tmp_path, monkeypatch, field):
    """As after training anew, or for a scene whose field is gone."""
    monkeypatch.chdir(tmp_path)
    Path("tree.ply").touch()
    act(outline.give_name, outlined, nodes[1], "the atlas")
    things, path = outlined.state.session.things, saving.save_project(outlined, tmp_path)
    open_scene(outlined, "plain.ply")
    assert outlined.state.session.things != things
    act(opening.open_project, outlined, path)
    assert outlined.state.session.things == things
    top = json.loads(path.read_text())
    top["session"]["things"]["names"][10**9] = "ghost"
    path.write_text(json.dumps(top))
    if not field:
        monkeypatch.setitem(SCENES, "tree.ply", replace(SCENES["tree.ply"], language=None))
    act(opening.open_project, outlined, path)
    assert outlined.state.session.things == (things if field else Things())


def test_scene_of_other_gaussians_drops_names(outlined, monkeypatch):
    outlined.put(things=Things({0: "cup"}))
    monkeypatch.setitem(SCENES, "tree.ply", with_tree(SCENES["tree.ply"].take(np.arange(300))))
    act(opening.reload, outlined)
    assert outlined.state.session.things == Things()


def test_things_have_the_colour_of_the_image(outlined, nodes):
    settings.set_display(outlined, "rgb")
    mug, book, _ = nodes
    assert outline.colour_of(outlined, mug) is None
    for display in ("latent", "tree"):
        settings.set_display(outlined, display, 2)
        one, other = outline.colour_of(outlined, mug), outline.colour_of(outlined, book)
        assert np.abs(np.subtract(one, other)).max() > 0.05
    named = [outline.name_of(outlined, row) for row in outline.in_view(outlined)]
    assert {"mug", "book", "plant"} <= {word for name in named for word in name.split()}


def test_outline_needs_a_field_and_downloads_no_encoder(viewer, monkeypatch):
    scene = SCENES["blobs.ply"]
    far = replace(scene, language=replace(scene.language, encoder_id="hub/of-someone"))
    monkeypatch.setitem(SCENES, "blobs.ply", far)
    open_scene(viewer, "blobs.ply")
    assert "hub/of-someone" in outline.wanted(viewer).problem
    assert viewer.worker.current is None
    open_scene(viewer, "plain.ply")
    assert outline.wanted(viewer).problem == viewer.state.why_no_field
    outline.select(viewer, np.zeros(3))
    assert "language field" in errors(viewer)[-1]


def test_outline_begins_with_things():
    def row(node: int, word: str | None) -> Outline:
        name = None if word is None else Word(word, 0.9)
        return Outline(node, 2, name, 9, 0.1, np.zeros(3), np.ones(3), (1, 0), ())

    rows = [row(0, "wall"), row(1, "table"), row(2, "wooden floor or floor"), row(3, None), row(4, "wallet")]
    assert [found.node for found in outline.things_first(rows)] == [1, 3, 4, 0, 2]
