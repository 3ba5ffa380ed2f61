"""Views with names."""

from imgui_bundle import ImVec2, imgui

from langsplat_viewer import actions
from langsplat_viewer.commands import with_key
from langsplat_viewer.panels.style import elided, muted, small_wrapped, width_of
from langsplat_viewer.viewer import Viewer


def draw(viewer: Viewer) -> None:
    """A box for a name, and the list."""
    state = viewer.state
    imgui.begin_disabled(state.view is None)
    button = imgui.calc_text_size("Keep").x + 2 * imgui.get_style().frame_padding.x
    imgui.set_next_item_width(-button - imgui.get_style().item_spacing.x)
    flags, hint = imgui.InputTextFlags_.enter_returns_true, "name of this view"
    entered, typed = imgui.input_text_with_hint("##bookmark", hint, state.bookmark_typed, flags)
    actions.type_bookmark(viewer, typed)
    imgui.same_line()
    if imgui.button("Keep") or entered:
        actions.add_bookmark(viewer, state.bookmark_typed)
    imgui.end_disabled()
    if imgui.begin_child("bookmarks"):
        if not state.bookmarks:
            words = "views that you keep are listed here"
            small_wrapped(with_key(words, actions.add_bookmark), muted())
        for number, bookmark in enumerate(state.bookmarks):
            imgui.push_id(number)
            side, right = imgui.get_frame_height(), imgui.get_content_region_avail().x
            room = right - side - imgui.get_style().item_spacing.x
            name = elided(bookmark.name, room, width_of)
            imgui.align_text_to_frame_padding()
            if imgui.selectable(f"{name}##bookmark", False, size=ImVec2(room, 0))[0]:
                actions.go_to_bookmark(viewer, bookmark)
            imgui.same_line(imgui.get_cursor_start_pos().x + right - side)
            if imgui.button("x", ImVec2(side, 0)):
                actions.delete_bookmark(viewer, bookmark)
            imgui.pop_id()
    imgui.end_child()
