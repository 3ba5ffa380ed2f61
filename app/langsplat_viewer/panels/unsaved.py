"""The question before deletions are lost."""

from pathlib import Path

from imgui_bundle import ImVec2, imgui

from langsplat_viewer import actions
from langsplat_viewer.viewer import Viewer

TITLE = "Not saved"


def draw(viewer: Viewer) -> None:
    """Save, discard, cancel; over everything else, while something waits for the answer."""
    leaving = viewer.state.selection.leaving
    if leaving is not None and not imgui.is_popup_open(TITLE):
        imgui.open_popup(TITLE)
    centre = imgui.get_main_viewport().get_center()
    imgui.set_next_window_pos(centre, imgui.Cond_.appearing, ImVec2(0.5, 0.5))
    flags = imgui.WindowFlags_.always_auto_resize | imgui.WindowFlags_.no_saved_settings
    if not imgui.begin_popup_modal(TITLE, None, flags)[0]:
        return
    if leaving is not None:
        count = int(viewer.state.selection.marks.deleted.sum())
        imgui.text_unformatted(f"{count:,} Gaussians were deleted, and the scene is not saved without them.")
        imgui.text_unformatted(f"Save it as a new file before {leaving.to}?")
        if imgui.button("Save"):
            actions.save_and_leave(viewer, Path.cwd())
        imgui.same_line()
        if imgui.button("Discard"):
            actions.discard_and_leave(viewer)
        imgui.same_line()
        if imgui.button("Cancel"):
            actions.stay(viewer)
    if viewer.state.selection.leaving is None:
        imgui.close_current_popup()
    imgui.end_popup()
