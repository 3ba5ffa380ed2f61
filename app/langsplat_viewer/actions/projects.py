"""Notes that are pinned to places, and projects: all that was asked, seen, noted and edited in a scene."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import LangSplatError
from langsplat_viewer.actions.opening import take_session
from langsplat_viewer.actions.selecting import discard_and_leave
from langsplat_viewer.actions.selecting import end as end_editing
from langsplat_viewer.actions.settings import open_panel
from langsplat_viewer.actions.viewpoint import bookmarked_view
from langsplat_viewer.camera.flight import pose_of
from langsplat_viewer.files.preferences import with_recent
from langsplat_viewer.files.projects import PROJECTS, Project, write_project
from langsplat_viewer.jobs import one_line
from langsplat_viewer.output import free_name
from langsplat_viewer.session import LONGEST_NOTE, MOST_NOTES, Bookmark, Marked, Note, Query, Ruler, Things
from langsplat_viewer.state import ViewerState
from langsplat_viewer.viewer import Viewer

# Notes.


def toggle_pinning(viewer: Viewer) -> None:
    """Have a click on the scene pin a note there, or no longer."""
    viewer.state.pins_notes = not viewer.state.pins_notes
    viewer.put(ruler=Ruler())
    if viewer.state.pins_notes:
        open_panel(viewer, "Notes")


def pin_at(viewer: Viewer, u: float, v: float) -> None:
    """Pin a note to the surface; (u, v) are fractions of the scene's area."""
    state = viewer.state
    point = None if viewer.surface is None else viewer.surface.point_at(u, v)
    if point is None:
        state.say("nothing under the cursor to pin a note to")
    else:
        _pin(viewer, point)


def pin_to_selection(viewer: Viewer) -> None:
    """Pin a note to the middle of what is selected."""
    state, chosen = viewer.state, viewer.state.marks.selected
    if state.scene is None or not chosen.any():
        viewer.say_error("select something first, then pin a note to it")
        return
    means = state.scene.gaussians.means[chosen].astype(np.float64)
    _pin(viewer, means[np.argmin(((means - np.median(means, axis=0)) ** 2).sum(1))])


def _pin(viewer: Viewer, point: Array) -> None:
    state, notes = viewer.state, viewer.state.session.notes
    if len(notes) >= MOST_NOTES:
        viewer.say_error("no room for more notes")
        return
    x, y, z = (float(part) for part in point)
    state.fresh_note = Note(f"note {len(notes) + 1}", (x, y, z))
    viewer.change(notes=(*notes, state.fresh_note))
    state.pins_notes, state.awaits_keyboard = False, True
    open_panel(viewer, "Notes")


def take_fresh_note(viewer: Viewer, note: Note) -> bool:
    """Return True once for a note that was just pinned, whose text is to be typed now."""
    is_fresh = viewer.state.fresh_note is note
    viewer.state.fresh_note = None if is_fresh else viewer.state.fresh_note
    return is_fresh


def write_note(viewer: Viewer, note: Note, text: str) -> None:
    """Change the text of a note."""
    changed = replace(note, text=text[:LONGEST_NOTE])
    notes = tuple(changed if other is note else other for other in viewer.state.session.notes)
    viewer.change(f"note at {note.at}", notes=notes)


def remove_note(viewer: Viewer, note: Note) -> None:
    """Take a note off."""
    viewer.change(notes=tuple(other for other in viewer.state.session.notes if other is not note))


# Projects.


def save_project(viewer: Viewer, folder: Path = Path()) -> Path | None:
    """Save the project to the file that it came from, or to a new one in `folder`; None where that failed."""
    state = viewer.state
    if state.scene is None or state.path is None or state.view is None:
        viewer.say_error("open a scene first, then save the project")
        return None
    path = state.project or free_name(folder, state.path.stem, PROJECTS)
    project = Project(
        scene=str(state.path.absolute()),
        gaussians=len(state.scene.gaussians),
        view=Bookmark("view", pose_of(state.view), state.view.distance),
        session=state.session,
        intrinsics=state.view.intrinsics,
        panels=state.preferences.panels or (),
    )
    answers = [_answer(state, query) for query in state.session.queries]
    if viewer.save(path, lambda: write_project(path, project, answers)) is None:
        return None
    state.project, state.preferences = path, with_recent(state.preferences, path)
    state.saved = state.session
    return path


def save_and_leave(viewer: Viewer, folder: Path = Path()) -> None:
    """Save the project and go on; where it cannot be saved one stays."""
    if save_project(viewer, folder) is not None:
        discard_and_leave(viewer)


def end(viewer: Viewer, folder: Path = Path()) -> None:
    """Close without a question: what would be lost is first written to new files in `folder`."""
    if viewer.state.has_unsaved_notes:
        save_project(viewer, folder)
    end_editing(viewer, folder)


def _answer(state: ViewerState, query: Query) -> dict[str, Any]:
    """Return the answer to a query as a project keeps it, for other programs."""
    answer, result = state.answer(query), state.result(query)
    if result is None:
        return {"phrase": query.phrase, "problem": answer.problem}
    return {
        "phrase": query.phrase,
        "verdict": result.verdict,
        "probability": result.probability,
        "place": None if result.place is None else [float(part) for part in result.place],
        "gaussians": int(result.members.sum()),
        "boxes": [thing.box.tolist() for thing in answer.things],
        "notes": [note.text for note in state.session.notes if result.members[_nearest(state, note)]],
    }


def _nearest(state: ViewerState, note: Note) -> int:
    """Return the Gaussian whose centre is nearest to a note."""
    assert state.scene is not None
    means = state.scene.gaussians.means.astype(np.float64)
    with np.errstate(all="ignore"):
        away = ((means - np.array(note.at)) ** 2).sum(1)
    return int(np.nanargmin(np.where(np.isfinite(away), away, np.inf)))


def restore(viewer: Viewer, project: Project, path: Path) -> None:
    """Have in the scene, which was just opened, what the project in the file `path` holds."""
    state, session = viewer.state, project.session
    assert state.scene is not None
    now = state.session
    session = replace(session, bookmarks=session.bookmarks or now.bookmarks)
    if project.version == 1:  # which had no other settings
        session = replace(session, split=now.split, splats=now.splats, overlays=now.overlays)
    edits = (session.marks, session.moves, session.things)
    if len(state.scene.gaussians) != project.gaussians:
        session = replace(session, marks=Marked(), moves=(), things=Things())
        if edits != (session.marks, session.moves, session.things):
            what = "what was selected, hidden, moved and named is left out"
            viewer.say_error(f"the scene has changed since: {what}")
    try:
        take_session(viewer, session)
    except LangSplatError as error:
        viewer.say_error(f"{path}: its transforms are left out: {one_line(error)}")
        take_session(viewer, replace(session, moves=()))
    if project.has_groups:
        viewer.say_error("groups and locks of the outline are left out: this version has none")
    assert state.extent is not None
    view = bookmarked_view(project.view, state.extent)
    state.view = view if project.intrinsics is None else replace(view, intrinsics=project.intrinsics)
    state.saved, state.project = state.session, path
    state.preferences = with_recent(state.preferences, path)
    if project.panels:
        state.preferences = replace(state.preferences, panels=project.panels)
        state.shows_panels = project.panels
