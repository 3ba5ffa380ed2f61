"""Undo and redo of what was asked, shown and marked, and of how it was looked at."""

import gc
import tracemalloc
import weakref
from dataclasses import replace

import numpy as np
import pytest

from langsplat_viewer.actions import editing, queries, settings
from langsplat_viewer.actions.editing import mark
from langsplat_viewer.marks import Marks, hiding, unmarked
from langsplat_viewer.rendering.request import Clip, Splats
from langsplat_viewer.session import Query, Ruler
from langsplat_viewer.viewer import GESTURE, MOST_STEPS
from tests.support.windowless import act, answer, ask, open_scene, phrases, result, settle


def test_undo_and_redo_restore_queries(opened):
    ask(opened, "mug", "book")
    editing.undo(opened)
    assert phrases(opened) == ["mug"]
    editing.undo(opened)
    assert phrases(opened) == []
    assert opened.state.session.picture.display == "rgb"
    editing.undo(opened)
    assert "nothing to undo" in opened.state.messages[-1].text
    editing.redo(opened)
    act(editing.redo, opened)
    assert phrases(opened) == ["mug", "book"]
    assert [query.slot for query in opened.state.session.queries] == [0, 1]
    assert opened.state.session.picture.display == "relevancy"
    assert len(opened.state.shown_results()) == 2
    editing.redo(opened)
    assert "nothing to redo" in opened.state.messages[-1].text


def test_undo_restores_a_removed_query_with_its_colour(opened):
    ask(opened, "mug", "book")
    queries.set_cut(opened, "mug", 0.6)
    mug, count = opened.state.session.queries[0], result(opened, 0).members.sum()
    queries.remove(opened, "mug")
    act(editing.undo, opened)
    assert opened.state.session.queries[0] == mug == Query("mug", 0.6, 0, 1)
    assert (result(opened, 0).found, len(answer(opened, 0).things)) == (True, 1)
    assert result(opened, 0).members.sum() == count


@pytest.mark.parametrize("leave", [lambda v: queries.remove(v, phrases(v)[-1]), editing.undo])
def test_history_keeps_no_answers_of_removed_queries(opened, leave):
    """Each has a number for every Gaussian and level."""
    ask(opened, "mug")
    stays, gone = result(opened, 0), []
    for word in ("book", "plant"):
        ask(opened, word)
        gone.append(weakref.ref(result(opened, -1)))
        opened.state.panes()
        leave(opened)
    gc.collect()
    assert [there() for there in gone] == [None, None]
    assert result(opened, 0) is stays
    (editing.redo if leave is editing.undo else editing.undo)(opened)
    settle(opened)
    assert opened.state.session.queries[-1].phrase == "plant"
    assert result(opened, -1).found


def test_late_answer_of_a_removed_query_is_dropped(opened):
    queries.ask(opened, "mug")
    act(queries.remove, opened, "mug")
    assert opened.state.answers == {}
    editing.undo(opened)
    assert answer(opened).pending
    settle(opened)
    assert result(opened).found


def test_undo_restores_the_level_and_ends_with_the_scene(opened):
    ask(opened, "mug")
    queries.hide(opened, "mug")
    act(queries.set_level, opened, "part")
    act(editing.undo, opened)
    assert (opened.state.session.level, result(opened).level) == ("auto", 2)
    editing.undo(opened)
    assert opened.state.session.queries[0].slot == 0
    for _ in range(MOST_STEPS):
        settings.set_display(opened, "depth")
        settings.set_display(opened, "rgb")
    assert len(opened.history.past) == MOST_STEPS
    open_scene(opened, "bare.ply")
    assert opened.history.past == []


SETTINGS = {
    "picture": lambda v: settings.set_picture(
        v, replace(v.state.session.picture, dim=0.2, background=(1.0, 1.0, 1.0))
    ),
    "display": lambda v: settings.set_display(v, "depth"),
    "colour map": lambda v: settings.set_picture(v, replace(v.state.session.picture, colour_map="viridis")),
    "wipe": settings.toggle_wipe,
    "levels": settings.toggle_levels,
    "line": lambda v: settings.move_line(v, 0.3),
    "splats": lambda v: v.change(splats=Splats(0.5, 0)),
    "cut": lambda v: settings.set_clip(v, Clip(1.0, 2.0)),
    "overlay": lambda v: settings.toggle_overlay(v, "grid"),
    "backdrop": lambda v: settings.set_picture(v, replace(v.state.session.picture, transparent=True)),
    "latents": lambda v: settings.set_display(v, "latent", 1),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_setting_is_undone_in_one_step(opened, name):
    before = opened.state.session
    SETTINGS[name](opened)
    after = opened.state.session
    assert after != before
    if name not in ("wipe", "levels", "overlay"):  # which would go back
        SETTINGS[name](opened)  # changes nothing, and is no step
    assert len(opened.history.past) == 1
    settings.toggle_measuring(opened)  # is never undone
    SETTINGS["wipe" if name == "levels" else "levels"](opened)
    for wanted in (after, before):
        editing.undo(opened)
        assert opened.state.session == replace(wanted, ruler=Ruler(measures=True))
    assert opened.history.past == []
    editing.redo(opened)
    assert opened.state.session == replace(after, ruler=Ruler(measures=True))


def slide(viewer, seconds: float, dim: float) -> None:
    viewer.clock = seconds
    settings.set_picture(viewer, replace(viewer.state.session.picture, dim=dim))


def test_slider_gesture_is_one_step(opened):
    for frame in range(10):
        slide(opened, 5 + 0.1 * frame, 0.4 - 0.01 * frame)
    assert len(opened.history.past) == 1
    slide(opened, 5.9 + 1.1 * GESTURE, 0.9)
    assert len(opened.history.past) == 2
    editing.undo(opened)
    assert opened.state.session.picture.dim == pytest.approx(0.31)
    slide(opened, opened.clock, 0.8)  # after an undo a step of its own
    editing.undo(opened)
    assert opened.state.session.picture.dim == pytest.approx(0.31)
    editing.undo(opened)
    assert opened.state.session.picture.dim == 0.45


def test_undo_of_a_setting_keeps_the_same_mask_objects(opened):
    """Else the scene would be made anew for every slider."""
    editing.select_all(opened)
    settings.toggle_wipe(opened)
    marks = opened.state.marks
    editing.undo(opened)
    editing.redo(opened)
    assert opened.state.marks is marks
    editing.hide_selected(opened)
    hidden = opened.state.marks.hidden
    mark(opened, replace(opened.state.marks, selected=~hidden | True))
    editing.undo(opened)
    assert opened.state.marks.hidden is hidden


def changed(marks: Marks, rng: np.random.Generator, step: int) -> Marks:
    """Selected and hidden in turn."""
    if step % 2:
        return hiding(marks)
    return replace(marks, selected=(rng.uniform(size=len(marks.selected)) < 0.02) & marks.shown)


def test_history_of_a_million_gaussians_takes_little_memory(viewer):
    """At random, so that nothing could be shared."""
    count, rng = 1_000_000, np.random.default_rng(0)
    viewer.state.marks = unmarked(count)
    tracemalloc.start()
    try:
        for step in range(MOST_STEPS):
            mark(viewer, changed(viewer.state.marks, rng, step))
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(viewer.history.past) == MOST_STEPS
    now = viewer.state.marks
    own = sum(mask.nbytes for mask in (now.selected, now.hidden))
    assert held - own < 15e6
