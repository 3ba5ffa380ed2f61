"""Selecting, hiding and deleting without a window: verbs, answers, settings, undo."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_viewer import marks
from langsplat_viewer.actions import opening, queries, selecting, undoing
from langsplat_viewer.actions.selecting import NOTHING, take
from langsplat_viewer.panels.select import counts
from tests.support.selected import blob, marked, marks_of, names
from tests.support.windowless import errors, settle


@pytest.fixture
def searched(opened):
    """One answer: the book."""
    queries.ask(opened, "book")
    settle(opened)
    return opened


def test_everything_nothing_and_the_rest(opened):
    selecting.select_all(opened)
    assert marked(opened) == ("mug book plant", "", "")
    selecting.select_none(opened)
    assert marked(opened) == ("", "", "")
    take(opened, blob("book"))
    selecting.invert_selection(opened)
    assert marked(opened) == ("mug plant", "", "")


@pytest.mark.parametrize(
    ("mode", "selected"),
    [("replace", "book plant"), ("add", "mug book plant"), ("remove", "mug"), ("intersect", "book")],
)
def test_what_is_found_is_combined_by_the_mode(opened, mode, selected):
    take(opened, blob("mug") | blob("book"))
    selecting.set_mode(opened, mode)
    take(opened, blob("book") | blob("plant"))
    assert marked(opened)[0] == selected


def test_a_mode_that_is_held_goes_before_the_one_that_is_set(opened):
    selecting.set_mode(opened, "remove")
    take(opened, blob("mug"), "add")
    assert marked(opened)[0] == "mug"


def test_hidden_and_deleted_ones_are_never_selected(opened):
    take(opened, blob("mug"))
    selecting.hide_selected(opened)
    take(opened, blob("plant"))
    selecting.delete_selected(opened)
    assert marked(opened) == ("", "mug", "plant")
    selecting.select_all(opened)
    assert marked(opened) == ("book", "mug", "plant")
    selecting.invert_selection(opened)
    assert marked(opened) == ("", "mug", "plant")
    selecting.show_hidden(opened)
    selecting.select_all(opened)
    assert marked(opened) == ("mug book", "", "plant")


def test_isolating_hides_all_else_but_what_is_gone(opened):
    take(opened, blob("plant"))
    selecting.delete_selected(opened)
    take(opened, blob("mug"))
    selecting.isolate_selected(opened)
    assert marked(opened) == ("mug", "book", "plant")


def test_every_change_is_one_step_back_and_forth(opened):
    take(opened, blob("mug"))
    selecting.hide_selected(opened)
    take(opened, blob("book"))
    selecting.delete_selected(opened)
    selecting.show_hidden(opened)
    states = [
        ("", "", "book"),
        ("", "mug", "book"),
        ("book", "mug", ""),
        ("", "mug", ""),
        ("mug", "", ""),
        ("", "", ""),
    ]
    assert marked(opened) == states[0]
    for state in states[1:]:
        undoing.undo(opened)
        assert marked(opened) == state
    for state in states[-2::-1]:
        undoing.redo(opened)
        assert marked(opened) == state


def test_what_changes_nothing_is_no_step(opened):
    selecting.select_none(opened)
    selecting.show_hidden(opened)
    take(opened, blob("mug"))
    take(opened, blob("mug"))
    assert len(opened.history.past) == 1
    selecting.use_tool(opened, "brush")
    selecting.set_brush(opened, 0.1)
    assert len(opened.history.past) == 1


def test_undo_of_a_query_keeps_the_selection_of_then(searched):
    take(searched, blob("mug"))
    queries.ask(searched, "plant")
    settle(searched)
    undoing.undo(searched)
    assert marked(searched)[0] == "mug"
    assert [query.phrase for query in searched.state.queries] == ["book"]


def test_what_the_search_found(searched):
    selecting.select_query(searched)
    assert marked(searched)[0] == "book"
    queries.ask(searched, "mug")
    settle(searched)
    selecting.select_query(searched, mode="add")
    assert marked(searched)[0] == "mug book"


def test_nothing_was_searched_or_found(searched):
    query = searched.state.queries[0]
    query.result = replace(query.result, found=False, probability=None, excess=None)
    selecting.select_query(searched)
    assert "'book' is not here" in searched.state.messages[-1].text
    selecting.find_things(searched)
    assert searched.worker.current is None
    queries.remove(searched, query)
    selecting.select_query(searched)
    assert "search for something first" in searched.state.messages[-1].text
    assert marked(searched) == ("", "", "")


def test_things_of_an_answer_one_by_one(searched):
    selecting.find_things(searched)
    settle(searched)
    things = searched.state.selection.things
    assert things.phrase == "book"
    assert len(things.found) == 1
    selecting.select_thing(searched, 0)
    np.testing.assert_array_equal(np.flatnonzero(marks_of(searched).selected), things.found[0].members)
    selecting.select_thing(searched, 1)  # there is none
    assert marks_of(searched).selected.sum() == things.found[0].count


def test_growing_and_shrinking_follow_the_surface(opened):
    means = opened.state.scene.gaussians.means
    core = np.linalg.norm(means, axis=1) < 0.15
    take(opened, core)
    selecting.set_reach(opened, 0.15)
    selecting.grow_selection(opened)
    settle(opened)
    grown = marks_of(opened).selected.copy()
    assert core.sum() < grown.sum()
    assert (grown >= core).all()
    assert not (grown & ~blob("book")).any()  # the others are not on its surface
    selecting.shrink_selection(opened)
    settle(opened)
    assert marks_of(opened).selected.sum() < grown.sum()
    undoing.undo(opened)
    assert (marks_of(opened).selected == grown).all()


def test_what_is_found_too_late_is_not_taken(opened):
    take(opened, blob("mug"))
    selecting.grow_selection(opened)
    opened.state.scene = None  # another one is being shown
    settle(opened)
    assert marked(opened)[0] == "mug"


def test_nothing_selected_is_said(opened):
    for act in (selecting.hide_selected, selecting.isolate_selected, selecting.delete_selected):
        act(opened)
        assert opened.state.messages[-1].text == NOTHING
    selecting.grow_selection(opened)
    selecting.shrink_selection(opened)
    assert opened.worker.current is None
    assert opened.history.past == []


def test_without_a_scene_it_is_said(viewer):
    for act in (
        selecting.select_all,
        selecting.invert_selection,
        selecting.show_hidden,
        selecting.delete_selected,
    ):
        act(viewer)
    assert set(errors(viewer)) == {"open a scene first, then select in it"}


def test_another_scene_has_no_marks_but_the_tool_stays(opened):
    take(opened, blob("mug"))
    selecting.hide_selected(opened)
    selecting.use_tool(opened, "lasso")
    selecting.set_mode(opened, "add")
    opening.open_scene(opened, Path("plain.ply"))
    settle(opened)
    assert marked(opened) == ("", "", "")
    assert (opened.state.selection.tool, opened.state.selection.mode) == ("lasso", "add")


def test_settings_keep_their_limits(opened):
    selecting.set_brush(opened, 9.0)
    selecting.set_reach(opened, 0.0)
    assert opened.state.selection.brush == marks.BRUSHES[1]
    assert opened.state.selection.reach == marks.REACHES[0]
    assert selecting.reach(opened) == pytest.approx(marks.REACHES[0] * opened.state.extent.radius)


def test_counts_are_said(opened):
    take(opened, blob("mug"))
    selecting.delete_selected(opened)
    take(opened, blob("book"))
    assert counts(marks_of(opened)) == "120 of 360 selected, 0 hidden, 120 deleted"
    assert counts(marks.unmarked(0)) == "0 of 0 selected, 0 hidden, 0 deleted"
    assert names(blob("book")) == "book"
