"""Undo and redo of what was asked, shown, selected, hidden and deleted, and of the settings of what is seen.
The camera is not undone: its reset leads back."""

from dataclasses import replace

from langsplat_viewer.actions.history import Moment, let_go, now
from langsplat_viewer.actions.outline import apply_locks
from langsplat_viewer.actions.queries import ask_unanswered, set_cut, set_level
from langsplat_viewer.actions.transforming import place
from langsplat_viewer.marks import pack, unpack
from langsplat_viewer.viewer import Viewer


def undo(viewer: Viewer) -> None:
    """Go back to before the last query, removal, colour, level, keyframe, note, selection, hiding, deletion
    or transform, or the last change of display, colours, sliders, split, cuts or overlays."""
    _step(viewer, viewer.history.past, viewer.history.future, "nothing to undo")


def redo(viewer: Viewer) -> None:
    """Do again what was undone last."""
    _step(viewer, viewer.history.future, viewer.history.past, "nothing to redo")


def _step(viewer: Viewer, there: list[Moment], back: list[Moment], otherwise: str) -> None:
    if not there:
        viewer.state.say(otherwise)
        return
    viewer.history.setting = ""
    back.append(now(viewer))
    _restore(viewer, there.pop())


def _restore(viewer: Viewer, moment: Moment) -> None:
    state, history = viewer.state, viewer.history
    for query in state.queries:
        query.slot = None
    for query, slot, since, cut in moment.queries:
        query.slot, query.shown_since = slot, since
        if query.automatic is None:  # it is asked anew
            query.cut = cut
        set_cut(viewer, query, cut, is_new=False)
    state.queries, state.selected = [query for query, *_ in moment.queries], moment.selected
    marks = unpack(moment.marks, pack(state.selection.marks, history.marks))
    state.selection = replace(state.selection, marks=marks, stroke=None)
    state.record.keyframes, state.record.chosen = moment.keyframes, None
    if moment.things != state.things:
        state.things = moment.things
        apply_locks(viewer)
    state.notes = moment.notes
    state.picture, state.latent_level = moment.picture, moment.latent_level
    state.settings = moment.settings
    looks = replace(state.preferences, colour_map=moment.picture.colour_map, overlays=moment.overlays)
    state.preferences = looks
    past, future = history.past, history.future
    set_level(viewer, moment.level)
    history.past, history.future = past, future  # what that has remembered is no step of its own
    let_go(viewer)
    if moment.moves != state.selection.moves:
        place(viewer, moment.moves)
    else:
        ask_unanswered(viewer)
