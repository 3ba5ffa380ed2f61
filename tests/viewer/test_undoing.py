"""Undo and redo of what was asked, shown and marked, and of how it was looked at."""

import gc
import tracemalloc
import weakref
from dataclasses import replace

import numpy as np
import pytest

from langsplat_viewer.actions import editing, opening, queries, selecting, settings
from langsplat_viewer.actions.selecting import mark
from langsplat_viewer.marks import Marks, hiding, unmarked
from langsplat_viewer.rendering.request import Clip, Splats
from langsplat_viewer.viewer import GESTURE, MOST_STEPS
from tests.support.windowless import ask, open_scene, settle


def phrases(viewer) -> list[str]:
    return [query.phrase for query in viewer.state.queries]


def test_a_query_is_undone_and_done_again(opened):
    ask(opened, "mug", "book")
    editing.undo(opened)
    assert phrases(opened) == ["mug"]
    editing.undo(opened)
    assert phrases(opened) == []
    assert opened.state.picture.display == "rgb"
    editing.undo(opened)
    assert "nothing to undo" in opened.state.messages[-1].text
    editing.redo(opened)
    editing.redo(opened)
    settle(opened)
    assert phrases(opened) == ["mug", "book"]
    assert [query.slot for query in opened.state.queries] == [0, 1]
    assert opened.state.picture.display == "relevancy"
    assert len(opened.state.shown_results()) == 2
    editing.redo(opened)
    assert "nothing to redo" in opened.state.messages[-1].text


def test_a_removed_query_comes_back_with_its_answer_and_colour(opened):
    ask(opened, "mug", "book")
    mug = opened.state.queries[0]
    queries.set_cut(opened, mug, 0.6)
    count = mug.result.members.sum()
    queries.remove(opened, mug)
    editing.undo(opened)
    settle(opened)
    assert opened.state.queries[0] is mug
    assert mug.slot == 0
    assert mug.cut == 0.6
    assert mug.result.found
    assert mug.result.members.sum() == count
    assert len(mug.things) == 1


def leave_by_removing(viewer) -> None:
    queries.remove(viewer, viewer.state.queries[-1])


@pytest.mark.parametrize("leave", [leave_by_removing, editing.undo])
def test_history_keeps_no_answers_of_queries_that_are_gone(opened, leave):
    """Each has a number for every Gaussian and level."""
    ask(opened, "mug")
    stays, gone = opened.state.queries[0].result, []
    for word in ("book", "plant"):
        ask(opened, word)
        gone.append(weakref.ref(opened.state.queries[-1].result))
        opened.state.panes()
        leave(opened)
    gc.collect()
    assert [there() for there in gone] == [None, None]
    assert opened.state.queries[0].result is stays
    (editing.redo if leave is editing.undo else editing.undo)(opened)
    settle(opened)
    assert opened.state.queries[-1].phrase == "plant"
    assert opened.state.queries[-1].result.found


def test_an_answer_that_comes_after_its_query_was_taken_off_is_dropped(opened):
    queries.ask(opened, "mug")
    mug = opened.state.queries[0]
    queries.remove(opened, mug)
    settle(opened)
    assert (mug.result, mug.pending) == (None, False)
    editing.undo(opened)
    assert mug.pending
    settle(opened)
    assert mug.result.found


def test_colour_level_and_display_are_undone(opened):
    ask(opened, "mug")
    query = opened.state.queries[0]
    queries.hide(opened, query)
    queries.set_level(opened, "part")
    settings.set_display(opened, "depth")
    settle(opened)
    editing.undo(opened)
    assert opened.state.picture.display == "relevancy"
    editing.undo(opened)
    settle(opened)
    assert (opened.state.level, query.result.level) == ("auto", 2)
    editing.undo(opened)
    assert query.slot == 0


def test_another_scene_and_a_long_day(opened):
    for _ in range(MOST_STEPS):
        settings.set_display(opened, "depth")
        settings.set_display(opened, "rgb")
    assert len(opened.history.past) == MOST_STEPS
    open_scene(opened, "bare.ply")
    assert opened.history.past == []


