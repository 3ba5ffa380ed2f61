"""The file browser, over everything else."""

from pathlib import Path

from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_core.io.scenes import format_of
from langsplat_viewer import actions
from langsplat_viewer.files.browsing import Entry, Listing
from langsplat_viewer.panels.style import bad, muted, small_wrapped
from langsplat_viewer.viewer import Viewer

OPEN, PICK = "Open a scene", "Folder of the photographs"
WIDTH_EM, HEIGHT_EM = 40.0, 30.0
UNITS = ("bytes", "kB", "MB", "GB", "TB")


def draw(viewer: Viewer) -> None:
    """A box for a path, the folders above, what is in this one, and what was open before."""
    listing = viewer.state.browser
    title = PICK if viewer.state.picks_folder else OPEN
    if listing is not None and not imgui.is_popup_open(title):
        imgui.open_popup(title)
    centre = imgui.get_main_viewport().get_center()
    imgui.set_next_window_pos(centre, imgui.Cond_.appearing, ImVec2(0.5, 0.5))
    imgui.set_next_window_size(hello_imgui.em_to_vec2(WIDTH_EM, HEIGHT_EM), imgui.Cond_.appearing)
    shown, stays = imgui.begin_popup_modal(title, True, imgui.WindowFlags_.no_saved_settings)
    if not shown:
        return
    if listing is not None:
        _box(viewer)
        _above(viewer, listing.folder)
        _list(viewer, listing)
        _foot(viewer, listing)
    if not stays or imgui.is_key_pressed(imgui.Key.escape):
        actions.close_browser(viewer)
    if viewer.state.browser is None:
        imgui.close_current_popup()
    imgui.end_popup()


def _foot(viewer: Viewer, listing: Listing) -> None:
    """What can be done with the whole folder."""
    if viewer.state.picks_folder:
        if imgui.button("Take this folder"):
            actions.choose_photograph_folder(viewer, listing.folder)
    elif has_several(listing) and imgui.button("Open all scenes here"):
        actions.open_all(viewer)


def has_several(listing: Listing) -> bool:
    """Whether there is more than one scene to open."""
    return sum(entry.is_file and format_of(entry.path) is not None for entry in listing.entries) > 1


def _box(viewer: Viewer) -> None:
    button = imgui.calc_text_size("Open").x + 2 * imgui.get_style().frame_padding.x
    imgui.set_next_item_width(-button - imgui.get_style().item_spacing.x)
    if imgui.is_window_appearing():
        imgui.set_keyboard_focus_here()
    flags = imgui.InputTextFlags_.enter_returns_true
    picks = viewer.state.picks_folder
    hint = "path of a folder" if picks else "path of a scene or folder, or drop files onto the window"
    entered, typed = imgui.input_text_with_hint("##path", hint, viewer.state.path_typed, flags)
    actions.type_path(viewer, typed)
    imgui.same_line()
    if imgui.button("Open") or entered:
        actions.open_typed(viewer)


def _above(viewer: Viewer, folder: Path) -> None:
    """The folders above, each to be gone to."""
    for number, parent in enumerate((*reversed(folder.parents), folder)):
        if number:
            imgui.same_line(0, 2)
            name = parent.name or str(parent)
            width = imgui.calc_text_size(name).x + 2 * imgui.get_style().frame_padding.x
            if imgui.get_content_region_avail().x < width:
                imgui.new_line()
        if imgui.small_button(f"{parent.name or parent}##above {number}"):
            actions.browse(viewer, parent)


def _list(viewer: Viewer, listing: Listing) -> None:
    picks = viewer.state.picks_folder
    recent = () if picks else viewer.state.preferences.recent
    lines = min(len(recent), 4) + 1 if recent else 0
    below = lines * imgui.get_text_line_height_with_spacing() + 8 * bool(recent)
    below += imgui.get_frame_height_with_spacing() * (picks or has_several(listing))
    if imgui.begin_child("entries", ImVec2(0, -below), imgui.ChildFlags_.borders):
        if listing.problem:
            small_wrapped(listing.problem, bad())
        elif not listing.entries:
            small_wrapped("no folders here" if picks else "no scenes and no folders here", muted())
        for entry in (entry for entry in listing.entries if not (picks and entry.is_file)):
            _line(viewer, entry)
        if listing.left_out:
            small_wrapped(f"{listing.left_out:,} more: type a path", muted())
    imgui.end_child()
    if recent:
        imgui.text_colored(muted(), "Recent")
        foot = imgui.get_frame_height_with_spacing() * has_several(listing)
        if imgui.begin_child("recent", ImVec2(0, -foot)):
            for path in recent:
                if imgui.selectable(f"{path}##recent", False)[0]:
                    actions.open_recent(viewer, path)
        imgui.end_child()


def _line(viewer: Viewer, entry: Entry) -> None:
    right = imgui.get_content_region_avail().x
    name = entry.path.name if entry.is_file else f"{entry.path.name}/"
    if imgui.selectable(name, False)[0]:
        actions.choose(viewer, entry)
    if entry.size:
        text = in_words(entry.size)
        imgui.same_line(right - imgui.calc_text_size(text).x)
        imgui.text_colored(muted(), text)


def in_words(size: float) -> str:
    """Bytes as people read them: "1.4 MB"."""
    unit = 0
    while size >= 1000 and unit + 1 < len(UNITS):
        size, unit = size / 1000, unit + 1
    return f"{size:.0f} {UNITS[unit]}" if unit == 0 or size >= 100 else f"{size:.1f} {UNITS[unit]}"
