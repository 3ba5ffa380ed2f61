"""Undo and redo of what was asked and shown."""

from pathlib import Path

from langsplat_viewer import actions
from langsplat_viewer.actions.history import LONGEST
from tests.support.windowless import settle


def phrases(viewer) -> list[str]:
    return [query.phrase for query in viewer.state.queries]


def test_a_query_is_undone_and_done_again(opened):
    for word in ("mug", "book"):
        actions.ask(opened, word)
    settle(opened)
    actions.undo(opened)
    assert phrases(opened) == ["mug"]
    actions.undo(opened)
    assert phrases(opened) == []
    assert opened.state.picture.display == "rgb"
    actions.undo(opened)
    assert "nothing to undo" in opened.state.messages[-1].text
    actions.redo(opened)
    actions.redo(opened)
    assert phrases(opened) == ["mug", "book"]
    assert [query.slot for query in opened.state.queries] == [0, 1]
    assert opened.state.picture.display == "relevancy"
    assert opened.state.relevancies().shape == (360, 2)
    actions.redo(opened)
    assert "nothing to redo" in opened.state.messages[-1].text


def test_a_removed_query_comes_back_with_its_answer_and_colour(opened):
    for word in ("mug", "book"):
        actions.ask(opened, word)
    settle(opened)
    mug = opened.state.queries[0]
    actions.remove(opened, mug)
    actions.undo(opened)
    assert opened.state.queries[0] is mug
    assert mug.slot == 0
    assert mug.result.found


def test_colour_level_and_display_are_undone(opened):
    actions.ask(opened, "mug")
    settle(opened)
    query = opened.state.queries[0]
    actions.hide(opened, query)
    actions.set_level(opened, "part")
    actions.set_display(opened, "depth")
    settle(opened)
    actions.undo(opened)
    assert opened.state.picture.display == "relevancy"
    actions.undo(opened)
    settle(opened)
    assert (opened.state.level, query.result.level) == ("auto", 2)
    actions.undo(opened)
    assert query.slot == 0


def test_a_change_after_an_undo_ends_what_could_be_redone(opened):
    actions.ask(opened, "mug")
    actions.undo(opened)
    actions.ask(opened, "book")
    actions.redo(opened)
    assert phrases(opened) == ["book"]


def test_another_scene_and_a_long_day(opened):
    for _ in range(LONGEST):
        actions.set_display(opened, "depth")
        actions.set_display(opened, "rgb")
    assert len(opened.history.past) == LONGEST
    actions.open_scene(opened, Path("bare.ply"))
    settle(opened)
    assert opened.history.past == []
