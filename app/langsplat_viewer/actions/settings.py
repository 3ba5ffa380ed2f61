"""Settings of the view: displays side by side, overlays, ruler and notes; preferences and panels."""

import os
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from os.path import exists
from pathlib import Path
from typing import Any, Literal

from langsplat_core.config import Display, PictureConfig
from langsplat_core.display.displays import DISPLAYS
from langsplat_viewer.projects import BUNDLED
from langsplat_viewer.rendering.request import AT_RANGE, Clip, SplitMode
from langsplat_viewer.session import (
    LONGEST_NOTE,
    MOST_NOTES,
    OVERLAYS,
    SCALES,
    Bookmark,
    Note,
    Overlay,
    Ruler,
)
from langsplat_viewer.state import FileChoice, Recording, ViewerState
from langsplat_viewer.viewer import Viewer


def put(part: ViewerState | Recording, **values: object) -> None:
    """Set fields of the state, or of a part of it, by name: panels write nothing themselves."""
    for name, value in values.items():
        getattr(part, name)  # AttributeError where it has none
        setattr(part, name, value)


def take(part: ViewerState, name: str) -> Any:
    """Return and clear a field that holds for one frame."""
    value = getattr(part, name)
    setattr(part, name, type(value)())
    return value


# The display, and several side by side.


def set_display(viewer: Viewer, display: Display, latent_level: int | None = None) -> None:
    """Choose what is shown; `latent_level` is an index into `scene.LEVELS`."""
    if _can_show(viewer, DISPLAYS[display].needs_field):
        session = viewer.state.session
        level = session.latent_level if latent_level is None else latent_level
        viewer.change(picture=replace(session.picture, display=display), latent_level=level)


def set_picture(viewer: Viewer, picture: PictureConfig) -> None:
    """Set the settings of the image, as its sliders give them."""
    before, names = viewer.state.session.picture, (field.name for field in fields(picture))
    changed = (name for name in names if getattr(picture, name) != getattr(before, name))
    viewer.change(" ".join(changed), picture=picture)


def set_clip(viewer: Viewer, clip: Clip) -> None:
    """Set between which depths Gaussians are drawn; the far one stays the farther."""
    near = max(clip.near, 0.0)
    viewer.change("clip", clip=Clip(near, max(clip.far, near)))


def compare(
    viewer: Viewer, mode: SplitMode, second: Display | None = None, latent_level: int | None = None
) -> None:
    """Divide the scene's area, or show one image ("off").

    `second` is what a wipe shows right of its line; `latent_level` indexes `scene.LEVELS`.
    """
    split = viewer.state.session.split
    second = second or split.second
    level = split.second_level if latent_level is None else latent_level
    needs_field = mode == "levels" or (mode == "wipe" and DISPLAYS[second].needs_field)
    if _can_show(viewer, needs_field):
        viewer.change(split=replace(split, mode=mode, second=second, second_level=level))
        if mode == "levels" and split.mode != mode:  # the search would cover its first columns
            put(viewer.state, unfolds="Search" in (viewer.state.preferences.panels or ("Search",)))
            turn_panel(viewer, "Search", is_open=False)
        elif mode != "levels" and take(viewer.state, "unfolds"):
            turn_panel(viewer, "Search", is_open=True)


def _toggle_compare(viewer: Viewer, mode: SplitMode) -> None:
    compare(viewer, "off" if viewer.state.session.split.mode == mode else mode)


toggle_wipe, toggle_levels = (partial(_toggle_compare, mode=mode) for mode in ("wipe", "levels"))


def move_line(viewer: Viewer, at: float) -> None:
    """Move the line that divides the two images, as a fraction of the area's width."""
    low, high = AT_RANGE
    viewer.change("line", split=replace(viewer.state.session.split, at=min(max(at, low), high)))


def _can_show(viewer: Viewer, needs_field: bool) -> bool:
    """Return whether the scene has a language field or needs none; report a missing one."""
    return not needs_field or viewer.state.open is None or viewer.searchable() is not None


# Overlays, the ruler, and notes that are pinned to places.


def toggle_overlay(viewer: Viewer, overlay: Overlay) -> None:
    """Show or hide an overlay."""
    kept = {*viewer.state.session.overlays} ^ {overlay}
    viewer.change(overlays=tuple(name for name in OVERLAYS if name in kept))


def toggle_measuring(viewer: Viewer) -> None:
    """Switch the ruler, whose points clicks on the scene set, on, or off and clear it."""
    viewer.put(ruler=Ruler(not viewer.state.session.ruler.measures))


def measure_at(viewer: Viewer, u: float, v: float) -> None:
    """Set the second point of the ruler, or the first anew; (u, v) are fractions of the scene's area."""
    point, ruler = viewer.point_at(u, v, "measure from"), viewer.state.session.ruler
    if point is not None:
        viewer.put(ruler=replace(ruler, points=(*ruler.points[: len(ruler.points) % 2], point)))


def toggle_pinning(viewer: Viewer) -> None:
    """Switch the pinning of notes by a click on the scene on or off."""
    viewer.state.pins_notes = not viewer.state.pins_notes
    viewer.put(ruler=Ruler())
    if viewer.state.pins_notes:
        open_panel(viewer, "Notes")


