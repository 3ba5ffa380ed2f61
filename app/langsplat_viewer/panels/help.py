"""The list of keys: to be read, and to be changed."""

from imgui_bundle import ImVec2, hello_imgui, imgui

from langsplat_viewer import actions, keying
from langsplat_viewer.commands import COMMANDS, HELD, Command, keys_of, matching
from langsplat_viewer.keys import Changed
from langsplat_viewer.panels.style import bad, tip
from langsplat_viewer.viewer import Viewer

KEYS_EM, DOES_EM, ROWS = 14.0, 20.0, 16  # widths, and commands that are seen at a time while they are changed
OTHER_ROWS = 5  # title, box and what lies below the commands
MOST_SHARE = 0.94  # of the window's height


def rows(changed: Changed) -> tuple[tuple[str, str], ...]:
    """(keys, what they do)."""
    commands = ((", ".join(keys_of(command, changed)), command.does) for command in COMMANDS)
    return (*HELD, *(row for row in commands if row[0]))


def draw(viewer: Viewer) -> None:
    """A small window that can be closed."""
    if not viewer.state.show_help:
        return
    flags = imgui.WindowFlags_.always_auto_resize | imgui.WindowFlags_.no_collapse
    centre = imgui.get_main_viewport().get_center()
    room = imgui.get_main_viewport().work_size
    imgui.set_next_window_size_constraints(ImVec2(0, 0), ImVec2(room.x, MOST_SHARE * room.y))
    imgui.set_next_window_pos(centre, imgui.Cond_.appearing, ImVec2(0.5, 0.5))
    imgui.set_next_window_bg_alpha(1.0)
    _, still_open = imgui.begin("Keys", True, flags)
    actions.show_help(viewer, bool(still_open))
    edits = viewer.state.keying.edits
    if edits:
        _change(viewer)
    else:
        _read(viewer.state.preferences.keys)
    if imgui.button("Done" if edits else "Change ..."):
        actions.edit_keys(viewer, not edits)
    if edits and viewer.state.preferences.keys:
        imgui.same_line()
        if imgui.button("All as at first"):
            keying.put_all_back(viewer)
    imgui.end()


def _columns() -> None:
    imgui.table_setup_column("key", imgui.TableColumnFlags_.width_fixed, hello_imgui.em_size(KEYS_EM))
    imgui.table_setup_column("does", imgui.TableColumnFlags_.width_fixed, hello_imgui.em_size(DOES_EM))


def _read(changed: Changed) -> None:
    if imgui.begin_table("keys", 2):
        _columns()
        for key, what in rows(changed):
            imgui.table_next_row()
            imgui.table_next_column()
            imgui.text_unformatted(key)
            imgui.table_next_column()
            imgui.text_disabled(what)
        imgui.end_table()


def _change(viewer: Viewer) -> None:
    """A box, the commands that match it, and the question where a key is taken."""
    imgui.set_next_item_width(-1)
    typed = imgui.input_text_with_hint("##words", "which command", viewer.state.keying.typed)[1]
    actions.type_keys(viewer, typed)
    row = imgui.get_frame_height_with_spacing()
    high = min(ROWS * row, MOST_SHARE * imgui.get_main_viewport().work_size.y - OTHER_ROWS * row)
    size = ImVec2(hello_imgui.em_size(KEYS_EM + DOES_EM + 2), high)
    if imgui.begin_child("changeable", size) and imgui.begin_table("keys", 2):
        _columns()
        for command in matching(typed):
            if keying.can_change(command):
                _row(viewer, command)
        imgui.end_table()
    imgui.end_child()
    conflict = viewer.state.keying.conflict
    imgui.align_text_to_frame_padding()
    if conflict is None:
        imgui.text_disabled("Click a key, then press another; Esc leaves it as it is")
        return
    imgui.push_text_wrap_pos(hello_imgui.em_size(KEYS_EM + DOES_EM))
    imgui.text_colored(bad(), f"{conflict.key} is the key of '{conflict.owner}'")
    imgui.pop_text_wrap_pos()
    if imgui.button("Swap"):
        keying.swap(viewer)
    tip(f"{conflict.key} for '{conflict.wanted_by}', whose key goes to '{conflict.owner}'")
    imgui.same_line()
    if imgui.button("Leave it"):
        keying.keep_keys(viewer)


def _row(viewer: Viewer, command: Command) -> None:
    changed, waits = viewer.state.preferences.keys, viewer.state.keying.waiting == command.does
    keys, side = keys_of(command, changed), imgui.get_frame_height()
    imgui.push_id(command.does)
    imgui.table_next_row()
    imgui.table_next_column()
    room = hello_imgui.em_size(KEYS_EM) - 2 * (side + imgui.get_style().item_spacing.x)
    text = "press a key" if waits else ", ".join(keys) or "none"
    if imgui.button(f"{text} ##key", ImVec2(room, 0)):
        keying.wait_for_key(viewer, None if waits else command)
    imgui.same_line()
    imgui.begin_disabled(not keys)
    if imgui.button("x", ImVec2(side, 0)):
        keying.clear(viewer, command)
    tip("No key")
    imgui.end_disabled()
    if command.does in changed:
        imgui.same_line()
        if imgui.arrow_button("first", imgui.Dir.left):
            keying.put_back(viewer, command)
        tip(", ".join(command.keys) + " again" if command.keys else "No key, as at first")
    imgui.table_next_column()
    imgui.align_text_to_frame_padding()
    imgui.text_unformatted(command.does)
    imgui.pop_id()
