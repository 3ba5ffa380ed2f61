"""The file browser: a path, folders, scenes, recent ones.

The project's own beside ImFileDialog, since it fits small windows and large text, says why a folder cannot be
read, lists recent scenes and opens folders that are scenes. Native dialogs need helpers that may be missing.
"""

from pathlib import Path

from imgui_bundle import ImVec2, imgui

from langsplat_viewer.actions import opening, settings
from langsplat_viewer.files.disk import FolderEntry, Listing
from langsplat_viewer.panels import ui
from langsplat_viewer.viewer import Viewer

WIDTH_EM, HEIGHT_EM = 40.0, 30.0


def draw_browser(viewer: Viewer) -> None:
    """Draw the browser: a box for a path, the folders above, what is in this one, and recent scenes."""
    listing = viewer.state.browser
    choice = viewer.state.choice
    title = choice.title or "Open"
    ui.ask_for_popup(title, listing is not None)
    imgui.set_next_window_size(ui.fitting(WIDTH_EM, HEIGHT_EM), imgui.Cond_.appearing)
    shown, stays = imgui.begin_popup_modal(title, True, imgui.WindowFlags_.no_saved_settings)
    if not shown:
        return
    if listing is not None:
        _path_box(viewer)
        _above(viewer, listing.folder)
        _entries(viewer, listing)
        if choice.is_folder and imgui.button("Take this folder"):
            opening.choose(viewer, listing.folder)
    if not stays or imgui.is_key_pressed(imgui.Key.escape):
        settings.put(viewer.state, browser=None)
    if viewer.state.browser is None:
        imgui.close_current_popup()
    imgui.end_popup()


def _path_box(viewer: Viewer) -> None:
    if imgui.is_window_appearing():
        viewer.state.drafts.pop("##path", None)
        imgui.set_keyboard_focus_here()
    picks = viewer.state.choice.is_folder
    hint = "path of a folder" if picks else "path of a scene or folder, or drop files onto the window"
    typed = ui.kept_box(viewer, "##path", hint, "Open")
    if typed is not None:
        opening.open_typed(viewer, typed)


def _above(viewer: Viewer, folder: Path) -> None:
    for number, parent in enumerate((*reversed(folder.parents), folder)):
        if number:
            imgui.same_line(0, 2)
            if imgui.get_content_region_avail().x < ui.button_width(parent.name):
                imgui.new_line()
        if imgui.small_button(f"{parent.name or parent}##above {number}"):
            opening.browse(viewer, parent)


def _entries(viewer: Viewer, listing: Listing) -> None:
    picks = viewer.state.choice.is_folder
    recent = () if picks else viewer.state.preferences.recent
    lines = min(len(recent), 4) + 1 if recent else 0
    below = lines * imgui.get_text_line_height_with_spacing() + 8 * bool(recent)
    below += imgui.get_frame_height_with_spacing() * picks
    if imgui.begin_child("entries", ImVec2(0, -below), imgui.ChildFlags_.borders):
        if listing.problem:
            ui.small_wrapped(listing.problem, ui.bad())
        elif not listing.entries:
            ui.small_wrapped("no folders here" if picks else "no scenes and no folders here", ui.muted())
        for entry in (entry for entry in listing.entries if not (picks and entry.is_file)):
            _entry(viewer, entry)
        if listing.left_out:
            ui.small_wrapped(f"{listing.left_out:,} more: type a path", ui.muted())
    imgui.end_child()
    if recent:
        imgui.text_colored(ui.muted(), "Recent")
        if imgui.begin_child("recent"):
            for path in recent:
                if imgui.selectable(f"{path}##recent", False)[0]:
                    opening.open_file(viewer, Path(path))
        imgui.end_child()


def _entry(viewer: Viewer, entry: FolderEntry) -> None:
    right = imgui.get_content_region_avail().x
    name = entry.path.name if entry.is_file else f"{entry.path.name}/"
    if imgui.selectable(name, False)[0]:
        (opening.choose if entry.is_file else opening.browse)(viewer, entry.path)
    if entry.size:
        text = ui.in_words(entry.size)
        imgui.same_line(right - imgui.calc_text_size(text).x)
        imgui.text_colored(ui.muted(), text)