def pin_at(viewer: Viewer, u: float, v: float) -> None:
    """Pin a note to the surface; (u, v) are fractions of the scene's area."""
    state, notes = viewer.state, viewer.state.session.notes
    point = viewer.point_at(u, v, "pin a note to")
    if point is None:
        return
    if len(notes) >= MOST_NOTES:
        viewer.say_error("no room for more notes")
        return
    state.fresh_note = Note(f"note {len(notes) + 1}", point)
    viewer.change(notes=(*notes, state.fresh_note))
    state.pins_notes, state.awaits_keyboard = False, True
    open_panel(viewer, "Notes")


def write_note(viewer: Viewer, note: Note, text: str) -> None:
    """Change the text of a note."""
    changed = replace(note, text=text[:LONGEST_NOTE])
    notes = tuple(changed if other is note else other for other in viewer.state.session.notes)
    viewer.change(f"note at {note.at}", notes=notes)


def take_off(viewer: Viewer, name: Literal["notes", "bookmarks"], gone: Note | Bookmark) -> None:
    """Take a note or a bookmark off its list."""
    kept = tuple(other for other in getattr(viewer.state.session, name) if other is not gone)
    viewer.change("", **{name: kept})


# The window: preferences and panels.


def prefer(viewer: Viewer, **values: Any) -> None:
    """Change fields of the preferences."""
    viewer.state.preferences = replace(viewer.state.preferences, **values)


def keep_preferences(viewer: Viewer) -> None:
    """Copy the session's settings that outlive a window to the preferences."""
    session = viewer.state.session
    prefer(viewer, colour_map=session.picture.colour_map, overlays=session.overlays)


def take_preferences(viewer: Viewer) -> None:
    """Begin the session with the settings that outlived the last window."""
    kept, picture = viewer.state.preferences, viewer.state.session.picture
    overlays = tuple(name for name in OVERLAYS if name in kept.overlays)
    viewer.put(picture=replace(picture, colour_map=kept.colour_map), overlays=overlays)


def scale_text(viewer: Viewer, by: float) -> None:
    """Make letters and widgets larger or smaller."""
    low, high = SCALES
    prefer(viewer, ui_scale=min(max(viewer.state.preferences.ui_scale + by, low), high))


def resize(viewer: Viewer, width: int, height: int) -> None:
    """Take the size of the scene's area of the window, pixels."""
    viewer.state.size = (max(1, width), max(1, height))


def open_panel(viewer: Viewer, title: str) -> None:
    """Open a panel in front of those that share its place."""
    viewer.state.show_panel, viewer.state.wanted_panel, viewer.state.show_start = True, title, False


def turn_panel(viewer: Viewer, title: str, *, is_open: bool) -> None:
    """Open or close a panel."""
    others = tuple(other for other in viewer.state.preferences.panels or () if other != title)
    prefer(viewer, panels=(*others, title) if is_open else others)


def _switch(name: str) -> Callable[[Viewer], None]:
    """Return the action that turns a switch of the state over."""
    return lambda viewer: setattr(viewer.state, name, not getattr(viewer.state, name))


toggle_panels, toggle_help, toggle_start = map(_switch, ("show_panel", "show_help", "show_start"))


def toggle_palette(viewer: Viewer) -> None:
    """Show or close the command palette."""
    viewer.state.show_palette = not viewer.state.show_palette
    viewer.state.awaits_keyboard |= viewer.state.show_palette


def escape(viewer: Viewer) -> None:
    """Close what lies over the scene; if nothing does, drop the stroke, else leave the tool.

    Queries that failed leave the list.
    """
    state, tools = viewer.state, viewer.state.tools
    forms = state.choice or state.export_form or state.leaving
    lay_over = state.show_help or state.show_palette or forms or state.show_start or state.has_escape
    state.show_start &= state.open is None
    state.show_help = state.show_palette = state.letters_muted = False
    state.choice = state.export_form = state.leaving = None
    failed = {query.phrase for query in state.session.queries if state.answer(query).problem}
    if failed:
        left = state.session.without(failed)
        viewer.change(queries=left.queries, chosen=left.chosen)
    if not lay_over:
        state.pins_notes = False
        if state.session.ruler.measures:
            toggle_measuring(viewer)
        state.tools = replace(tools, stroke=None, tool=tools.tool if tools.stroke else None)


# Files and folders that are chosen in a dialog.


def folder_of(viewer: Viewer) -> Path:
    """Return the folder that dialogs begin in: where the scene lies, unless it is the bundled one."""
    path = viewer.state.path
    return Path.cwd() if path is None or path == BUNDLED else path.absolute().parent


def ask_for(viewer: Viewer, choice: FileChoice) -> None:
    """Have a dialog ask for a file or folder, at first where the scene lies."""
    viewer.state.choice = replace(choice, start=folder_of(viewer) / choice.start)


def choose(viewer: Viewer, text: str, is_confirmed: bool = False) -> None:
    """Call the file dialog's action with a path, relative to its folder, and close the dialog.

    A file that is there is only written over where the dialog of the system has it `is_confirmed`.
    """
    choice, text = viewer.state.choice, text.strip()
    if choice is None or not text:
        return
    saves = choice.kind == "save"
    path = (choice.start.parent if saves else choice.start) / os.path.expanduser(text)
    if saves and not path.name.lower().endswith(choice.suffixes):
        path, is_confirmed = path.with_name(path.name + choice.suffixes[0]), False
    if saves and exists(path) and not is_confirmed:
        viewer.say_error(f"{path}: is there already; choose another name")
        return
    viewer.state.choice = None
    choice.then(viewer, path)
