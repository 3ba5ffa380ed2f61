"""Transforms of the scene or of the selection, cropping to a box; undo and redo of every edit.

The scene that is shown is made anew from the one that was opened, by all transforms so far, so that undoing
them all gives exactly what was there.
"""

from dataclasses import replace
from typing import get_args

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import LangSplatError
from langsplat_core.query.selection import in_box
from langsplat_core.scene.transform import AXES, Similarity, moving, rotating, scaling
from langsplat_viewer.actions.queries import ask_again, ask_unanswered, forget_unlisted, set_canonical
from langsplat_viewer.actions.selecting import has_scene, mark, set_tools
from langsplat_viewer.camera.controls import extent_of
from langsplat_viewer.session import Move, Point, Session, pack
from langsplat_viewer.state import EditForm, Gizmo
from langsplat_viewer.viewer import Viewer


def next_gizmo(viewer: Viewer) -> None:
    """Show the gizmo that moves, the one that rotates, the one that scales, the handles of the box, none."""
    kinds: tuple[Gizmo, ...] = get_args(Gizmo)
    here = kinds.index(viewer.state.edit_form.gizmo)
    viewer.state.edit_form = replace(viewer.state.edit_form, gizmo=kinds[(here + 1) % len(kinds)])


def pivot(viewer: Viewer) -> Array | None:
    """(3,) middle of what is transformed, world units: the selection, else the scene; None without one."""
    state = viewer.state
    if state.scene is None or state.extent is None:
        return None
    selected, kept = state.marks.selected, viewer.pivot
    if kept is None or kept[0] is not state.scene or kept[1] is not selected:  # asked in every frame
        chosen = selected & state.scene.gaussians.valid()
        middle = state.extent.centre
        if chosen.any():
            middle = np.median(state.scene.gaussians.means[chosen].astype(np.float64), axis=0)
        kept = viewer.pivot = state.scene, selected, np.asarray(middle)
    return kept[2]


def _move_of(viewer: Viewer, to: Similarity) -> Move:
    return Move(to, pack(viewer.state.marks.selected))


def preview(viewer: Viewer, to: Similarity) -> None:
    """Show what `transform` would do, until it does. Raises InputError where that leads too far."""
    if viewer.state.scene is not None:
        move = _move_of(viewer, to)
        viewer.state.moving = move, move.applied(viewer.state.scene)


def transform(viewer: Viewer, to: Similarity) -> None:
    """Transform the selection; without one the whole scene with its cameras. Says why where that fails."""
    viewer.state.moving = None
    if not has_scene(viewer) or to.is_identity:
        return
    move, before = _move_of(viewer, to), viewer.state.session
    moves = before.moves
    joined = (*moves[:-1], moves[-1].then(move)) if moves and moves[-1].of == move.of else (*moves, move)
    viewer.change(moves=joined, ruler=replace(before.ruler, points=()))
    try:
        place(viewer)
    except LangSplatError as error:
        viewer.state.session = viewer.history.past.pop()
        viewer.say_error(str(error))
        return
    what = "the scene" if move.of is None else "the selection"
    viewer.state.say(f"transformed {what}; save the scene to keep it")


def place(viewer: Viewer) -> None:
    """Make the scene that is shown from the one that was opened, by the session's transforms.

    What was asked is asked anew. Raises InputError where one leads too far, and then changes nothing.
    """
    state = viewer.state
    if state.scene is None:
        return
    opened = state.opened or state.scene
    scene, field = opened, state.scene.language
    for move in state.session.moves:
        scene = move.applied(scene)
    if field is not None and viewer.engine is not None:
        field = replace(field, taught=tuple(viewer.engine.taught.values()))
    scene = replace(scene, language=field)
    state.opened, state.scene, state.extent, state.moving = opened, scene, extent_of(scene), None
    viewer.engine, viewer.describer = viewer.services.engine(scene), None
    if state.session.canonical:
        set_canonical(viewer, state.session.canonical)  # which asks again
    else:
        ask_again(viewer)


