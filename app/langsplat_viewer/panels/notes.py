"""The panels "Overlays" and "Notes"."""

from imgui_bundle import ImVec2, imgui

from langsplat_viewer.actions import saving, settings
from langsplat_viewer.camera.overlays import length_text
from langsplat_viewer.commands import OVERLAY_TITLES, with_key
from langsplat_viewer.panels import ui
from langsplat_viewer.viewer import Viewer


def draw_overlays(viewer: Viewer) -> None:
    """Draw the panel "Overlays": what is drawn over the image, and the ruler."""
    state = viewer.state
    for name, title in OVERLAY_TITLES.items():
        if imgui.checkbox(title.capitalize(), name in state.session.overlays)[0]:
            settings.toggle_overlay(viewer, name)
    ruler, scene = state.session.ruler, state.scene
    measure = with_key("Measure", settings.toggle_measuring)
    imgui.begin_disabled(scene is None)
    if imgui.checkbox(f"{measure}###measure", ruler.measures)[0]:
        settings.toggle_measuring(viewer)
    ui.tip("Click two points on the surface; Esc ends it")
    imgui.end_disabled()
    if ruler.measures:
        metres = None if scene is None else scene.metres_per_unit
        text = "click a second point" if ruler.points else "click a first point"
        if ruler.length is not None:
            text = length_text(ruler.length, metres)
        ui.small_wrapped(text, ui.muted())
        if scene is not None and metres is None:
            ui.small_wrapped("the scene has no scale in metres; langsplat scale gives it one", ui.muted())


def draw_notes(viewer: Viewer) -> None:
    """Draw the panel "Notes": texts pinned to places, kept in the project."""
    state, side = viewer.state, imgui.get_frame_height()
    imgui.begin_disabled(state.scene is None)
    pin = with_key("Pin one to what is clicked", settings.toggle_pinning)
    if imgui.checkbox(pin, state.pins_notes)[0]:
        settings.toggle_pinning(viewer)
    if ui.button("Pin one to the selection", enabled=bool(state.marks.selected.any())):
        settings.pin_to_selection(viewer)
    if ui.next_button(
        "Save project", "Notes, queries, selection, edits, views: one file, to be opened again"
    ):
        saving.save_project(viewer)
    imgui.end_disabled()
    if not state.session.notes:
        ui.small_wrapped("notes are listed here", ui.muted())
    for number, note in enumerate(state.session.notes):
        imgui.push_id(number)
        imgui.set_next_item_width(-side - imgui.get_style().item_spacing.x)
        if note is state.fresh_note:
            imgui.set_keyboard_focus_here()
            settings.put(state, fresh_note=None)
        changed, text = imgui.input_text("##note", note.text)
        if changed:
            settings.write_note(viewer, note, text)
        imgui.same_line()
        if imgui.button("x", ImVec2(side, 0)):
            settings.remove_note(viewer, note)
        imgui.pop_id()