SETTINGS = {
    "picture": lambda v: settings.set_picture(
        v, replace(v.state.picture, dim=0.2, background=(1.0, 1.0, 1.0))
    ),
    "colour map": lambda v: settings.set_colour_map(v, "viridis"),
    "wipe": settings.toggle_wipe,
    "levels": settings.toggle_levels,
    "line": lambda v: settings.move_line(v, 0.3),
    "splats": lambda v: settings.set_splats(v, Splats(0.5, 0)),
    "cut": lambda v: settings.set_clip(v, Clip(1.0, 2.0)),
    "overlay": lambda v: settings.toggle_overlay(v, "grid"),
    "backdrop": lambda v: settings.save_transparent(v, True),
    "photograph": lambda v: opening.fade_photograph(v, 0.5),
    "latents": lambda v: settings.set_display(v, "latent", 1),
}


def looks(viewer) -> tuple[object, ...]:
    state = viewer.state
    kept = (state.preferences.overlays, state.preferences.colour_map)
    return state.picture, state.settings, state.latent_level, kept


@pytest.mark.parametrize("name", SETTINGS)
def test_a_setting_of_what_is_seen_is_undone_in_one_step(opened, name):
    before = looks(opened)
    SETTINGS[name](opened)
    after = looks(opened)
    assert after != before
    SETTINGS["wipe" if name == "levels" else "levels"](opened)
    for wanted in (after, before):
        editing.undo(opened)
        assert looks(opened) == wanted
    assert opened.history.past == []
    editing.redo(opened)
    assert looks(opened) == after


@pytest.mark.parametrize("name", SETTINGS)
def test_what_changes_nothing_is_no_step(opened, name):
    SETTINGS[name](opened)
    count = len(opened.history.past)
    if name in ("wipe", "levels", "overlay"):  # which would go back
        assert count == 1
    else:
        SETTINGS[name](opened)
        assert len(opened.history.past) == count == 1


def slide(viewer, seconds: float, dim: float) -> None:
    viewer.clock = seconds
    settings.set_picture(viewer, replace(viewer.state.picture, dim=dim))


def test_a_slider_that_is_moved_is_one_step_and_another_time_another(opened):
    for frame in range(10):
        slide(opened, 5 + 0.1 * frame, 0.4 - 0.01 * frame)
    assert len(opened.history.past) == 1
    slide(opened, 5.9 + 1.1 * GESTURE, 0.9)
    assert len(opened.history.past) == 2
    editing.undo(opened)
    assert opened.state.picture.dim == pytest.approx(0.31)
    slide(opened, opened.clock, 0.8)  # after an undo a step of its own
    editing.undo(opened)
    assert opened.state.picture.dim == pytest.approx(0.31)
    editing.undo(opened)
    assert opened.state.picture.dim == 0.45


def test_the_ruler_is_not_undone(opened):
    settings.toggle_wipe(opened)
    settings.measure(opened, True)
    editing.undo(opened)
    assert opened.state.ruler.measures
    assert opened.state.settings.split.mode == "off"


def test_an_undone_setting_leaves_the_marks_the_same_objects(opened):
    """Else the scene would be made anew for every slider."""
    selecting.select_all(opened)
    settings.toggle_wipe(opened)
    marks = opened.state.selection.marks
    editing.undo(opened)
    editing.redo(opened)
    assert opened.state.selection.marks is marks
    selecting.hide_selected(opened)
    hidden = opened.state.selection.marks.hidden
    mark(opened, replace(opened.state.selection.marks, selected=~hidden | True))
    editing.undo(opened)
    assert opened.state.selection.marks.hidden is hidden


def changed(marks: Marks, rng: np.random.Generator, step: int) -> Marks:
    """Selected and hidden in turn."""
    if step % 2:
        return hiding(marks)
    return replace(marks, selected=(rng.uniform(size=len(marks.selected)) < 0.02) & marks.shown)


def test_a_hundred_changes_of_a_million_gaussians_take_little_memory(viewer):
    """At random, so that nothing could be shared."""
    count, rng = 1_000_000, np.random.default_rng(0)
    viewer.state.selection = replace(viewer.state.selection, marks=unmarked(count))
    tracemalloc.start()
    try:
        for step in range(MOST_STEPS):
            mark(viewer, changed(viewer.state.selection.marks, rng, step))
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(viewer.history.past) == MOST_STEPS
    now = viewer.state.selection.marks
    own = sum(mask.nbytes for mask in (now.selected, now.hidden))
    assert held - own < 15e6
