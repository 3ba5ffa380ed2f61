"""Selecting without the mouse: the verbs, answers and their things, and how tools behave.

Every change of what is selected, hidden or deleted is one step that can be undone; the settings of tools are
not.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.progress import Progress
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.instances import Instance
from langsplat_core.query.selection import grow, of_rows, shrink
from langsplat_viewer.actions.history import remember
from langsplat_viewer.marks import selecting
from langsplat_viewer.marks.selecting import Marks, Mode, Things, Tool
from langsplat_viewer.state import Query
from langsplat_viewer.viewer import Viewer

NOTHING = "nothing is selected: choose a tool, or an answer of the search"


def mark(viewer: Viewer, marks: Marks) -> None:
    """Take other marks, unless they mark the same."""
    selection = viewer.state.selection
    if not marks.same(selection.marks):
        remember(viewer)
        viewer.state.selection = replace(selection, marks=marks)


def take(viewer: Viewer, found: Array, mode: Mode | None = None) -> None:
    """Combine the selection with `found` (N,) bool; `mode` in place of the one that is set."""
    selection = viewer.state.selection
    mark(viewer, selecting.combined(selection.marks, found, mode or selection.mode))


def has_scene(viewer: Viewer) -> bool:
    """Whether a scene is open; says so where none is."""
    if viewer.state.scene is None:
        viewer.state.say("open a scene first, then select in it", is_error=True)
    return viewer.state.scene is not None


def has_selection(viewer: Viewer) -> bool:
    """Whether something is selected; says so where nothing is."""
    if not has_scene(viewer):
        return False
    some = bool(viewer.state.selection.marks.selected.any())
    if not some:
        viewer.state.say(NOTHING)
    return some


def select_all(viewer: Viewer) -> None:
    """Everything that is shown."""
    if has_scene(viewer):
        take(viewer, viewer.state.selection.marks.shown, "replace")


def select_none(viewer: Viewer) -> None:
    """Nothing."""
    if has_scene(viewer):
        take(viewer, np.zeros_like(viewer.state.selection.marks.selected), "replace")


def invert_selection(viewer: Viewer) -> None:
    """Of what is shown, that which was not selected."""
    if has_scene(viewer):
        take(viewer, ~viewer.state.selection.marks.selected, "replace")


def hide_selected(viewer: Viewer) -> None:
    """Out of the picture, until all is shown again."""
    if has_selection(viewer):
        mark(viewer, selecting.hiding(viewer.state.selection.marks))


def isolate_selected(viewer: Viewer) -> None:
    """Everything else out of the picture."""
    if has_selection(viewer):
        mark(viewer, selecting.isolating(viewer.state.selection.marks))


def show_hidden(viewer: Viewer) -> None:
    """All that was hidden."""
    if has_scene(viewer):
        mark(viewer, selecting.showing_all(viewer.state.selection.marks))


def delete_selected(viewer: Viewer) -> None:
    """Out of the scene, as far as it is saved from now on; the file that was opened stays as it is."""
    if has_selection(viewer):
        mark(viewer, selecting.deleting(viewer.state.selection.marks))


def reach(viewer: Viewer) -> float:
    """How far growing and shrinking go at a time, world units."""
    extent = viewer.state.extent
    return viewer.state.selection.reach * (0.0 if extent is None else extent.radius)


def grow_selection(viewer: Viewer) -> None:
    """And what is within reach along the surface."""
    if has_selection(viewer):
        selected, distance = viewer.state.selection.marks.selected, reach(viewer)
        find(viewer, "growing", lambda engine: grow(engine.surface, selected, distance), "add")


def shrink_selection(viewer: Viewer) -> None:
    """Without what is within reach of something else, along the surface."""
    if has_selection(viewer):
        selected, distance = viewer.state.selection.marks.selected, reach(viewer)
        find(viewer, "shrinking", lambda engine: shrink(engine.surface, selected, distance), "intersect")


def find(viewer: Viewer, label: str, work: Callable[[QueryEngine], Array], mode: Mode | None) -> None:
    """Have the worker find (N,) bool with the scene's engine, and take it."""
    engine, scene = viewer.engine, viewer.state.scene
    if engine is None:
        return

    def done(found: Array) -> None:
        if viewer.state.scene is scene:
            take(viewer, found, mode)

    viewer.worker.submit(f"{label} the selection", lambda progress: work(engine), done, _failed(viewer))


def _failed(viewer: Viewer) -> Callable[[str], None]:
    return lambda reason: viewer.state.say(reason, is_error=True)


def chosen_query(viewer: Viewer) -> Query | None:
    """The query whose details are shown, else the latest; None without one."""
    state = viewer.state
    return state.selected or (state.queries[-1] if state.queries else None)


def select_query(viewer: Viewer, query: Query | None = None, mode: Mode | None = None) -> None:
    """What answers a query, by default that of `chosen_query`."""
    query = query or chosen_query(viewer)
    if has_scene(viewer) and query is not None and query.result is not None:
        if query.result.verdict == "not here":
            viewer.state.say(f"'{query.phrase}' is not here: nothing to select")
            return
        take(viewer, query.result.members, mode)
    elif viewer.state.scene is not None:
        viewer.state.say("search for something first, then select what was found")


def find_things(viewer: Viewer, query: Query | None = None) -> None:
    """Have the worker take an answer apart into its things, for `select_thing`."""
    query, engine = query or chosen_query(viewer), viewer.engine
    if engine is None or query is None or query.result is None or query.result.verdict == "not here":
        select_query(viewer, query)  # which says why not
        return
    phrase, result = query.phrase, query.result

    def done(found: tuple[Instance, ...]) -> None:
        if viewer.engine is engine:
            viewer.state.selection = replace(viewer.state.selection, things=Things(phrase, result, found))

    def work(progress: Progress) -> tuple[Instance, ...]:
        return engine.instances(result)

    viewer.worker.submit(f"taking '{phrase}' apart", work, done, _failed(viewer))


def select_thing(viewer: Viewer, number: int, mode: Mode | None = None) -> None:
    """One of the things that `find_things` found, counted from 0."""
    selection = viewer.state.selection
    if selection.things is not None and 0 <= number < len(selection.things.found):
        members = selection.things.found[number].members
        take(viewer, of_rows(members, len(selection.marks.selected)), mode)


def use_tool(viewer: Viewer, tool: Tool | None) -> None:
    """What a drag in the scene does from now on; None: it turns the camera again."""
    viewer.state.selection = replace(viewer.state.selection, tool=tool, stroke=None)


def set_mode(viewer: Viewer, mode: Mode) -> None:
    """How what is found is combined with the selection, unless a key that is held says otherwise."""
    viewer.state.selection = replace(viewer.state.selection, mode=mode)


def set_brush(viewer: Viewer, radius: float) -> None:
    """The brush's radius, of the picture's height."""
    low, high = selecting.BRUSHES
    viewer.state.selection = replace(viewer.state.selection, brush=min(max(radius, low), high))


def set_reach(viewer: Viewer, share: float) -> None:
    """How far growing goes, of the scene's radius."""
    low, high = selecting.REACHES
    viewer.state.selection = replace(viewer.state.selection, reach=min(max(share, low), high))


def set_only_visible(viewer: Viewer, only: bool) -> None:
    """Whether rectangle, lasso and brush leave out what lies behind something."""
    viewer.state.selection = replace(viewer.state.selection, only_visible=only)