def apply_form(viewer: Viewer) -> None:
    """Transform by the numbers of the panel: scaled and rotated about the middle, then moved."""
    form, centre = viewer.state.edit_form, pivot(viewer)
    if centre is None:
        has_scene(viewer)
        return
    try:
        to = scaling(form.scale)
        for axis, degrees in zip("xyz", form.rotate, strict=True):
            to = to.then(rotating(AXES[axis], degrees))
        to = (to if to.is_identity else to.about(centre)).then(moving(np.array(form.move)))
    except LangSplatError as error:
        viewer.say_error(str(error))
        return
    transform(viewer, to)
    viewer.state.edit_form = replace(form, move=EditForm.move, rotate=EditForm.rotate, scale=EditForm.scale)


def fill_box(viewer: Viewer) -> None:
    """Set the box of the panel around the selection, or without one around everything that is shown."""
    state = viewer.state
    if state.scene is None:
        return
    marks = state.marks
    chosen = (marks.selected if marks.selected.any() else marks.shown) & state.scene.gaussians.valid()
    if chosen.any():
        means = state.scene.gaussians.means[chosen].astype(np.float64)
        low, high = (tuple(corner.tolist()) for corner in (means.min(0), means.max(0)))
        viewer.state.edit_form = replace(state.edit_form, low=low, high=high)


def set_box(viewer: Viewer, low: Point, high: Point) -> None:
    """Set two opposite corners of the crop box."""
    viewer.state.edit_form = replace(viewer.state.edit_form, low=low, high=high)


def _inside(viewer: Viewer) -> Array | None:
    """(N,) what lies inside the box; None, and said why, where that is nothing."""
    state, form = viewer.state, viewer.state.edit_form
    if not has_scene(viewer) or state.scene is None:
        return None
    corners = np.array([form.low, form.high])
    inside = in_box(state.scene.gaussians.means, corners.min(0), corners.max(0))
    if not (inside & state.marks.kept).any():
        viewer.say_error("the box holds nothing: set its corners around something, or press Fit")
        return None
    return inside


def crop(viewer: Viewer) -> None:
    """Delete what lies outside the box of the panel; refused where nothing lies inside."""
    inside, marks = _inside(viewer), viewer.state.marks
    if inside is not None:
        mark(viewer, replace(marks, selected=marks.selected & inside, deleted=marks.deleted | ~inside))


# Undo and redo. The camera is not undone: its reset leads back.


def undo(viewer: Viewer) -> None:
    """Go back to the session before the last step."""
    _step(viewer, viewer.history.past, viewer.history.future, "nothing to undo")


def redo(viewer: Viewer) -> None:
    """Take back the last undo."""
    _step(viewer, viewer.history.future, viewer.history.past, "nothing to redo")


def _step(viewer: Viewer, there: list[Session], back: list[Session], otherwise: str) -> None:
    if not there:
        viewer.state.say(otherwise)
        return
    viewer.history.setting = ""
    back.append(viewer.state.session)
    adopt(viewer, there.pop().undone(now=viewer.state.session))


def adopt(viewer: Viewer, session: Session) -> None:
    """Take another session of the scene that is shown.

    What follows from it is brought in line: masks, the transformed scene, answers. Raises InputError
    where a transform leads too far.
    """
    state, before = viewer.state, viewer.state.session
    set_tools(viewer, stroke=None)
    state.record.chosen = None
    state.marks = session.marks.masks(before.marks, state.marks)
    state.session = replace(session, canonical=before.canonical)  # until the engine compares with others
    forget_unlisted(viewer)
    if session.moves != before.moves:
        viewer.put(canonical=session.canonical)
        place(viewer)
    elif session.canonical != before.canonical:
        set_canonical(viewer, session.canonical)  # which asks again
    elif session.level != before.level:
        ask_again(viewer)
    else:
        ask_unanswered(viewer)
