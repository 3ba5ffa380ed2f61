"""Questions over the scene: about a file that has changed, and before something is lost."""

from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_viewer.actions import opening, saving, settings
from langsplat_viewer.panels import ui
from langsplat_viewer.viewer import Viewer

# The bar of a file that has changed.

BAR = (
    ui.FIXED
    | imgui.WindowFlags_.no_decoration
    | imgui.WindowFlags_.always_auto_resize
    | imgui.WindowFlags_.no_saved_settings
    | imgui.WindowFlags_.no_focus_on_appearing
    | imgui.WindowFlags_.no_nav
)


def draw_changed(viewer: Viewer, area: ui.Area) -> None:
    """Draw the bar of a file that has changed."""
    state = viewer.state
    if not viewer.watch.changed or state.path is None or state.opening is not None:
        return
    top = ImVec2(area.left + area.width / 2, area.top + hello_imgui.em_size(3))  # below what a tool says
    imgui.set_next_window_pos(top, imgui.Cond_.always, ImVec2(0.5, 0))
    imgui.begin("changed", None, BAR)
    imgui.align_text_to_frame_padding()
    imgui.text_unformatted(f"{state.path.name} has changed on disk")
    imgui.same_line()
    if ui.button("Reload", "Read it again; camera, queries and view settings stay"):
        opening.reload(viewer)
    imgui.same_line()
    if imgui.button("Not now"):
        viewer.watch.dismiss()
    imgui.end()


# The question before deletions are lost.

UNSAVED = "Not saved"


def draw_unsaved(viewer: Viewer) -> None:
    """Ask whether to save, discard or stay; over everything else, while something waits for the answer."""
    leaving = viewer.state.leaving
    ui.ask_for_popup(UNSAVED, leaving is not None)
    flags = imgui.WindowFlags_.always_auto_resize | imgui.WindowFlags_.no_saved_settings
    if not imgui.begin_popup_modal(UNSAVED, None, flags)[0]:
        return
    if leaving is not None and leaving.film:
        _wait_for_film(viewer)
    elif leaving is not None:
        _ask(viewer, leaving.to)
    if viewer.state.leaving is None:
        imgui.close_current_popup()
    imgui.end_popup()


def _ask(viewer: Viewer, to: str) -> None:
    state = viewer.state
    if state.is_unsaved:
        moved = " and some transformed" if state.session.moves else ""
        count = f"{int(state.marks.deleted.sum()):,} Gaussians"
        imgui.text_unformatted(f"{count} were deleted{moved}, and the scene is not saved so.")
    if state.has_unsaved_notes:
        imgui.text_unformatted("Notes, names, groups or locks are in no project.")
    imgui.text_unformatted(f"Save before {to}?")
    if state.is_unsaved:
        if ui.button("Save", "The scene as a new file, without what was deleted"):
            saving.save_and_leave(viewer)
        imgui.same_line()
    if ui.button("Save the project", "Everything in one small file; the scene stays as it is"):
        saving.save_project_and_leave(viewer)
    imgui.same_line()
    if imgui.button("Discard"):
        saving.go_on(viewer)
    imgui.same_line()
    if imgui.button("Cancel"):
        settings.put(viewer.state, leaving=None)


def _wait_for_film(viewer: Viewer) -> None:
    work = viewer.recorder.current
    if work is None:
        saving.go_on(viewer)
        return
    imgui.text_unformatted("The window closes once this is written.")
    imgui.progress_bar(work[1], ImVec2(-1, 0), work[0])
    if imgui.button("Stop it, and close"):
        saving.end_at_once(viewer)
    imgui.same_line()
    if imgui.button("Stay"):
        settings.put(viewer.state, leaving=None)
